"""How far a homography between two pictures moves ground pixels from where they belong."""

import numpy as np

from gvpipe.core.geometry.ground import pixel_from_plane
from gvpipe.core.geometry.homography import apply
from gvpipe.core.types import Camera, Float, Pose

GRID_PX = 8.0
"""Homographies are compared at ground pixels this far apart."""

RANGE_HEIGHTS = 8.0
"""Ground farther than this many camera heights away does not count: a pixel there is metres."""

LOST_PX = 1e9
"""Error of a pixel that a homography sends to its horizon."""

View = tuple[Camera, Pose]
"""A camera and map_from_camera, metres, the ground at z = 0."""


def ground_homography(i: View, j: View) -> Float:
    """Homography (3, 3) that takes pixels of i to pixels of j for the ground z = 0."""
    return np.asarray(pixel_from_plane(*j) @ np.linalg.inv(pixel_from_plane(*i)))


def common_ground(i: View, j: View) -> Float:
    """Pixels whose ground both cameras see.

    Parameters
    ----------
    i, j : (Camera, Pose)
        Two true views.

    Returns
    -------
    pixels : (N, 2) float64
        Of i, :data:`GRID_PX` apart; their ground is nearer than :data:`RANGE_HEIGHTS`.
    """
    (camera_i, pose_i), (camera_j, _) = i, j
    u, v = np.meshgrid(
        np.arange(0, camera_i.width, GRID_PX), np.arange(0, camera_i.height, GRID_PX)
    )
    pixels = np.column_stack([u.ravel(), v.ravel()])
    ground_from_i = np.linalg.inv(pixel_from_plane(*i)).astype(np.float64)
    below = pixels @ ground_from_i[2, :2] + ground_from_i[2, 2] > 1e-9
    pixels = pixels[below]
    points = apply(ground_from_i, pixels)
    pixel_from_ground = pixel_from_plane(*j)
    depth = points @ pixel_from_ground[2, :2] + pixel_from_ground[2, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        seen = apply(pixel_from_ground, points)
    last = [camera_j.width - 1, camera_j.height - 1]
    inside = (seen >= 0).all(axis=1) & (seen <= last).all(axis=1)
    away = np.linalg.norm(points - pose_i.translation[:2], axis=1)
    return pixels[(depth > 0) & inside & (away < RANGE_HEIGHTS * pose_i.translation[2])]


def homography_errors(homography: Float, i: View, j: View, pixels: Float) -> Float:
    """Distances in picture j between where pixels are sent and where they belong.

    Parameters
    ----------
    homography : (3, 3) float64
        Estimate, pixels of i to pixels of j.
    i, j : (Camera, Pose)
        The true views.
    pixels : (N, 2) float64
        Of i, on the ground, see :func:`common_ground`.

    Returns
    -------
    errors_px : (N,) float64
        :data:`LOST_PX` where the estimate gives no finite pixel.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        off = apply(homography, pixels) - apply(ground_homography(i, j), pixels)
        errors = np.linalg.norm(off, axis=1)
    return np.where(np.isfinite(errors), errors, LOST_PX)
