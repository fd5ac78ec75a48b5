"""Distances between many histograms at once.

Histograms h are (N, bins) float32, those they are compared with, `g_columns`, (bins, M) float32,
and `out` is (N, M) float32. The inner loops run over the columns, so that they vectorise without
reordering any sum: results are the same on every machine and for every block size.
"""

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.kernels.jit import kernel

Single = NDArray[np.float32]

TINY = np.float32(1e-12)
"""Keeps 0/0 at 0; far below one pixel's share of a histogram."""


@kernel
def count_colours(pixels: NDArray[np.uint8], seen: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Count the seen pixels by the two leading bits of each colour channel."""
    counts = np.zeros(64, dtype=np.int64)
    for v in range(pixels.shape[0]):
        for u in range(pixels.shape[1]):
            if seen[v, u]:
                r, g, b = pixels[v, u, 0] >> 6, pixels[v, u, 1] >> 6, pixels[v, u, 2] >> 6
                counts[16 * r + 4 * g + b] += 1
    return counts


@kernel
def absolute_block(h: Single, g_columns: Single, out: Single) -> None:
    """Fill ``out[i, j]`` with the sum over the bins of ``|h_i - g_j|``; g is (bins, M)."""
    bins, m = g_columns.shape
    for i in range(h.shape[0]):
        row = out[i]
        row[:] = 0.0
        for k in range(0, bins, 4):
            h0, h1, h2, h3 = h[i, k], h[i, k + 1], h[i, k + 2], h[i, k + 3]
            g0, g1, g2, g3 = g_columns[k], g_columns[k + 1], g_columns[k + 2], g_columns[k + 3]
            for j in range(m):
                d0, d1, d2, d3 = h0 - g0[j], h1 - g1[j], h2 - g2[j], h3 - g3[j]
                row[j] += (max(d0, -d0) + max(d1, -d1)) + (max(d2, -d2) + max(d3, -d3))


@kernel
def squared_block(h: Single, g_columns: Single, out: Single) -> None:
    """Fill ``out[i, j]`` with the sum over the bins of ``(h_i - g_j)^2``; g is (bins, M)."""
    bins, m = g_columns.shape
    for i in range(h.shape[0]):
        row = out[i]
        row[:] = 0.0
        for k in range(0, bins, 4):
            h0, h1, h2, h3 = h[i, k], h[i, k + 1], h[i, k + 2], h[i, k + 3]
            g0, g1, g2, g3 = g_columns[k], g_columns[k + 1], g_columns[k + 2], g_columns[k + 3]
            for j in range(m):
                d0, d1, d2, d3 = h0 - g0[j], h1 - g1[j], h2 - g2[j], h3 - g3[j]
                row[j] += (d0 * d0 + d1 * d1) + (d2 * d2 + d3 * d3)


@kernel
def intersection_block(h: Single, g_columns: Single, out: Single) -> None:
    """Fill ``out[i, j]`` with the sum over the bins of ``g_j - min(h_i, g_j)``; g is (bins, M)."""
    bins, m = g_columns.shape
    zero = np.float32(0.0)
    for i in range(h.shape[0]):
        row = out[i]
        row[:] = 0.0
        for k in range(0, bins, 4):
            h0, h1, h2, h3 = h[i, k], h[i, k + 1], h[i, k + 2], h[i, k + 3]
            g0, g1, g2, g3 = g_columns[k], g_columns[k + 1], g_columns[k + 2], g_columns[k + 3]
            for j in range(m):
                row[j] += (max(g0[j] - h0, zero) + max(g1[j] - h1, zero)) + (
                    max(g2[j] - h2, zero) + max(g3[j] - h3, zero)
                )


@kernel
def chi2_block(h: Single, g_columns: Single, out: Single) -> None:
    """Fill ``out[i, j]`` with half the sum over the bins of ``(h - g)^2 / (h + g)``; g (bins, M).

    Two bins share one division, which is what the loop waits for.
    """
    bins, m = g_columns.shape
    half = np.float32(0.5)
    for i in range(h.shape[0]):
        row = out[i]
        row[:] = 0.0
        for k in range(0, bins, 4):
            h0, h1, h2, h3 = h[i, k], h[i, k + 1], h[i, k + 2], h[i, k + 3]
            g0, g1, g2, g3 = g_columns[k], g_columns[k + 1], g_columns[k + 2], g_columns[k + 3]
            for j in range(m):
                d0, d1, d2, d3 = h0 - g0[j], h1 - g1[j], h2 - g2[j], h3 - g3[j]
                s0, s1 = (h0 + g0[j]) + TINY, (h1 + g1[j]) + TINY
                s2, s3 = (h2 + g2[j]) + TINY, (h3 + g3[j]) + TINY
                row[j] += half * (
                    (d0 * d0 * s1 + d1 * d1 * s0) / (s0 * s1)
                    + (d2 * d2 * s3 + d3 * d3 * s2) / (s2 * s3)
                )
