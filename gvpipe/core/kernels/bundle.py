"""Normal equations of cameras over a plane, the ground points eliminated."""

import numpy as np

from gvpipe.core.kernels.jit import kernel
from gvpipe.core.types import Float, Index

MIN_DEPTH = 1e-3
"""Observations whose point lies nearer to the camera plane than this, metres, count as behind."""

BEHIND_PX2 = 1e8
"""Squared residual of a point behind its camera, which has no projection, squared pixels."""


@kernel
def _misfit(
    projection: Float,
    centre: Float,
    camera: Index,
    pixel: Float,
    start: Index,
    weight: Float,
    points: Float,
    track: int,
) -> float:
    """Weighted sum of the squared residuals of one point, squared pixels, see `evaluate`."""
    total = 0.0
    for k in range(start[track], start[track + 1]):
        i = camera[k]
        g = projection[i]
        dx = points[track, 0] - centre[i, 0]
        dy = points[track, 1] - centre[i, 1]
        dz = -centre[i, 2]
        w = g[2, 0] * dx + g[2, 1] * dy + g[2, 2] * dz
        if w < MIN_DEPTH:
            total += BEHIND_PX2
        else:
            u = (g[0, 0] * dx + g[0, 1] * dy + g[0, 2] * dz) / w - pixel[k, 0]
            v = (g[1, 0] * dx + g[1, 1] * dy + g[1, 2] * dz) / w - pixel[k, 1]
            total += u * u + v * v
    return total * weight[track]


@kernel
def evaluate(
    projection: Float,
    centre: Float,
    camera: Index,
    pixel: Float,
    start: Index,
    weight: Float,
    points: Float,
    loss_px: float,
    misfits: Float,
) -> float:
    """Robust cost of all points; their sums of squared residuals go into `misfits`.

    Parameters
    ----------
    projection : (N, 3, 3) float64
        ``K R`` with R the rotation from map to camera axes.
    centre : (N, 3) float64
        Camera centres in the map, metres.
    camera : (M,) int64
        Camera of each observation.
    pixel : (M, 2) float64
        Observed pixels.
    start : (T + 1,) int64
        Observations ``start[t]:start[t + 1]`` see point t.
    weight : (T,) float64
        Factor on the squared residuals of a point.
    points : (T, 2) float64
        Ground points in the map, metres.
    loss_px : float
        Scale c of the Cauchy loss ``k log(1 + e / k)`` of the misfit e of a point seen n times,
        ``k = (n - 1) c^2``, pixels.
    misfits : (T,) float64
        Output, squared pixels.

    Returns
    -------
    cost : float
        Sum of the losses, squared pixels.

    Notes
    -----
    The loss acts on points, not on single observations: two residuals of a point seen twice share
    one discrepancy, and a loss on each would favour to put all of it on one side.
    """
    cost = 0.0
    for t in range(len(start) - 1):
        misfits[t] = _misfit(projection, centre, camera, pixel, start, weight, points, t)
        bound = loss_px * loss_px * (start[t + 1] - start[t] - 1)
        cost += bound * np.log1p(misfits[t] / bound)
    return cost


@kernel
def _differentiate(
    projection: Float, turned: Float, centre: Float, x: float, y: float, pixel: Float, out: Float
) -> float:
    """Differentiate a projected point by the six unknowns of its camera and by its place.

    Rows of `out` (9, 2): these eight, then the residual; zero behind the camera. Returns the
    squared residual.
    """
    g, z = projection, -centre[2]
    x, y = x - centre[0], y - centre[1]
    depth = g[2, 0] * x + g[2, 1] * y + g[2, 2] * z
    if depth < MIN_DEPTH:
        out[:] = 0.0
        return BEHIND_PX2
    s = 1.0 / depth
    u = (g[0, 0] * x + g[0, 1] * y + g[0, 2] * z) * s
    v = (g[1, 0] * x + g[1, 1] * y + g[1, 2] * z) * s
    for q in range(2):
        a, b = (g[0, q] - u * g[2, q]) * s, (g[1, q] - v * g[2, q]) * s
        out[q, 0], out[q, 1], out[6 + q, 0], out[6 + q, 1] = -a, -b, a, b
    for q in range(3):
        h = turned[q]
        by_w = h[2, 0] * x + h[2, 1] * y + h[2, 2] * z
        out[2 + q, 0] = (h[0, 0] * x + h[0, 1] * y + h[0, 2] * z - u * by_w) * s
        out[2 + q, 1] = (h[1, 0] * x + h[1, 1] * y + h[1, 2] * z - v * by_w) * s
    out[5, 0] = (g[0, 2] - u * g[2, 2]) * s * z
    out[5, 1] = (g[1, 2] - v * g[2, 2]) * s * z
    u, v = u - pixel[0], v - pixel[1]
    out[8, 0], out[8, 1] = u, v
    return float(u * u + v * v)


@kernel
def _point_normal(by: Float, w: float, inverse: Float, pull: Float) -> None:
    """Inverse normal matrix and gradient of a point from the derivatives of its observations."""
    a, b, c, pull[:] = 0.0, 0.0, 0.0, 0.0
    for d in by:
        a += w * (d[6, 0] * d[6, 0] + d[6, 1] * d[6, 1])
        b += w * (d[6, 0] * d[7, 0] + d[6, 1] * d[7, 1])
        c += w * (d[7, 0] * d[7, 0] + d[7, 1] * d[7, 1])
        pull[0] += w * (d[6, 0] * d[8, 0] + d[6, 1] * d[8, 1])
        pull[1] += w * (d[7, 0] * d[8, 0] + d[7, 1] * d[8, 1])
    determinant = a * c - b * b
    inverse[:] = 0.0
    if determinant > 0.0:
        inverse[0, 0], inverse[1, 1] = c / determinant, a / determinant
        inverse[0, 1] = inverse[1, 0] = -b / determinant


