"""What is wrong with configuration data, in the user's words."""

import re
import types
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

from pydantic import ValidationError
from pydantic.fields import FieldInfo

from gvpipe.config import (
    AUTO_TILT_DEG,
    CameraConfig,
    Config,
    OverrideConfig,
    RobotConfig,
    Section,
    sees_ground,
)
from gvpipe.formats.strict_yaml import KeyPath, format_value
from gvpipe.names import escape, nearest

_ROBOT_NAME = re.compile(r"\w[\w.-]{0,63}\Z")
_LONGEST_QUOTE = 60  # characters of a wrong value that a message repeats
HIGH_M, HEIGHTS_APART = 10.0, 10.0
"""Heights above this, and robots' heights this many times apart, are doubted."""

_Model = TypeVar("_Model", bound=Section)


@dataclass(frozen=True)
class Finding:
    """One mistake.

    Attributes
    ----------
    path : KeyPath
        Of the value; the path of a missing or unknown key ends in that key.
    message : str
        What is wrong and what was expected.
    about_key : bool
        Whether the key itself is wrong, not its value.
    """

    path: KeyPath
    message: str
    about_key: bool = False


def check(data: Mapping[str, object]) -> tuple[Config | None, list[Finding]]:
    """Validate configuration data.

    Parameters
    ----------
    data : mapping
        As parsed; cameras are mappings of numbers.

    Returns
    -------
    config : Config or None
        None if there are findings.
    findings : list of Finding
        Every mistake.
    """
    config = None
    findings: list[Finding] = []
    try:
        config = Config.model_validate(data)
    except ValidationError as error:
        for item in error.errors(include_url=False):
            findings.append(_explain(data, item["loc"], item["type"], item["input"]))
    findings += _cross_checks(data)
    return (None if findings else config), findings


def field_at(path: KeyPath) -> tuple[Any, FieldInfo | None]:
    """Type and field of a key path; items of lists belong to the list's field."""
    annotation: Any = Config
    info: FieldInfo | None = None
    for part in path:
        if isinstance(annotation, type) and issubclass(annotation, Section):
            info = annotation.model_fields.get(str(part))
            if info is None:
                return None, None
            annotation = info.annotation
        elif get_origin(annotation) is dict:
            annotation = get_args(annotation)[1]
        else:
            break
    return annotation, info


def _explain(data: object, loc: tuple[int | str, ...], kind: str, value: object) -> Finding:
    """Turn one pydantic error into a finding."""
    path = _document_path(data, loc, keep_last=kind == "missing")
    if kind == "extra_forbidden":
        parent, _ = field_at(path[:-1])
        known = list(parent.model_fields)
        hint = nearest(str(path[-1]), known)
        message = f"is not a known key; expected one of {', '.join(known)}{hint}"
        return Finding(path, message, about_key=True)
    annotation, info = field_at(path)
    meaning = f" ({info.description})" if info is not None and info.description else ""
    own = isinstance(annotation, type) and issubclass(annotation, Section)
    expected = accepted(annotation, [] if own or info is None else info.metadata)
    if kind == "missing":
        return Finding(path, f"is missing; expected {expected}{meaning}")
    return Finding(path, f"is {quote(value)}; expected {expected}{'' if own else meaning}")


def _document_path(data: object, loc: tuple[int | str, ...], keep_last: bool) -> KeyPath:
    """Leave out of a pydantic location what names a branch of a union, not a key."""
    path: list[str | int] = []
    for k, part in enumerate(loc):
        in_mapping = isinstance(data, Mapping) and part in data
        if in_mapping or (isinstance(data, list) and isinstance(part, int) and part < len(data)):
            data = data[part]  # type: ignore[index]
        elif not (keep_last and k == len(loc) - 1):
            continue
        path.append(part)
    return tuple(path)


def quote(value: object) -> str:
    """Write a wrong value as a message repeats it."""
    if value is None:
        return "empty"
    if isinstance(value, dict | list | tuple) and value:
        return "a mapping" if isinstance(value, dict) else f"a list of {len(value)}"
    text = escape(format_value(value) if not isinstance(value, str) else repr(value))
    return text if len(text) <= _LONGEST_QUOTE else text[:_LONGEST_QUOTE] + "..."


def accepted(annotation: Any, metadata: list[Any]) -> str:
    """Say in words what a type accepts.

    Parameters
    ----------
    annotation : type
        Of a configuration key.
    metadata : list
        Its bounds, as pydantic keeps them.
    """
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return accepted(arguments[0], [*annotation.__metadata__])
    if origin in (Union, types.UnionType):
        return " or ".join(accepted(a, []) for a in arguments if a is not types.NoneType)
    if origin is Literal:
        return " or ".join(map(str, arguments))
    if origin is tuple:
        if arguments[-1] is Ellipsis:
            return f"a list, each {accepted(arguments[0], [])}"
        return f"a list of {len(arguments)}, each {accepted(arguments[0], [])}"
    simple = {
        float: "a number",
        int: "a whole number",
        str: "text",
        Path: "a path",
        bool: "true or false",
    }
    return simple.get(annotation, "a mapping of keys") + _range(metadata)


def _range(metadata: Iterable[Any]) -> str:
    """Say the bounds among a type's metadata in words."""
    limits = []
    for item in metadata:
        for bound in item.metadata if isinstance(item, FieldInfo) else [item]:
            for name, sign in (("gt", ">"), ("ge", ">="), ("lt", "<"), ("le", "<=")):
                if hasattr(bound, name):
                    limits.append(f"{sign} {getattr(bound, name):g}")
    return " " + " and ".join(limits) if limits else ""


