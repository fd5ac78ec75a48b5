"""Load, check, print and hash the configuration file."""

import copy
import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic.fields import FieldInfo

from gvpipe.config import Config, Section
from gvpipe.configcheck import Finding, accepted, check
from gvpipe.core.types import Rejected
from gvpipe.errors import ConfigError, GvpipeError, InputError, UsageError
from gvpipe.formats.calibration import read_calibration
from gvpipe.formats.files import read_regular_file
from gvpipe.formats.strict_yaml import MAX_BYTES, KeyPath, format_value, parse_bytes, parse_text
from gvpipe.inputcheck import missing_inputs
from gvpipe.names import escape

_LOCATIONS: Any = {"output": True, "robots": {"__all__": {"images": True, "poses": True}}}
"""Keys that say where data lie, not what they are; they never reach a hash."""

_PLAIN_KINDS = frozenset({"text", "a path", "a mapping of keys"})  # not worth a comment

_PLACEHOLDER_CAMERA = {"width": 640, "height": 480, "fx": 500, "fy": 500, "cx": 320, "cy": 240}
"""Stands for a calibration that could not be read, so that the other checks can go on."""


def load_config(
    path: Path, overrides: Sequence[str] = (), out: Path | None = None, *, inputs: bool = False
) -> Config:
    """Read a configuration file.

    Parameters
    ----------
    path : Path
        The YAML file; paths in it (and in `overrides`) are relative to its folder.
    overrides : sequence of str
        ``key.path=value``, the value written as YAML; each replaces one key.
    out : Path, optional
        Output folder, relative to the current folder; wins over the file's ``output``.
    inputs : bool
        Also look for the pictures and poses that it names.

    Returns
    -------
    config : Config
        Complete: paths absolute, calibration files read, every robot's camera named.

    Raises
    ------
    InputError
        If the file is missing or unreadable; or, with `inputs`, what it names, and nothing else is
        wrong.
    UsageError
        If an override is not of the form ``key.path=value``.
    ConfigError
        With one line for each mistake: file, line, column, key path, what was expected.
    """
    base = path.absolute().parent
    tree = _read_tree(path)
    for text in overrides:
        _override(tree, text)
    _fill_cameras(tree, base)
    config, findings = check(tree.data)
    for finding in findings:
        tree.report(finding)
    mistaken = bool(tree.wrong)
    for finding in missing_inputs(tree.data, base) if inputs else ():
        tree.report(finding)
    tree.raise_if_wrong(ConfigError if mistaken else InputError)
    assert config is not None  # check gives a configuration or findings
    robots = {
        name: robot.model_copy(
            update={
                "images": base / robot.images,
                "poses": None if robot.poses is None else base / robot.poses,
            }
        )
        for name, robot in config.robots.items()
    }
    output = base / config.output if out is None else out.absolute()
    return config.model_copy(update={"robots": robots, "output": output})


def show_config(config: Config) -> str:
    """Write every key with its value and meaning, as YAML that loads to the same configuration."""
    return "\n".join(_show(config, "")) + "\n"


def section_sha256(config: Config, sections: Sequence[str]) -> str:
    """Hash the resolved values of some sections, wherever the data lie.

    Parameters
    ----------
    config : Config
        As loaded.
    sections : sequence of str
        Top-level keys, for example ``("cameras", "robots", "seed", "match")``.

    Returns
    -------
    sha256 : str
        Hexadecimal; the same for a copy of the folder, and whatever the other sections hold. The
        paths of images, poses and output are left out (whether there are known poses is not);
        the order of the robots counts.
    """
    dump = config.model_dump(mode="json", include=set(sections), exclude=_LOCATIONS)
    unknown = set(sections) - set(Config.model_fields)
    if unknown:
        raise ValueError(f"unknown sections: {sorted(unknown)}")
    if "robots" in dump:
        for name, robot in dump["robots"].items():
            robot["known_poses"] = config.robots[name].poses is not None
        dump["robots"] = list(dump["robots"].items())
    canonical = json.dumps(dump, sort_keys=True, ensure_ascii=True, allow_nan=False)
    return hashlib.sha256(canonical.encode("ascii")).hexdigest()


@dataclass
class _Tree:
    """Configuration data, where each key came from, and the mistakes so far."""

    data: dict[str, object]
    key_origins: dict[KeyPath, tuple[int, int, str]] = field(default_factory=dict)
    value_origins: dict[KeyPath, tuple[int, int, str]] = field(default_factory=dict)
    wrong: list[tuple[tuple[int, int, str], KeyPath, str]] = field(default_factory=list)
    unread: set[KeyPath] = field(default_factory=set)

    def origin(self, path: KeyPath, about_key: bool = False) -> tuple[int, int, str]:
        """Where a value (or its key) stands, or the key that should hold it."""
        table = self.key_origins if about_key else self.value_origins
        if path in table:
            return table[path]
        return next(self.key_origins[p] for p in _ancestors(path) if p in self.key_origins)

    def report(self, finding: Finding) -> None:
        """Record a mistake, unless the value there was not even read."""
        if self.unread.isdisjoint(_ancestors(finding.path)):
            origin = self.origin(finding.path, finding.about_key)
            self.wrong.append((origin, finding.path, finding.message))

    def report_unread(
        self, path: KeyPath, message: str, origin: tuple[int, int, str] | None = None
    ) -> None:
        """Record that a value could not be read; what follows from that is not reported."""
        self.wrong.append((origin or self.origin(path), path, message))
        self.unread.add(path)

    def raise_if_wrong(self, kind: type[GvpipeError] = ConfigError) -> None:
        """Raise one error that lists all mistakes in the order of the file."""
        if self.wrong:
            in_order = sorted(self.wrong, key=lambda item: item[0][:2])
            raise kind(
                "\n".join(f"{at}: {_dotted(path)}{text}" for (*_, at), path, text in in_order)
            )


