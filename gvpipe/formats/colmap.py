"""COLMAP text models: ``cameras.txt``, ``images.txt`` and ``points3D.txt``.

COLMAP counts pixels from the corner of the first one, gvpipe from its centre: half a pixel is
taken off principal points on reading and added to them and to features on writing. Its poses are
camera from world.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.geometry.pose import quaternions, rotation_of
from gvpipe.core.types import Float, Pose, Rejected
from gvpipe.errors import InputError
from gvpipe.formats.calibration import Calibration
from gvpipe.formats.files import read_regular_file
from gvpipe.names import escape

MAX_BYTES = 256 << 20
"""Largest file accepted: images.txt lists every feature."""

MODELS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
"""Camera models that gvpipe undistorts, with their parameters in the file's order."""

_ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


@dataclass(frozen=True)
class PosedImage:
    """One row of ``images.txt``.

    Attributes
    ----------
    name : str
        As in the file.
    camera : int
        Key into the cameras.
    map_from_camera : Pose
        Camera to world.
    """

    name: str
    camera: int
    map_from_camera: Pose


@dataclass(frozen=True)
class SparsePoints:
    """Points and where they were seen: all that ``points3D.txt`` and features hold.

    Attributes
    ----------
    position : (T, 3) float64
        In the map, metres.
    error_px : (T,) float64
        Mean reprojection error.
    start : (T + 1,) int64
        Observations ``start[t]:start[t + 1]`` belong to point t.
    image : (M,) int64
        Number of the image of each observation, in the list that is written.
    pixel : (M, 2) float64
        Where it was seen in the photograph, pixel centres at integers.
    """

    position: Float
    error_px: Float
    start: NDArray[np.int64]
    image: NDArray[np.int64]
    pixel: Float

    @property
    def point(self) -> NDArray[np.int64]:
        """Point of each observation, (M,)."""
        return np.repeat(np.arange(len(self.position)), np.diff(self.start))


def read_cameras(path: Path) -> dict[int, Calibration]:
    """Read ``cameras.txt``.

    Raises
    ------
    InputError
        If it cannot be read, or a line is wrong or of another model; names file and line.
    """
    cameras: dict[int, Calibration] = {}
    for where, words in _lines(path):
        try:
            key, model, width, height = int(words[0]), words[1], int(words[2]), int(words[3])
            values = [float(word) for word in words[4:]]
        except (ValueError, IndexError):
            raise InputError(f"{where}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS") from None
        if model not in MODELS:
            raise InputError(f"{where}: model {escape(model)}; expected {', '.join(MODELS)}")
        names = MODELS[model]
        good = len(values) == len(names) and all(map(math.isfinite, values))
        if not good or min(width, height) <= 0:
            raise InputError(f"{where}: {model} takes {len(names)} numbers: {', '.join(names)}")
        cameras[key] = _calibration(width, height, dict(zip(names, values, strict=True)))
    return cameras


def _calibration(width: int, height: int, values: Mapping[str, float]) -> Calibration:
    """Take a camera's parameters over."""
    distortion = tuple(values.get(name, 0.0) for name in _ORDER)
    used = next(n for n in (0, 4, 5, 8) if not any(distortion[n:]))
    return Calibration(
        width,
        height,
        fx=values.get("fx", values.get("f", 0.0)),
        fy=values.get("fy", values.get("f", 0.0)),
        cx=values["cx"] - 0.5,
        cy=values["cy"] - 0.5,
        distortion=distortion[:used],
    )


def format_cameras(cameras: Mapping[int, Calibration]) -> str:
    """Write ``cameras.txt``; the model with the fewest parameters that holds each camera.

    Raises
    ------
    ValueError
        If a camera has skew, which COLMAP has no place for.
    """
    lines = ["# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"]
    for key, camera in cameras.items():
        if camera.skew:
            raise ValueError("COLMAP has no camera model with skew")
        values = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx + 0.5, "cy": camera.cy + 0.5}
        values |= dict(zip(_ORDER, camera.distortion, strict=False))
        used = len(camera.distortion)
        model = "PINHOLE" if not used else "OPENCV" if used <= 4 else "FULL_OPENCV"
        numbers = (repr(float(values.get(name, 0.0))) for name in MODELS[model])
        lines.append(" ".join([str(key), model, str(camera.width), str(camera.height), *numbers]))
    return "\n".join(lines) + "\n"


