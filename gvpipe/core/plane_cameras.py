"""Cameras of one unknown calibration over one plane: how their pictures map onto each other."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.types import Float

GLOBALS = 3
"""Unknowns that all cameras share: logarithm of the focal length, and two of radial distortion."""

POSE = 6
"""Unknowns of one camera: x, y, yaw, logarithm of the height, tilt, roll."""

UNDISTORTION_STEPS = 6
"""Fixed point steps; for |k1| r^2 up to 0.2 the error falls fivefold with each."""


@dataclass(frozen=True)
class Matches:
    """Matched pixels of many pairs in one list.

    Attributes
    ----------
    points_i, points_j : (N, 2) float64
        Pixels from the principal point, in picture widths.
    camera_i, camera_j : (N,) int64
        Which camera saw each.
    """

    points_i: Float
    points_j: Float
    camera_i: NDArray[np.int64]
    camera_j: NDArray[np.int64]


def undistort(points: Float, k1: float, k2: float) -> Float:
    """Take radial distortion out of rays: inverse of :func:`distort`, (N, 2)."""
    rays = points
    for _ in range(UNDISTORTION_STEPS):
        r2 = (rays**2).sum(axis=1, keepdims=True)
        rays = points / np.maximum(1 + k1 * r2 + k2 * r2**2, 0.1)
    return rays


def distort(rays: Float, k1: float, k2: float) -> Float:
    """Put radial distortion into rays (x, y at depth 1), (N, 2), as OpenCV does."""
    r2 = (rays**2).sum(axis=1, keepdims=True)
    return rays * (1 + k1 * r2 + k2 * r2**2)


def ray_from_ground(poses: Float) -> Float:
    """Homographies from the ground (x, y, 1) to rays of each camera.

    Parameters
    ----------
    poses : (N, 6) float64
        See :data:`POSE`; radians, any unit of length.

    Returns
    -------
    ray_from_ground : (N, 3, 3) float64
        The third component is the depth.
    """
    x, y, yaw, log_height, tilt, roll = poses.T
    c, s, cy, sy = np.cos(tilt), np.sin(tilt), np.cos(yaw), np.sin(yaw)
    cr, sr = np.cos(roll), np.sin(roll)
    # axes of a level camera in the map: right, down and ahead
    right = np.stack([sy, -cy, np.zeros_like(yaw)], axis=-1)
    down = np.stack([-s * cy, -s * sy, -c], axis=-1)
    ahead = np.stack([c * cy, c * sy, -s], axis=-1)
    rows = [
        cr[:, None] * right + sr[:, None] * down,
        -sr[:, None] * right + cr[:, None] * down,
        ahead,
    ]
    camera_from_map = np.stack(rows, axis=1)
    centre = np.stack([x, y, np.exp(log_height)], axis=-1)
    shift = -np.einsum("nij,nj->ni", camera_from_map, centre)
    return np.stack([camera_from_map[..., 0], camera_from_map[..., 1], shift], axis=-1)


def residuals(shared: Float, poses_i: Float, poses_j: Float, matches: Matches) -> Float:
    """Transfer errors in the pictures j, (N, 2), picture widths.

    Parameters
    ----------
    shared : (3,) float64
        See :data:`GLOBALS`.
    poses_i, poses_j : (N, 6) float64
        Poses of the two cameras of each match.
    matches : Matches
        What was seen.
    """
    focal, k1, k2 = float(np.exp(shared[0])), float(shared[1]), float(shared[2])
    rays = undistort(matches.points_i / focal, k1, k2)
    ones = np.column_stack([rays, np.ones(len(rays))])
    ground = np.einsum("nij,nj->ni", _inverse(ray_from_ground(poses_i)), ones)
    seen = np.einsum("nij,nj->ni", ray_from_ground(poses_j), ground)
    with np.errstate(divide="ignore", invalid="ignore"):
        mapped = seen[:, :2] / seen[:, 2:]
        error = focal * distort(mapped, k1, k2) - matches.points_j
    behind = ~(np.isfinite(error).all(axis=1) & (np.abs(error) < 10).all(axis=1))
    error[behind] = 10.0
    return np.asarray(error)


def _inverse(matrices: Float) -> Float:
    """Adjugates of (N, 3, 3): inverses up to scale, which homographies do not have."""
    a, b, c = matrices[:, 0], matrices[:, 1], matrices[:, 2]
    return np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=-1)


def jacobian(shared: Float, poses: Float, matches: Matches) -> tuple[Float, Float, Float, Float]:
    """Residuals and their derivatives by finite differences.

    Returns
    -------
    residual : (N, 2) float64
    by_shared : (N, 2, 3) float64
    by_i, by_j : (N, 2, 6) float64
        By the poses of the first and of the second camera of each match.
    """
    step = 1e-6
    poses_i, poses_j = poses[matches.camera_i], poses[matches.camera_j]
    base = residuals(shared, poses_i, poses_j, matches)
    unit = np.eye(POSE) * step
    by_shared = [
        residuals(shared + step * e, poses_i, poses_j, matches) - base for e in np.eye(GLOBALS)
    ]
    by_i = [residuals(shared, poses_i + e, poses_j, matches) - base for e in unit]
    by_j = [residuals(shared, poses_i, poses_j + e, matches) - base for e in unit]
    stacked = [np.stack(part, axis=-1) / step for part in (by_shared, by_i, by_j)]
    return base, stacked[0], stacked[1], stacked[2]