@kernel
def _reduce(
    camera: Index,
    pair_block: Index,
    w: float,
    by: Float,
    inverse: Float,
    pull: Float,
    coupling: Float,
    blocks: Float,
    gradient: Float,
) -> None:
    """Add what one point says about its cameras, the point eliminated, to their system."""
    reduced = np.empty((6, 2))
    pair = 0
    for a in range(len(camera)):
        for p in range(6):
            c0, c1 = w * by[a, p, 0], w * by[a, p, 1]
            coupling[a, p, 0] = c0 * by[a, 6, 0] + c1 * by[a, 6, 1]
            coupling[a, p, 1] = c0 * by[a, 7, 0] + c1 * by[a, 7, 1]
    for a in range(len(camera)):
        own, total, mine = blocks[pair_block[pair]], gradient[camera[a]], coupling[a]
        for p in range(6):
            c0, c1 = w * by[a, p, 0], w * by[a, p, 1]
            r0 = mine[p, 0] * inverse[0, 0] + mine[p, 1] * inverse[1, 0]
            r1 = mine[p, 0] * inverse[0, 1] + mine[p, 1] * inverse[1, 1]
            reduced[p, 0], reduced[p, 1] = r0, r1
            total[p] += c0 * by[a, 8, 0] + c1 * by[a, 8, 1] - r0 * pull[0] - r1 * pull[1]
            for q in range(p, 6):
                own[p, q] += c0 * by[a, q, 0] + c1 * by[a, q, 1] - r0 * mine[q, 0] - r1 * mine[q, 1]
        pair += 1
        for b in range(a + 1, len(camera)):
            block, other = blocks[pair_block[pair]], coupling[b]
            for p in range(6):
                r0, r1 = reduced[p, 0], reduced[p, 1]
                for q in range(6):
                    block[p, q] -= r0 * other[q, 0] + r1 * other[q, 1]
            pair += 1


@kernel
def linearise(
    projection: Float,
    turned: Float,
    centre: Float,
    camera: Index,
    pixel: Float,
    start: Index,
    weight: Float,
    points: Float,
    loss_px: float,
    pair_block: Index,
    blocks: Float,
    gradient: Float,
    coupling: Float,
    point_inverse: Float,
    point_gradient: Float,
) -> None:
    """Gauss-Newton system of the cameras with every ground point eliminated (Schur complement).

    The first nine arguments are those of :func:`evaluate`; `turned` (N, 3, 3, 3) holds the
    derivatives of `projection` by heading and the two leans.

    Parameters
    ----------
    pair_block : (P,) int64
        Block of each pair of observations of a point, first <= second, the second fastest.
    blocks : (B, 6, 6) float64
        Output, zero on entry: blocks of the reduced normal matrix, rows of the first camera,
        columns of the second; of those on the diagonal the upper half.
    gradient : (N, 6) float64
        Output, zero on entry: reduced gradient (derivative of half the cost).
    coupling : (M, 6, 2) float64
        Output: weighted product of camera and point Jacobians of each observation.
    point_inverse : (T, 2, 2), point_gradient : (T, 2) float64
        Output: inverse normal matrix and gradient of each point.

    Notes
    -----
    Camera unknowns are x, y, heading, lean about the left axis, lean about the forward axis and
    the logarithm of the height; weights are those of iteratively reweighted least squares.
    """
    longest = 0
    for t in range(len(start) - 1):
        longest = max(longest, start[t + 1] - start[t])
    by = np.zeros((longest, 9, 2))
    pair = 0
    for t in range(len(start) - 1):
        first, last = start[t], start[t + 1]
        x, y, total = points[t, 0], points[t, 1], 0.0
        for k in range(first, last):
            i, d = camera[k], by[k - first]
            total += _differentiate(projection[i], turned[i], centre[i], x, y, pixel[k], d)
        bound = loss_px * loss_px * (last - first - 1)
        w = weight[t] / (1.0 + weight[t] * total / bound)
        inverse, pull = point_inverse[t], point_gradient[t]
        _point_normal(by[: last - first], w, inverse, pull)
        pairs = (last - first) * (last - first + 1) // 2
        _reduce(
            camera[first:last],
            pair_block[pair : pair + pairs],
            w,
            by,
            inverse,
            pull,
            coupling[first:last],
            blocks,
            gradient,
        )
        pair += pairs


@kernel
def move_points(
    camera: Index,
    start: Index,
    points: Float,
    step: Float,
    coupling: Float,
    point_inverse: Float,
    point_gradient: Float,
) -> Float:
    """Ground points that follow a step of the cameras: back-substitution.

    Parameters
    ----------
    step : (N, 6) float64
        Step of the cameras; the other arguments are those of :func:`linearise`.

    Returns
    -------
    moved : (T, 2) float64
    """
    moved = points.copy()
    for t in range(len(start) - 1):
        g0, g1 = point_gradient[t, 0], point_gradient[t, 1]
        for k in range(start[t], start[t + 1]):
            s = step[camera[k]]
            for p in range(6):
                g0 += coupling[k, p, 0] * s[p]
                g1 += coupling[k, p, 1] * s[p]
        moved[t, 0] -= point_inverse[t, 0, 0] * g0 + point_inverse[t, 0, 1] * g1
        moved[t, 1] -= point_inverse[t, 1, 0] * g0 + point_inverse[t, 1, 1] * g1
    return moved
