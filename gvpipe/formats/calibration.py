"""Camera calibration files: ROS camera_info, OpenCV FileStorage and Kalibr camchain.

All three place pixel centres at integers and order distortion as k1 k2 p1 p2 k3 k4 k5 k6, as
gvpipe does, so the numbers are taken over unchanged.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from gvpipe.core.types import Rejected
from gvpipe.errors import ConfigError
from gvpipe.formats.files import read_regular_file
from gvpipe.formats.strict_yaml import MAX_BYTES, Document, parse_bytes
from gvpipe.names import escape

PINHOLE_DISTORTIONS = ("none", "plumb_bob", "radtan", "rational_polynomial")
"""Distortion models that gvpipe undistorts; a missing name means the first or second."""

_OPENCV_MATRIX = "tag:yaml.org,2002:opencv-matrix"


@dataclass(frozen=True)
class Calibration:
    """What a calibration file says of one camera.

    Attributes
    ----------
    width, height : int
        Image size, pixels.
    fx, fy, cx, cy, skew : float
        Intrinsics, pixels, pixel centres at integers.
    distortion : tuple of float
        None, 4, 5 or 8 coefficients in OpenCV order.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    skew: float = 0.0
    distortion: tuple[float, ...] = ()


def read_calibration(path: Path, name: str = "") -> Calibration:
    """Read the intrinsics of one camera.

    Parameters
    ----------
    path : Path
        A ROS camera_info YAML, an OpenCV FileStorage YAML or a Kalibr camchain.
    name : str
        Which camera to take from a camchain that holds several.

    Returns
    -------
    calibration : Calibration

    Raises
    ------
    ConfigError
        If the file cannot be read, or a key is missing or wrong; the message names both, and the
        accepted models where the distortion model is another one.
    """
    source = _Source(escape(str(path)), _load(path))
    data = source.document.value
    if not isinstance(data, Mapping):
        raise source.error((), "is empty; expected a ROS, OpenCV or Kalibr calibration")
    chain = [
        key for key, value in data.items() if isinstance(value, Mapping) and "intrinsics" in value
    ]
    if chain:
        return _kalibr(source, chain, name)
    return _matrix_form(source)


def _load(path: Path) -> Document:
    """Parse the file; ConfigError with every syntax error."""
    name = escape(str(path))
    raw = read_regular_file(path, MAX_BYTES)
    if isinstance(raw, Rejected):
        raise ConfigError(f"{name}: {raw.reason}; expected a calibration file")
    if raw.startswith(b"%YAML:"):  # OpenCV's first line is not a YAML directive
        raw = raw.replace(b"%YAML:", b"#YAML:", 1)
    document = parse_bytes(raw, tags=(_OPENCV_MATRIX,))
    if document.problems:
        lines = [
            f"{name}:{p.mark.line}:{p.mark.column}: {'.'.join(map(str, p.path))}: {p.message}"
            for p in document.problems
        ]
        raise ConfigError("\n".join(lines))
    return document


@dataclass(frozen=True)
class _Source:
    """An open calibration file: typed access to its keys, errors that name them."""

    name: str
    document: Document

    def error(self, path: tuple[str, ...], message: str) -> ConfigError:
        """Name file, line and key path."""
        mark = self.document.value_marks.get(path)
        where = f"{self.name}:{mark.line}:{mark.column}" if mark and path else self.name
        return ConfigError(
            f"{where}: {'.'.join(path)}: {message}" if path else f"{where}: {message}"
        )

    def find(self, *names: str, inside: tuple[str, ...] = ()) -> tuple[str, ...] | None:
        """Path of the first of several spellings of a key that is there."""
        data = self.get(inside)
        found = (key for key in names if isinstance(data, Mapping) and key in data)
        return next(((*inside, key) for key in found), None)

    def need(self, what: str, *names: str, inside: tuple[str, ...] = ()) -> tuple[str, ...]:
        """Path of a key that must be there, under the first of its spellings that is."""
        path = self.find(*names, inside=inside)
        if path is None:
            raise self.error((*inside, names[0]), f"is missing; expected {what}")
        return path

    def get(self, path: tuple[str, ...]) -> object:
        """Value at a path; None if there is none."""
        value: object = self.document.value
        for key in path:
            value = value.get(key) if isinstance(value, Mapping) else None
        return value

    def numbers(self, path: tuple[str, ...], what: str) -> tuple[float, ...]:
        """Finite numbers of a list, or of the ``data`` of a matrix."""
        value = self.get(path)
        if isinstance(value, Mapping):
            path = (*path, "data")
            value = self.get(path)
        if value is None and what.startswith("distortion"):
            return ()
        good = isinstance(value, list) and all(
            isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v)
            for v in value
        )
        if not isinstance(value, list) or not good:
            raise self.error(path, f"is not a list of finite numbers; expected {what}")
        return tuple(float(v) for v in value)

    def pixels(self, path: tuple[str, ...]) -> int:
        """Read a whole number above 0."""
        value = self.get(path)
        if isinstance(value, bool) or not isinstance(value, int) or value <= 0:
            raise self.error(path, f"is {value!r}; expected a number of pixels")
        return value

    def text(self, path: tuple[str, ...] | None) -> str:
        """Read a word in small letters; empty if there is none."""
        value = self.get(path) if path else None
        return "" if value is None else str(value).strip().lower()


