"""Guided matching in the original pictures: transfer, search nearby, refit, look closer."""

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.geometry.homography import apply, fit_linear, transfer_errors
from gvpipe.core.geometry.twoview import PairPrior, TwoView, fit_two_views
from gvpipe.core.kernels.matching import guided_neighbours
from gvpipe.core.types import Camera, Float

WINDOWS_PX = (40.0, 25.0, 16.0, 10.0, 6.0, 4.0, 3.0, 3.0)
"""Half sides of the search window, shrinking as the homography gets better."""


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
) -> TwoView | None:
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
    geometry : TwoView or None
        None when fewer than four corners agree or they fix no homography.
    """
    geometry = start
    for window in WINDOWS_PX:
        mapped = apply(geometry.homography, pixels_i)
        partner = guided_neighbours(mapped, pixels_j, distance, window, max_distance)
        p, q = pixels_i[partner >= 0], pixels_j[partner[partner >= 0]]
        if len(p) < 4:
            return None
        geometry = fit_two_views(geometry, expected, prior, p, q, loss=window / 2).geometry
    near = transfer_errors(geometry.homography, p, q) < WINDOWS_PX[-1]
    return geometry if fit_linear(p[near], q[near]) is not None else None
