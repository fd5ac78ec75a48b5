"""KITTI odometry poses: a line of 12 numbers, the upper rows of camera to map, for each image."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from gvpipe.core.types import Pose, Rejected
from gvpipe.errors import InputError
from gvpipe.formats.files import read_regular_file
from gvpipe.names import escape

MAX_BYTES = 64 << 20
"""Largest file accepted."""

ORTHONORMAL_TOLERANCE = 5e-3
"""How far a row's length or angle may be off: files rounded to three decimals pass."""


def read_kitti(path: Path) -> list[Pose]:
    """Read a trajectory.

    Parameters
    ----------
    path : Path
        Text file; empty lines are passed over.

    Returns
    -------
    map_from_camera : list of Pose
        One a line, rotations made exact.

    Raises
    ------
    InputError
        If the file cannot be read, or a line is not a rigid motion; names file and line.
    """
    name = escape(str(path))
    raw = read_regular_file(path, MAX_BYTES)
    if isinstance(raw, Rejected):
        raise InputError(f"{name}: {raw.reason}; expected KITTI poses")
    poses = []
    for number, line in enumerate(raw.splitlines(), start=1):
        if not line.strip():
            continue
        try:
            values = np.array([float(word) for word in line.decode("ascii").split()])
        except (ValueError, UnicodeDecodeError):
            values = np.array([np.nan])
        if values.size != 12 or not np.isfinite(values).all():
            raise InputError(f"{name}:{number}: expected 12 finite numbers: R and t, row by row")
        matrix = values.reshape(3, 4)
        rotation = matrix[:, :3]
        wrong = np.abs(rotation @ rotation.T - np.eye(3)).max()
        if wrong > ORTHONORMAL_TOLERANCE or np.linalg.det(rotation) < 0:
            raise InputError(f"{name}:{number}: its first three columns are no rotation")
        u, _, vt = np.linalg.svd(rotation)
        poses.append(Pose(np.asarray(u @ vt), matrix[:, 3].copy()))
    return poses


def format_kitti(poses: Iterable[Pose]) -> str:
    """Write map_from_camera poses as text, every number at full precision."""
    lines = []
    for pose in poses:
        matrix = np.column_stack([pose.rotation, pose.translation])
        lines.append(" ".join(repr(float(v) + 0.0) for v in matrix.ravel()))
    return "".join(line + "\n" for line in lines)
