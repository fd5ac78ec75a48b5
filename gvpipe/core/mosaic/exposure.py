"""Brightness of the views against each other: exposure of each, vignetting of each camera."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, eye_array
from scipy.sparse.linalg import spsolve

from gvpipe.core.types import Float

ROBUST = 0.05
"""Log brightness beyond which two views of a spot rather differ by an obstacle or by gloss."""

PRIOR_WEIGHT = 0.1
"""Pull of each exposure towards 1, in spots: holds views that share too little with others."""

ROUNDS = 8
"""Rounds of reweighting; the weights settle in about five."""


@dataclass(frozen=True)
class Exposure:
    """How brighter a view is than it should be.

    Attributes
    ----------
    log_gain : (n,) float64
        Logarithm of each view's exposure against the mean of all.
    falloff : (n,) float64
        Logarithm of the brightness one `radius` (half the image width) away from the image
        centre against that in the centre, about -0.1; the same for all views of a camera.
    """

    log_gain: Float
    falloff: Float


@dataclass(frozen=True)
class Spots:
    """Ground seen by two views.

    Attributes
    ----------
    views : (N, 2) int
        The two views of each spot.
    log_ratio : (N,) float64
        Logarithm of its brightness in the first over that in the second.
    radii : (N, 2) float64
        Squared distances from the image centre in the two views, in half image widths.
    weight : (N,) float64
        How alike the two show it and what is beside it, but for their exposures; 0 to 1.
    """

    views: NDArray[np.intp]
    log_ratio: Float
    radii: Float
    weight: Float

    @classmethod
    def joined(cls, parts: Iterable["Spots"]) -> "Spots":
        """Spots of several places."""
        none = cls(np.empty((0, 2), np.intp), np.empty(0), np.empty((0, 2)), np.empty(0))
        every = [none, *parts]
        return cls(
            np.concatenate([s.views for s in every]),
            np.concatenate([s.log_ratio for s in every]),
            np.concatenate([s.radii for s in every]),
            np.concatenate([s.weight for s in every]),
        )


def balance(spots: Spots, camera_of: NDArray[np.intp]) -> Exposure:
    """Estimate exposures and vignetting from spots of ground seen by two views.

    Parameters
    ----------
    spots : Spots
        Some of them show an obstacle in one view or in both.
    camera_of : (n,) int
        Camera of each view, counted from 0.

    Returns
    -------
    exposure : Exposure
        Robust least squares (iteratively reweighted, Cauchy: even where most of what two views
        share is an obstacle in one of them, it counts for little in the end).
    """
    (first, second), radii = spots.views.T, spots.radii
    n, cameras = len(camera_of), int(camera_of.max(initial=-1)) + 1
    rows = np.repeat(np.arange(len(first)), 4)
    columns = np.column_stack([first, second, n + camera_of[first], n + camera_of[second]])
    values = np.column_stack([np.ones(len(first)), -np.ones(len(first)), radii[:, 0], -radii[:, 1]])
    shape = (len(first), n + cameras)
    design = csr_array((values.ravel(), (rows, columns.ravel())), shape=shape)
    prior = PRIOR_WEIGHT * eye_array(n + cameras)
    x: Float = np.zeros(n + cameras)
    weight = spots.weight
    for _ in range(ROUNDS):
        weighted = design.T.multiply(weight).tocsr()
        x = np.asarray(spsolve((weighted @ design + prior).tocsc(), weighted @ spots.log_ratio))
        residual = design @ x - spots.log_ratio
        weight = spots.weight / (1.0 + (residual / ROBUST) ** 2)
    return Exposure(log_gain=x[:n], falloff=x[n:][camera_of])