def _ancestors(path: KeyPath) -> Iterator[KeyPath]:
    """Yield the path itself and all that leads to it, innermost first."""
    return (path[:k] for k in range(len(path), -1, -1))


def _dotted(path: KeyPath) -> str:
    return escape(".".join(map(str, path))) + ": " if path else ""


def _read_tree(path: Path) -> _Tree:
    """Parse the file; ConfigError at once if it cannot be followed to its end."""
    name = escape(str(path))
    raw = read_regular_file(path, MAX_BYTES)
    if isinstance(raw, Rejected):
        raise InputError(f"{name}: {raw.reason}; expected a configuration file")
    document = parse_bytes(raw)
    data = document.value if isinstance(document.value, dict) else {}
    tree = _Tree(data, {(): (1, 1, f"{name}:1:1")})
    for marks, origins in (
        (document.key_marks, tree.key_origins),
        (document.value_marks, tree.value_origins),
    ):
        for key_path, mark in marks.items():
            origins[key_path] = (mark.line, mark.column, f"{name}:{mark.line}:{mark.column}")
    for problem in document.problems:
        line, column = problem.mark.line, problem.mark.column
        tree.report_unread(problem.path, problem.message, (line, column, f"{name}:{line}:{column}"))
    if document.complete and not isinstance(document.value, dict):
        what = "empty" if document.value is None else "not a mapping"
        tree.report(Finding((), f"is {what}; expected the keys cameras and robots"))
    if not document.complete or not isinstance(document.value, dict):
        tree.raise_if_wrong()
    return tree


def _override(tree: _Tree, text: str) -> None:
    """Apply one ``key.path=value``."""
    dotted, equals, value_text = text.partition("=")
    if not equals or not dotted.strip():
        raise UsageError(f"--set {escape(text)}: expected KEY=VALUE, for example --set seed=1")
    order = 10**9 + len(tree.key_origins)  # after everything in the file
    origin = (order, 0, f"--set {escape(text)}")
    document = parse_text(value_text)
    path, container = _locate(tree.data, dotted.strip())
    if document.problems:
        tree.report_unread(path, document.problems[0].message, origin)
        return
    key = path[-1]
    if isinstance(container, dict):
        container[str(key)] = document.value
    elif isinstance(container, list) and isinstance(key, int):
        container[key] = document.value
    else:
        tree.report_unread(path, "is inside a value that holds no keys", origin)
        return
    for table in (tree.key_origins, tree.value_origins):
        for old in [p for p in table if p[: len(path)] == path]:
            del table[old]
        table |= {made: origin for made in _ancestors(path) if made not in table}


def _locate(data: dict[str, object], dotted: str) -> tuple[KeyPath, object]:
    """Follow a dotted key to the container of its last part, making sections on the way.

    Keys that hold dots themselves (file names) are found by their longest match.
    """
    path: list[str | int] = []
    container: object = data
    rest = dotted
    while True:
        part = rest.split(".", 1)[0]
        if isinstance(container, dict):
            held = [k for k in container if rest == k or rest.startswith(k + ".")]
            part = max([*held, part], key=len)
        is_item = isinstance(container, list) and part.isdecimal() and int(part) < len(container)
        path.append(int(part) if is_item else part)
        rest = rest[len(part) + 1 :]
        if not rest:
            return tuple(path), container
        if isinstance(container, dict):
            container = container.setdefault(part, {})
        elif isinstance(container, list) and is_item:
            container = container[int(part)]
        else:
            container = None


def _fill_cameras(tree: _Tree, base: Path) -> None:
    """Put numbers in place of calibration files, and the only camera where none is named."""
    tree.data = copy.deepcopy(tree.data)
    cameras, robots = tree.data.get("cameras"), tree.data.get("robots")
    if not isinstance(cameras, dict):
        return
    for name, value in cameras.items():
        if isinstance(value, str):
            try:
                found = read_calibration(base / value, name)
            except ConfigError as error:
                tree.report_unread(("cameras", name), str(error))
                cameras[name] = dict(_PLACEHOLDER_CAMERA)
            else:
                cameras[name] = {**vars(found), "distortion": list(found.distortion)}
    if len(cameras) == 1 and isinstance(robots, dict):
        for robot in robots.values():
            if isinstance(robot, dict):
                robot.setdefault("camera", next(iter(cameras)))


def _show(value: Section | dict[str, Section], indent: str) -> Iterator[str]:
    """Lines of one section, or of a mapping of sections by name."""
    if isinstance(value, dict):
        items = [(name, section, "") for name, section in value.items()]
    else:
        fields = type(value).model_fields.items()
        items = [(name, getattr(value, name), _comment(info)) for name, info in fields]
    for name, item, comment in items:
        key = f"{indent}{format_value(name)}:"
        if isinstance(item, Section) or (isinstance(item, dict) and item):
            yield key + comment
            yield from _show(item, indent + "  ")
        else:
            yield f"{key} {format_value(_plain(item))}{comment}"


def _plain(item: object) -> object:
    """Turn a value into plain data."""
    if isinstance(item, tuple):
        return [_plain(part) for part in item]
    if isinstance(item, Section):
        return item.model_dump(mode="json")
    return str(item) if isinstance(item, Path) else item


def _comment(info: FieldInfo) -> str:
    """Meaning of a key and what it accepts."""
    if not info.description:
        return ""
    kind = accepted(info.annotation, info.metadata)
    return f"  # {info.description}" + ("" if kind in _PLAIN_KINDS else f"; {kind}")
