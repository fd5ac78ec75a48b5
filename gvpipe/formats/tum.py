"""TUM trajectory files: ``timestamp tx ty tz qx qy qz qw``, one pose a line, camera to map."""

import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from gvpipe.core.geometry.pose import quaternions, rotation_of
from gvpipe.core.types import Pose, Rejected
from gvpipe.errors import InputError
from gvpipe.formats.files import read_regular_file
from gvpipe.names import escape

HEADER = "# timestamp tx ty tz qx qy qz qw (camera to map, metres)"

MAX_BYTES = 64 << 20
"""Largest file accepted: half a million poses."""

NORM_TOLERANCE = 2e-3
"""How far a quaternion's norm may be from 1: files rounded to three decimals pass."""

MAX_DISTANCE = 1e7
"""Largest coordinate accepted, metres; more is a wrong column or unit."""

StampedPose = tuple[float, Pose]
"""Timestamp and map_from_camera."""


def read_tum(path: Path) -> list[StampedPose]:
    """Read a trajectory; see :func:`read_tum_lines`."""
    return [stamped for _, stamped in read_tum_lines(path)]


def read_tum_lines(path: Path) -> list[tuple[int, StampedPose]]:
    """Read a trajectory, and on which line of the file each pose is.

    Parameters
    ----------
    path : Path
        Text file; empty lines and lines that begin with ``#`` are passed over.

    Returns
    -------
    poses : list of (int, (float, Pose))
        Line from 1, timestamp and map_from_camera, in the order of the file; quaternions
        normalised.

    Raises
    ------
    InputError
        If the file cannot be read; names file and line if a line is not eight finite numbers with
        a unit quaternion.
    """
    name = escape(str(path))
    raw = read_regular_file(path, MAX_BYTES)
    if isinstance(raw, Rejected):
        raise InputError(f"{name}: {raw.reason}; expected a TUM trajectory")
    poses = []
    for number, line in enumerate(raw.removeprefix(b"\xef\xbb\xbf").splitlines(), start=1):
        text = line.strip()
        if text and not text.startswith(b"#"):
            pose = _parse(text)
            if isinstance(pose, str):
                raise InputError(f"{name}:{number}: {pose}")
            poses.append((number, pose))
    return poses


def _parse(text: bytes) -> StampedPose | str:
    """Read one line: a pose, or what is wrong with it."""
    words = text.split()
    if len(words) != 8:
        return f"{len(words)} values; expected 8: timestamp tx ty tz qx qy qz qw"
    try:
        values = [float(word.decode("ascii")) for word in words]
    except (ValueError, UnicodeDecodeError):
        return "a value is not a number; expected timestamp tx ty tz qx qy qz qw"
    if not all(map(math.isfinite, values)):
        return "a value is not finite; expected timestamp tx ty tz qx qy qz qw"
    if max(map(abs, values[1:4])) > MAX_DISTANCE:
        return f"a coordinate is beyond {MAX_DISTANCE:g} m; expected metres"
    norm = math.hypot(*values[4:])
    if abs(norm - 1.0) > NORM_TOLERANCE:
        return f"the quaternion's norm is {norm:.4g}; expected 1"
    return values[0], Pose(rotation_of(values[4:]), np.array(values[1:4]))


def format_tum(poses: Iterable[StampedPose]) -> str:
    """Write a trajectory as text.

    Parameters
    ----------
    poses : iterable of (float, Pose)
        Timestamp and map_from_camera.

    Returns
    -------
    text : str
        Every number at full precision, quaternions with qw >= 0.
    """
    lines = [HEADER]
    stamped = list(poses)
    turns = quaternions([pose for _, pose in stamped]).tolist()
    for (timestamp, pose), quaternion in zip(stamped, turns, strict=True):
        values = (timestamp, *pose.translation, *quaternion)
        lines.append(" ".join(repr(float(value) + 0.0) for value in values))
    return "\n".join(lines) + "\n"
