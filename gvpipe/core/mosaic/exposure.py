"""Brightness of the views against each other: exposure of each, vignetting of each camera."""

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


def balance(
    first: NDArray[np.intp],
    second: NDArray[np.intp],
    log_ratio: Float,
    radii: Float,
    camera_of: NDArray[np.intp],
) -> Exposure:
    """Estimate exposures and vignetting from spots of ground seen by two views.

    Parameters
    ----------
    first, second : (N,) int
        Views of each spot.
    log_ratio : (N,) float64
        Logarithm of its brightness in the first over that in the second.
    radii : (N, 2) float64
        Squared distances from the image centre in the two views, in half image widths.
    camera_of : (n,) int
        Camera of each view, counted from 0.

    Returns
    -------
    exposure : Exposure
        Robust least squares (iteratively reweighted, Huber).
    """
    n, cameras = len(camera_of), int(camera_of.max(initial=-1)) + 1
    rows = np.repeat(np.arange(len(first)), 4)
    columns = np.column_stack([first, second, n + camera_of[first], n + camera_of[second]])
    values = np.column_stack([np.ones(len(first)), -np.ones(len(first)), radii[:, 0], -radii[:, 1]])
    shape = (len(first), n + cameras)
    design = csr_array((values.ravel(), (rows, columns.ravel())), shape=shape)
    prior = PRIOR_WEIGHT * eye_array(n + cameras)
    x: Float = np.zeros(n + cameras)
    weight: Float = np.ones(len(first))
    for _ in range(ROUNDS):
        weighted = design.T.multiply(weight).tocsr()
        x = np.asarray(spsolve((weighted @ design + prior).tocsc(), weighted @ log_ratio))
        residual = np.abs(design @ x - log_ratio)
        weight = np.asarray(1.0 / np.maximum(1.0, residual / ROBUST), dtype=np.float64)
    return Exposure(log_gain=x[:n], falloff=x[n:][camera_of])