def _cross_checks(data: Mapping[str, object]) -> Iterator[Finding]:
    """Mistakes between keys; parts that are wrong in themselves are passed over."""
    cameras, robots = _mapping(data.get("cameras")), _mapping(data.get("robots"))
    for name in robots:
        if not _ROBOT_NAME.match(name) or name.endswith("."):
            wanted = "1 to 64 letters, digits, _ . or -, beginning with a letter, digit or _"
            message = f"is not a usable name; expected {wanted}"
            yield Finding(("robots", name), message, about_key=True)
    yield from _check_pair_names(robots)
    for path, robot in _holders(robots):
        camera = robot.get("camera")
        if isinstance(camera, str) and camera not in cameras:
            known = ", ".join(cameras) or "none"
            hint = nearest(camera, cameras)
            message = f"is {quote(camera)}; expected a camera (known: {known}){hint}"
            yield Finding((*path, "camera"), message)
    yield from _check_ids(data, robots)
    yield from _check_horizon(cameras, robots)


def _check_pair_names(robots: Mapping[str, object]) -> Iterator[Finding]:
    """Results of two robots are filed under both names: no two pairs may share theirs."""
    pairs: dict[str, tuple[str, str]] = {}
    for first, second in combinations(robots, 2):
        filed = f"{first}-{second}"
        one, other = pairs.setdefault(filed, (first, second))
        if (one, other) != (first, second):
            both = f"with {first} is filed as {filed}, which is {one} with {other}, too"
            yield Finding(("robots", second), f"{both}; expected another name", about_key=True)


def _holders(robots: Mapping[str, object]) -> Iterator[tuple[KeyPath, Mapping[str, object]]]:
    """Robots and their overrides: all that can name a camera."""
    for name, robot in robots.items():
        yield ("robots", name), _mapping(robot)
        for image, override in _mapping(_mapping(robot).get("overrides")).items():
            yield ("robots", name, "overrides", image), _mapping(override)


def _check_ids(data: Mapping[str, object], robots: Mapping[str, object]) -> Iterator[Finding]:
    """Image ids must name a robot that there is."""
    ids: list[tuple[KeyPath, object]] = [
        (("slam", "reference"), _mapping(data.get("slam")).get("reference"))
    ]
    pairs = _mapping(data.get("match")).get("pairs")
    if pairs == []:
        yield Finding(("match", "pairs"), "is an empty list; expected at least one pair")
    for k, pair in enumerate(pairs if isinstance(pairs, list) else []):
        if isinstance(pair, list):
            ids += [(("match", "pairs", k, n), image_id) for n, image_id in enumerate(pair)]
            if len(pair) == 2 and isinstance(pair[0], str) and pair[0] == pair[1]:
                message = f"is {quote(pair[0])} twice; expected two images"
                yield Finding(("match", "pairs", k), message)
    control = _mapping(data.get("slam")).get("control")
    for k, point in enumerate(control if isinstance(control, list) else []):
        ids.append((("slam", "control", k, "image"), _mapping(point).get("image")))
    for path, image_id in ids:
        if not isinstance(image_id, str):
            continue
        robot, slash, image = image_id.partition("/")
        if not slash or not image:
            expected = "expected robot/file name, for example A/0003.jpg"
            yield Finding(path, f"is {quote(image_id)}; {expected}")
        elif robot not in robots:
            known = ", ".join(robots) or "none"
            expected = f"expected an image of a robot (known: {known})"
            yield Finding(path, f"is {quote(image_id)}; {expected}")


def _check_horizon(
    cameras: Mapping[str, object], robots: Mapping[str, object]
) -> Iterator[Finding]:
    """Check that every camera sees some ground."""
    for name, raw in robots.items():
        robot = _valid(RobotConfig, raw)
        if robot is None:
            continue
        blank = OverrideConfig()
        for image, over in [("", blank), *robot.overrides.items()]:
            path: KeyPath = ("robots", name, "overrides", image) if image else ("robots", name)
            camera = _valid(CameraConfig, cameras.get(over.camera or robot.camera))
            tilt = robot.tilt if over.tilt is None else over.tilt
            tilt = AUTO_TILT_DEG if tilt == "auto" else tilt
            roll = robot.roll if over.roll is None else over.roll
            if camera is not None and not sees_ground(camera, tilt, roll):
                expected = "expected the lowest image row below the horizon"
                seen = f"sees no ground at tilt {tilt:g}, roll {roll:g}"
                yield Finding(path, f"{seen}; {expected}")


def doubts(config: Config) -> Iterator[str]:
    """Say what is allowed but hardly meant: heights in another unit than metres."""
    for name, robot in config.robots.items():
        heights = {"height": robot.height}
        heights |= {f"overrides.{k}.height": o.height or 0.0 for k, o in robot.overrides.items()}
        for key, height in heights.items():
            if height > HIGH_M:
                where = escape(f"robots.{name}.{key}")
                yield f"{where}: is {height:g}, higher than floors are mapped from; in metres?"
    heights_m = [(robot.height, name) for name, robot in config.robots.items()]
    low, high = min(heights_m), max(heights_m)
    if high[0] > HEIGHTS_APART * low[0]:
        other = f"robots.{escape(low[1])}.height is {low[0]:g}"
        yield f"robots.{escape(high[1])}.height: is {high[0]:g}, but {other}; both in metres?"


def _valid(model: type[_Model], raw: object) -> _Model | None:
    try:
        return model.model_validate(raw)
    except ValidationError:
        return None


def _mapping(value: object) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}
