"""Smoothing of cells of which some are not seen."""

import cv2
import numpy as np
from numpy.typing import NDArray

LIGHT_CELLS = 2.0
"""Deviation of the smoothing of the light, cells: its steps at the edges of views become too
gentle to see."""

Single = NDArray[np.float32]


def mean_around(values: Single, seen: NDArray[np.bool_], reach: int) -> Single:
    """Mean over the seen cells within `reach` of each cell, view by view; (h, w, n).

    Parameters
    ----------
    values : (h, w, n) float32
        Cells by views.
    seen : (h, w, n) bool
        Which count.
    reach : int
        Cells each way.

    Returns
    -------
    means : (h, w, n) float32
        Of the square window; 0 where no cell in it is seen.
    """
    size = (2 * reach + 1, 2 * reach + 1)
    out = np.empty_like(values)
    for k in range(values.shape[2]):
        here = np.ascontiguousarray(seen[..., k], dtype=np.float32)
        filled = np.where(seen[..., k], values[..., k], np.float32(0.0))
        share = np.maximum(cv2.blur(here, size), np.float32(1e-6))
        out[..., k] = cv2.blur(filled, size) / share
    return out


def smooth_light(light: Single) -> Single:
    """Gaussian mean of the known cells around each cell; 1 where none is."""
    known = np.isfinite(light).astype(np.float32)
    size = (0, 0)
    share = cv2.GaussianBlur(known, size, LIGHT_CELLS)
    total = cv2.GaussianBlur(np.where(known > 0, light, np.float32(0.0)), size, LIGHT_CELLS)
    return np.divide(total, share, out=np.ones_like(light), where=share > 1e-6)
