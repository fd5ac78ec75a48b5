"""Where two robots stand relative to each other, from matched pixels and how cameras are held."""

from dataclasses import dataclass

import numpy as np

from gvpipe.core.kernels.links import ground_from_pixel, place_pair
from gvpipe.core.types import Camera, Float, Mount

REWEIGHTINGS = 9
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
    ground_i, ground_j = (
        ground_from_pixel(m.tilt, m.roll, m.height, c.inverse)
        for c, m in zip(cameras, mounts, strict=True)
    )
    found = place_pair(
        np.ascontiguousarray(points_i, dtype=np.float64),
        np.ascontiguousarray(points_j, dtype=np.float64),
        ground_i,
        ground_j,
        mounts[0].height,
        REWEIGHTINGS,
    )
    if not np.isfinite(found[0]):
        return None
    turn, radius, misfit = found[4:].tolist()
    return Placement(found[:2], found[2:4], turn, radius, misfit)
