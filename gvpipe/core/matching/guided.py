"""Guided matching in the original pictures: transfer, search nearby, refit, look closer."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.geometry.homography import apply, fit_linear, refine, transfer_errors
from gvpipe.core.geometry.twoview import PairPrior, TwoView, fit_two_views
from gvpipe.core.kernels.matching import guided_neighbours
from gvpipe.core.types import Camera, Float

WINDOWS_PX = (40.0, 25.0, 16.0, 10.0, 6.0, 4.0, 3.0, 3.0)
"""Half sides of the search window, shrinking as the homography gets better."""


@dataclass(frozen=True)
class Guided:
    """What guided matching settled on.

    Attributes
    ----------
    geometry : TwoView
        Fitted to the inliers.
    homography : (3, 3) float64
        Linear fit and nonlinear least squares of the inliers alone.
    inlier_i, inlier_j : (K,) int64
        Indices of the matched corners.
    offered : int
        Corners of i whose transfer falls into image j.
    """

    geometry: TwoView
    homography: Float
    inlier_i: NDArray[np.int64]
    inlier_j: NDArray[np.int64]
    offered: int


def in_view(points: Float, camera: Camera) -> NDArray[np.bool_]:
    """(N,) whether pixels lie in the image."""
    with np.errstate(invalid="ignore"):
        return np.asarray(
            (points[:, 0] >= 0)
            & (points[:, 0] <= camera.width - 1)
            & (points[:, 1] >= 0)
            & (points[:, 1] <= camera.height - 1)
        )


def guided_match(
    start: TwoView,
    expected: TwoView,
    prior: PairPrior,
    pixels_i: Float,
    pixels_j: Float,
    distance: Float,
    max_distance: float,
) -> Guided | None:
    """Refine a first geometry with corners of the original pictures (thesis 3.4).

    Parameters
    ----------
    start, expected : TwoView
        First estimate, and the configured geometry around which `prior` holds.
    prior : PairPrior
        Error of the configuration.
    pixels_i, pixels_j : (N, 2), (M, 2) float64
        Corners.
    distance : (N, M) float64
        Distances of their invariants, gated by `max_distance`.

    Returns
    -------
    guided : Guided or None
        None when fewer than four corners agree or they fix no homography.
    """
    geometry, homography = start, start.homography
    for window in WINDOWS_PX:
        mapped = apply(homography, pixels_i)
        partner = guided_neighbours(mapped, pixels_j, distance, window, max_distance)
        index_i = np.flatnonzero(partner >= 0)
        index_j = partner[index_i]
        if len(index_i) < 4:
            return None
        p, q = pixels_i[index_i], pixels_j[index_j]
        geometry = fit_two_views(geometry, expected, prior, p, q, loss=window / 2).geometry
        homography = geometry.homography
    keep = transfer_errors(homography, p, q) < WINDOWS_PX[-1]
    index_i, index_j = index_i[keep], index_j[keep]
    linear = fit_linear(pixels_i[index_i], pixels_j[index_j])
    if linear is None:
        return None
    homography = refine(linear, pixels_i[index_i], pixels_j[index_j]).homography
    offered = int(in_view(mapped, start.camera_j).sum())
    return Guided(geometry, homography, index_i, index_j, offered)