def _kalibr(source: _Source, chain: list[str], name: str) -> Calibration:
    """One camera of a Kalibr camchain."""
    if len(chain) > 1 and name not in chain:
        raise source.error(
            (), f"holds {', '.join(chain)}; name the camera {name!r} like one of them"
        )
    camera = (name if name in chain else chain[0],)
    model = source.text(source.find("camera_model", inside=camera))
    if model not in ("", "pinhole"):
        raise source.error((*camera, "camera_model"), f"is {model!r}; expected pinhole")
    path = source.need("[fx, fy, cx, cy]", "intrinsics", inside=camera)
    intrinsics = source.numbers(path, "[fx, fy, cx, cy]")
    if len(intrinsics) != 4:
        raise source.error(path, f"has {len(intrinsics)} numbers; expected [fx, fy, cx, cy]")
    size = source.need("[width, height]", "resolution", inside=camera)
    resolution = source.get(size)
    if (
        not isinstance(resolution, list)
        or len(resolution) != 2
        or not all(type(v) is int for v in resolution)
    ):
        raise source.error(size, "is not a size; expected [width, height] in pixels")
    distortion = _distortion(source, camera, "distortion_model", ("distortion_coeffs",))
    fx, fy, cx, cy = intrinsics
    return Calibration(resolution[0], resolution[1], fx, fy, cx, cy, 0.0, distortion)


def _matrix_form(source: _Source) -> Calibration:
    """Read ROS camera_info (file or message) and OpenCV FileStorage: a 3x3 matrix and a vector."""
    matrix = source.need("3x3 numbers", "camera_matrix", "cameraMatrix", "Camera_Matrix", "K", "k")
    k = source.numbers(matrix, "9 numbers, row by row")
    if len(k) != 9:
        raise source.error(matrix, f"has {len(k)} numbers; expected 9, row by row")
    if k[3] != 0 or k[6] != 0 or k[7] != 0 or k[8] != 1:
        raise source.error(
            matrix, "is no calibration matrix; expected [fx, s, cx, 0, fy, cy, 0, 0, 1]"
        )
    width = source.pixels(source.need("pixels", "image_width", "image_Width", "width"))
    height = source.pixels(source.need("pixels", "image_height", "image_Height", "height"))
    if source.get(("fisheye_model",)):
        raise source.error(
            ("fisheye_model",), f"is set; expected one of {', '.join(PINHOLE_DISTORTIONS)}"
        )
    coefficients = (
        "distortion_coefficients",
        "distCoeffs",
        "Distortion_Coefficients",
        "dist_coeffs",
        "D",
        "d",
    )
    distortion = _distortion(source, (), "distortion_model", coefficients)
    return Calibration(width, height, k[0], k[4], k[2], k[5], k[1], distortion)


def _distortion(
    source: _Source, inside: tuple[str, ...], model_key: str, names: tuple[str, ...]
) -> tuple[float, ...]:
    """Coefficients in OpenCV order, trailing zeros beyond what gvpipe knows left out."""
    model = source.text(source.find(model_key, inside=inside))
    if model and model not in PINHOLE_DISTORTIONS:
        accepted = ", ".join(PINHOLE_DISTORTIONS)
        raise source.error((*inside, model_key), f"is {model!r}; expected one of {accepted}")
    path = source.find(*names, inside=inside)
    values = source.numbers(path, "distortion coefficients in OpenCV order") if path else ()
    if path is None and model not in ("", "none"):
        raise source.error((*inside, names[0]), f"is missing; expected the coefficients of {model}")
    if model == "none" and any(values):
        raise source.error((*inside, model_key), "is none, but there are coefficients")
    while len(values) not in (0, 4, 5, 8) and values[-1] == 0:
        values = values[:-1]
    if len(values) not in (0, 4, 5, 8):
        assert path is not None
        raise source.error(
            path, f"has {len(values)} numbers; expected 0, 4, 5 or 8 in OpenCV order"
        )
    return values
