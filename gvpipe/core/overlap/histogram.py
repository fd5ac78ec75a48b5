"""Colour histograms of the ground and the distances between them."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.geometry.ground import overhead_grid, overhead_view
from gvpipe.core.kernels import histogram as kernels
from gvpipe.core.types import Float, Image, View

BINS = 64
"""Two leading bits of each channel: 16 (R >> 6) + 4 (G >> 6) + (B >> 6)."""

PIXELS_PER_HEIGHT = 60.0
"""Overhead raster of the histograms: pixels in one camera height. A histogram needs no detail,
and scaling with the height gives the same picture of the same scene at any scale."""

RANGE_HEIGHTS = 4.0
"""Ground farther than this many camera heights is left out: seen at less than 15 degrees, one
image row covers more ground than an obstacle, and the far field of two views seldom coincides."""

MEDIAN_LEVEL = 112.0
"""Grey level that the median of the ground is brought to, so that exposure does not count: near
the edge between two bins (128), where the spread of the ground is told from its brightness."""

ROW_BLOCK, COLUMN_BLOCK = 256, 2048
"""Histograms in one kernel call: a block of the second set (0.5 MB) stays in the cache."""

Distances = NDArray[np.float32]
Distance = Callable[[Float, Float], Distances]


def ground_histogram(view: View) -> Float:
    """Histogram of the ground a view sees, from straight above.

    Parameters
    ----------
    view : View
        Image, camera and how it was held.

    Returns
    -------
    histogram : (64,) float64
        Shares of the valid overhead pixels, sum 1, all brightened alike so that their median is
        the same in every view; all zero if the camera sees no ground.
    """
    scale = PIXELS_PER_HEIGHT / view.mount.height
    try:
        grid = overhead_grid(view.camera, view.mount, scale, RANGE_HEIGHTS * view.mount.height)
    except ValueError:  # looks above the horizon
        return np.zeros(BINS)
    pixels, seen = overhead_view(view.pixels, view.camera, view.mount, grid)
    return colour_histogram(_exposed(pixels, seen), seen)


def _exposed(pixels: Image, seen: NDArray[np.bool_]) -> Image:
    """Brighten or darken a picture to the common median."""
    if not seen.any():
        return pixels
    median = float(np.median(pixels[seen].mean(axis=1, dtype=np.float32)))
    levels = np.arange(256) * (MEDIAN_LEVEL / max(median, 1.0))
    return np.rint(levels).clip(0, 255).astype(np.uint8)[pixels]


def colour_histogram(pixels: Image, seen: NDArray[np.bool_]) -> Float:
    """Histogram of the marked pixels.

    Parameters
    ----------
    pixels : (H, W, 3) uint8
        RGB.
    seen : (H, W) bool
        Pixels to count.

    Returns
    -------
    histogram : (64,) float64
        Shares, sum 1; all zero if nothing is marked.
    """
    counts = kernels.count_colours(np.ascontiguousarray(pixels), seen).astype(np.float64)
    return counts / max(float(counts.sum()), 1.0)


def _in_blocks(block: Callable[..., None], h: Float, g: Float) -> Distances:
    """Run a kernel over blocks of the (n, m) matrix; memory beyond it stays bounded."""
    if h.ndim != 2 or g.ndim != 2 or h.shape[1] != g.shape[1] or h.shape[1] % 4:
        raise ValueError(
            f"histograms must be (n, bins) and (m, bins), bins of 4: {h.shape}, {g.shape}"
        )
    rows = np.ascontiguousarray(h, dtype=np.float32)
    out = np.empty((len(h), len(g)), dtype=np.float32)
    for c in range(0, len(g), COLUMN_BLOCK):
        columns = np.ascontiguousarray(g[c : c + COLUMN_BLOCK].T, dtype=np.float32)
        part = np.empty((ROW_BLOCK, columns.shape[1]), dtype=np.float32)
        for r in range(0, len(h), ROW_BLOCK):
            n = min(ROW_BLOCK, len(h) - r)
            block(rows[r : r + n], columns, part[:n])
            out[r : r + n, c : c + columns.shape[1]] = part[:n]
    return out


def absolute_distance(h: Float, g: Float) -> Distances:
    """Sum of absolute differences (thesis Table 4.3).

    Parameters
    ----------
    h, g : (n, 64), (m, 64) float64
        Histograms.

    Returns
    -------
    distances : (n, m) float32
        In [0, 2] for unit sums.

    Raises
    ------
    ValueError
        If the shapes do not fit.
    """
    return _in_blocks(kernels.absolute_block, h, g)


def squared_distance(h: Float, g: Float) -> Distances:
    """Sum of squared differences (thesis Table 4.3), (n, m) float32 in [0, 2] for unit sums.

    Parameters and errors as in :func:`absolute_distance`.
    """
    return _in_blocks(kernels.squared_block, h, g)


def intersection_distance(h: Float, g: Float) -> Distances:
    """Share of g that h does not cover, ``sum(g - min(h, g)) / sum(g)`` (thesis Table 4.3).

    Returns (n, m) float32 in [0, 1]; 1 where g is empty. Symmetric, and half the absolute
    distance, if both sums are one. Parameters and errors as in :func:`absolute_distance`.
    """
    uncovered = _in_blocks(kernels.intersection_block, h, g)
    totals = g.sum(axis=1).astype(np.float32)
    empty = totals <= 0
    uncovered /= np.where(empty, np.float32(1.0), totals)[None, :]
    uncovered[:, empty] = 1.0
    return uncovered


def chi2_distance(h: Float, g: Float) -> Distances:
    """``sum((h - m)^2 / m)`` with ``m = (h + g) / 2`` and 0/0 = 0 (thesis Table 4.3).

    Returns (n, m) float32 in [0, 1] for unit sums. Parameters and errors as in
    :func:`absolute_distance`.
    """
    return _in_blocks(kernels.chi2_block, h, g)


DISTANCES: dict[str, Distance] = {
    "absolute": absolute_distance,
    "squared": squared_distance,
    "intersection": intersection_distance,
    "chi2": chi2_distance,
}
"""Distance functions by their name in the configuration: (n, 64), (m, 64) to (n, m)."""
