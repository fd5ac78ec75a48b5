"""How far matches are from where a geometry takes them, link by link.

Matches of all links lie one after the other: those of link e are ``start[e]:start[e + 1]``, pixels
p (M, 2) in image i and q (M, 2) in image j.
"""

import numpy as np

from gvpipe.core.kernels.jit import kernel
from gvpipe.core.types import Float, Index


@kernel
def median_miss(h: Float, p: Float, q: Float) -> float:
    """Median distance between mapped points and their partners; infinite for one on the horizon."""
    miss = np.empty(len(p))
    for k in range(len(p)):
        w = h[2, 0] * p[k, 0] + h[2, 1] * p[k, 1] + h[2, 2]
        u = (h[0, 0] * p[k, 0] + h[0, 1] * p[k, 1] + h[0, 2]) / w - q[k, 0]
        v = (h[1, 0] * p[k, 0] + h[1, 1] * p[k, 1] + h[1, 2]) / w - q[k, 1]
        miss[k] = np.sqrt(u * u + v * v)
        if not np.isfinite(miss[k]):
            miss[k] = np.inf
    return float(np.median(miss))


@kernel
def median_misses(start: Index, p: Float, q: Float, h: Float, which: Index) -> Float:
    """:func:`median_miss` of some links, (W,), under homographies (W, 3, 3)."""
    out = np.empty(len(which))
    for n in range(len(which)):
        here = slice(start[which[n]], start[which[n] + 1])
        out[n] = median_miss(h[n], p[here], q[here])
    return out


@kernel
def median_gaps(
    start: Index, p: Float, q: Float, map_from_i: Float, map_from_j: Float, which: Index
) -> Float:
    """Median distances (W,) between the ground points of both pixels of each match, metres.

    Homographies (W, 3, 3) take pixels of either image to the ground.
    """
    out = np.empty(len(which))
    for n in range(len(which)):
        first, last = start[which[n]], start[which[n] + 1]
        gap = np.empty(last - first)
        a, b = map_from_i[n], map_from_j[n]
        for k in range(first, last):
            w = a[2, 0] * p[k, 0] + a[2, 1] * p[k, 1] + a[2, 2]
            v = b[2, 0] * q[k, 0] + b[2, 1] * q[k, 1] + b[2, 2]
            square = 0.0
            for r in range(2):
                here = (a[r, 0] * p[k, 0] + a[r, 1] * p[k, 1] + a[r, 2]) / w
                there = (b[r, 0] * q[k, 0] + b[r, 1] * q[k, 1] + b[r, 2]) / v
                square += (here - there) ** 2
            gap[k - first] = np.sqrt(square) if np.isfinite(square) else np.inf
        out[n] = np.median(gap)
    return out
