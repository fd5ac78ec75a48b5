"""Matches of a link summed up in cells of its first picture.

Matches of all links lie one after the other: those of link e are ``start[e]:start[e + 1]``.
"""

import numpy as np

from gvpipe.core.kernels.jit import kernel
from gvpipe.core.types import Float, Index


@kernel
def gathered_cells(
    start: Index, p: Float, q: Float, which: Index, h: Float, cells: int, stray: float
) -> tuple[Index, Float, Float, Float]:
    """Sum the matches of some links up in cells of image i.

    A cell becomes one match: the mean pixel in i, and in j where the homography takes that, moved
    by the mean of the matches' departures from the homography.

    Parameters
    ----------
    start : (L + 1,) int64, p, q : (M, 2) float64
        Matches ``start[e]:start[e + 1]`` of link e: pixels in i and in j.
    which : (E,) int64
        The links.
    h : (E, 3, 3) float64
        Pixels of i to pixels of j, near enough to be affine within a cell.
    cells : int
        Cells each way over the box that a link's matches fill.
    stray : float
        Departures of more than this many medians are wrong matches and left out.

    Returns
    -------
    link : (C,) int64
        Link of each cell, as a place in `which`.
    points_i, points_j : (C, 2) float64
        Pixels.
    weight : (C,) float64
        Matches in it.
    """
    links = len(which)
    link = np.empty(links * cells * cells, dtype=np.int64)
    points_i, points_j = np.empty((len(link), 2)), np.empty((len(link), 2))
    weight = np.empty(len(link))
    total = np.empty((cells * cells, 5))
    count = 0
    for e in range(links):
        first, last = start[which[e]], start[which[e] + 1]
        n = last - first
        off, miss = np.empty((n, 2)), np.empty(n)
        a, b, g = p[first:last], q[first:last], h[e]
        low, high = np.full(2, np.inf), np.full(2, -np.inf)
        for k in range(n):
            w = g[2, 0] * a[k, 0] + g[2, 1] * a[k, 1] + g[2, 2]
            for r in range(2):
                off[k, r] = b[k, r] - (g[r, 0] * a[k, 0] + g[r, 1] * a[k, 1] + g[r, 2]) / w
                low[r], high[r] = min(low[r], a[k, r]), max(high[r], a[k, r])
            miss[k] = np.sqrt(off[k, 0] ** 2 + off[k, 1] ** 2)
        bound = stray * np.median(miss) if n else 0.0
        total[:] = 0.0
        for k in range(n):
            if not miss[k] <= bound:
                continue
            x = int(cells * (a[k, 0] - low[0]) / (high[0] - low[0] + 1e-9))
            y = int(cells * (a[k, 1] - low[1]) / (high[1] - low[1] + 1e-9))
            row = total[min(y, cells - 1) * cells + min(x, cells - 1)]
            row[0], row[1] = row[0] + a[k, 0], row[1] + a[k, 1]
            row[2], row[3] = row[2] + off[k, 0], row[3] + off[k, 1]
            row[4] += 1.0
        for row in total:
            if row[4] > 0.0:
                x, y = row[0] / row[4], row[1] / row[4]
                w = g[2, 0] * x + g[2, 1] * y + g[2, 2]
                link[count], weight[count] = e, row[4]
                points_i[count, 0], points_i[count, 1] = x, y
                for r in range(2):
                    mapped = (g[r, 0] * x + g[r, 1] * y + g[r, 2]) / w
                    points_j[count, r] = mapped + row[2 + r] / row[4]
                count += 1
    return link[:count], points_i[:count], points_j[:count], weight[:count]
