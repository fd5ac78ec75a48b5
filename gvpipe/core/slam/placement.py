"""Where two robots stand relative to each other, from matched pixels and how cameras are held."""

from dataclasses import dataclass

import numpy as np

from gvpipe.core.geometry.ground import ground_points
from gvpipe.core.types import Camera, Float, Mount

REWEIGHTINGS = 10
"""Rounds of reweighted least squares of an isometry; it settles in about five."""


@dataclass(frozen=True)
class Placement:
    """Isometry between the ground frames of two robots, as seen by one link.

    Attributes
    ----------
    centre_i, centre_j : (2,) float64
        Centroid of the shared ground points in either robot frame, metres.
    turn : float
        Heading of i minus heading of j, radians.
    radius : float
        RMS distance of the points from their centroid, metres.
    misfit : float
        Robust RMS distance between the points of j and those of i brought over, metres.
    """

    centre_i: Float
    centre_j: Float
    turn: float
    radius: float
    misfit: float


def place(
    points_i: Float, points_j: Float, cameras: tuple[Camera, Camera], mounts: tuple[Mount, Mount]
) -> Placement | None:
    """Fit the isometry between two robots' ground frames to matched pixels (thesis 3.3.4).

    Parameters
    ----------
    points_i, points_j : (N, 2) float64
        Matched pixels.
    cameras, mounts : pair of Camera, pair of Mount
        The views.

    Returns
    -------
    placement : Placement or None
        Reweighted least squares; None if fewer than three matches lie below both horizons.
    """
    ground_i, below_i = ground_points(points_i, cameras[0], mounts[0])
    ground_j, below_j = ground_points(points_j, cameras[1], mounts[1])
    both = below_i & below_j
    if both.sum() < max(3, len(both) // 2):
        return None
    a, b = ground_i[both], ground_j[both]
    weight = 1.0 / (1.0 + (a**2).sum(axis=1) / mounts[0].height ** 2)
    base = weight
    for _ in range(REWEIGHTINGS):
        share = weight / weight.sum()
        ca, cb = share @ a, share @ b
        da, db = a - ca, b - cb
        cross = share @ (da[:, 0] * db[:, 1] - da[:, 1] * db[:, 0])
        turn = float(np.arctan2(cross, share @ (da * db).sum(axis=1)))
        c, s = np.cos(turn), np.sin(turn)
        miss_sq = ((da - db @ np.array([[c, -s], [s, c]])) ** 2).sum(axis=1)
        scale_sq = 4.0 * np.median(miss_sq) + 1e-12
        weight = base / (1.0 + miss_sq / scale_sq)
    share = weight / weight.sum()
    return Placement(
        ca, cb, turn, float(np.sqrt(share @ (da**2).sum(axis=1))), float(np.sqrt(share @ miss_sq))
    )
