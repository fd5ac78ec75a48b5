"""Cameras of one unknown calibration over one plane: how their pictures map onto each other."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.types import Float

GLOBALS = 3
"""Unknowns that all cameras share: logarithm of the focal length, and two of radial distortion."""

POSE = 6
"""Unknowns of one camera: x, y, yaw, logarithm of the height, tilt, roll."""

UNDISTORTION_STEPS = 5
"""Newton steps along the radius: exact to rounding for lenses that bend by a tenth."""

LEAST_SLOPE = 0.2
"""Where a lens would fold the picture back, steps are kept from running away."""

FARTHEST = 10.0
"""Error of points that fall behind a camera, picture widths: no weight is left at that."""

MOST = 1e13
"""Focal length, height and position that a step gone astray is kept within, so that products of
them are numbers; such cameras have no weight left."""


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
    found = np.linalg.norm(points, axis=1, keepdims=True)
    radius = found
    for _ in range(UNDISTORTION_STEPS):
        r2 = radius**2
        slope = np.maximum(1 + 3 * k1 * r2 + 5 * k2 * r2**2, LEAST_SLOPE)
        step = (radius * (1 + k1 * r2 + k2 * r2**2) - found) / slope
        radius = np.clip(radius - step, 0.0, 3.0 * found)
    return np.asarray(points * np.divide(radius, found, out=np.ones_like(found), where=found > 0))


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
    centre = np.stack([np.clip(x, -MOST, MOST), np.clip(y, -MOST, MOST), _exp(log_height)], -1)
    shift = -np.einsum("nij,nj->ni", camera_from_map, centre)
    return np.stack([camera_from_map[..., 0], camera_from_map[..., 1], shift], axis=-1)


def residuals(shared: Float, poses: Float, matches: Matches) -> Float:
    """Transfer errors in the pictures j, (N, 2), picture widths.

    Parameters
    ----------
    shared : (3,) float64
        See :data:`GLOBALS`.
    poses : (M, 6) float64
        See :data:`POSE`.
    matches : Matches
        What was seen.

    Returns
    -------
    errors : (N, 2) float64
        :data:`FARTHEST` where a point falls behind a camera.
    """
    forward = ray_from_ground(poses)
    ground = _apply(_inverse(forward)[matches.camera_i], _rays(shared, matches))
    return _errors(shared, forward[matches.camera_j], ground, matches)


def jacobian(shared: Float, poses: Float, matches: Matches) -> tuple[Float, Float, Float, Float]:
    """Residuals and their derivatives by finite differences.

    Parameters
    ----------
    shared, poses, matches
        As for :func:`residuals`.

    Returns
    -------
    residual : (N, 2) float64
    by_shared : (N, 2, 3) float64
    by_i, by_j : (N, 2, 6) float64
        By the poses of the first and of the second camera of each match.
    """
    step = 1e-6
    i, j = matches.camera_i, matches.camera_j
    forward = ray_from_ground(poses)
    backward_i, forward_j = _inverse(forward)[i], forward[j]
    rays = _rays(shared, matches)
    ground = _apply(backward_i, rays)
    base = _errors(shared, forward_j, ground, matches)
    by_shared = []
    for unit in np.eye(GLOBALS):
        moved = shared + step * unit
        moved_ground = _apply(backward_i, _rays(moved, matches))
        by_shared.append(_errors(moved, forward_j, moved_ground, matches))
    by_i, by_j = [], []
    for unit in np.eye(POSE):
        moved_forward = ray_from_ground(poses + step * unit)
        moved_ground = _apply(_inverse(moved_forward)[i], rays)
        by_i.append(_errors(shared, forward_j, moved_ground, matches))
        by_j.append(_errors(shared, moved_forward[j], ground, matches))
    derivatives = [
        (np.stack(part, axis=-1) - base[..., None]) / step for part in (by_shared, by_i, by_j)
    ]
    return base, derivatives[0], derivatives[1], derivatives[2]


def by_centre(shared: Float, poses: Float, matches: Matches) -> Float:
    """Differentiate the residuals by the principal point, (N, 2, 2)."""
    step = 1e-5
    base = residuals(shared, poses, matches)
    columns = []
    for shift in step * np.eye(2):
        moved = replace(
            matches, points_i=matches.points_i - shift, points_j=matches.points_j - shift
        )
        columns.append((residuals(shared, poses, moved) - base) / step)
    return np.stack(columns, axis=-1)


def _rays(shared: Float, matches: Matches) -> Float:
    """Rays of the points in pictures i, (N, 3)."""
    rays = undistort(matches.points_i / _exp(shared[0]), shared[1], shared[2])
    return np.column_stack([rays, np.ones(len(rays))])


def _errors(shared: Float, forward_j: Float, ground: Float, matches: Matches) -> Float:
    """Distance of ground points, seen by cameras j, from where they were found, (N, 2)."""
    seen = _apply(forward_j, ground)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        mapped = seen[:, :2] / seen[:, 2:]
        error = _exp(shared[0]) * distort(mapped, shared[1], shared[2]) - matches.points_j
    behind = ~(np.isfinite(error).all(axis=1) & (np.abs(error) < FARTHEST).all(axis=1))
    error[behind] = FARTHEST
    return np.asarray(error)


def _exp(logarithm: Float) -> Float:
    """Exponential, from 1 / MOST to MOST."""
    return np.exp(np.clip(logarithm, -np.log(MOST), np.log(MOST)))


def _apply(matrices: Float, vectors: Float) -> Float:
    """Products of (N, 3, 3) and (N, 3)."""
    return np.einsum("nij,nj->ni", matrices, vectors)


def _inverse(matrices: Float) -> Float:
    """Adjugates of (N, 3, 3): inverses up to scale, which homographies do not have."""
    a, b, c = matrices[:, 0], matrices[:, 1], matrices[:, 2]
    return np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=-1)