def read_images(path: Path) -> list[PosedImage]:
    """Read ``images.txt``.

    Raises
    ------
    InputError
        If it cannot be read or a line is wrong; names file and line.
    """
    images = []
    for number, (where, words) in enumerate(_lines(path, keep_empty=True)):
        if number % 2 or not words:  # the features of the image before, or the file's end
            continue
        try:
            values = [float(word) for word in words[1:8]]
            camera, name = int(words[8]), " ".join(words[9:])
        except (ValueError, IndexError):
            values, camera, name = [], 0, ""
        norm = math.hypot(*values[:4])
        if len(values) != 7 or not name or not all(map(math.isfinite, values)) or norm < 1e-6:
            raise InputError(f"{where}: expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME")
        w, x, y, z = values[:4]
        camera_from_map = Pose(rotation_of([x, y, z, w]), np.array(values[4:]))
        images.append(PosedImage(name, camera, camera_from_map.inverse()))
    return images


def format_images(images: Sequence[PosedImage], points: SparsePoints | None = None) -> str:
    """Write ``images.txt``; images are numbered from 1 in their order, points too.

    Parameters
    ----------
    images : sequence of PosedImage
        Poses.
    points : SparsePoints, optional
        Their observations become the features, in the same order.

    Returns
    -------
    text : str
    """
    features: list[list[str]] = [[] for _ in images]
    if points is not None:
        rows = zip(points.image.tolist(), points.pixel.tolist(), points.point.tolist(), strict=True)
        for image, (u, v), point in rows:
            features[image].append(f"{u + 0.5!r} {v + 0.5!r} {point + 1}")
    lines = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then a line of X Y POINT3D_ID"]
    poses = [image.map_from_camera.inverse() for image in images]
    posed = zip(images, poses, quaternions(poses).tolist(), strict=True)
    for number, (image, pose, (x, y, z, w)) in enumerate(posed, start=1):
        numbers = " ".join(repr(float(v) + 0.0) for v in (w, x, y, z, *pose.translation))
        lines.append(f"{number} {numbers} {image.camera} {image.name}")
        lines.append(" ".join(features[number - 1]))
    return "\n".join(lines) + "\n"


def format_points(points: SparsePoints, colour: tuple[int, int, int] = (128, 128, 128)) -> str:
    """Write ``points3D.txt`` for the same points as :func:`format_images`."""
    place = np.empty(len(points.image), dtype=np.int64)  # of an observation among its image's
    order = np.argsort(points.image, kind="stable")
    first = np.searchsorted(points.image[order], points.image[order])
    place[order] = np.arange(len(order)) - first
    track = [f"{i + 1} {k}" for i, k in zip(points.image.tolist(), place.tolist(), strict=True)]
    red, green, blue = colour
    lines = ["# POINT3D_ID X Y Z R G B ERROR TRACK[] (IMAGE_ID POINT2D_IDX)"]
    for number, (x, y, z) in enumerate(points.position.tolist()):
        seen = " ".join(track[points.start[number] : points.start[number + 1]])
        error = float(points.error_px[number])
        lines.append(f"{number + 1} {x!r} {y!r} {z!r} {red} {green} {blue} {error!r} {seen}")
    return "\n".join(lines) + "\n"


def _lines(path: Path, *, keep_empty: bool = False) -> Iterator[tuple[str, list[str]]]:
    """Yield the place and the words of each line that is no comment."""
    name = escape(str(path))
    raw = read_regular_file(path, MAX_BYTES)
    if isinstance(raw, Rejected):
        raise InputError(f"{name}: {raw.reason}; expected a COLMAP text model")
    lines = raw.decode("utf-8", "surrogateescape").splitlines()
    for number, line in enumerate(lines, start=1):
        if line.startswith("#") or (not line.strip() and not keep_empty):
            continue
        yield f"{name}:{number}", line.split()
