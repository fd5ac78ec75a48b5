"""Normal equations of cameras over a plane, the ground points eliminated."""

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.kernels.jit import kernel
from gvpipe.core.types import Float

Index = NDArray[np.int64]

MIN_DEPTH = 1e-3
"""Observations whose point lies nearer to the camera plane than this, metres, count as behind."""

BEHIND_PX2 = 1e8
"""Squared residual of a point behind its camera, which has no projection, squared pixels."""


@kernel
def misfit(
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
        misfits[t] = misfit(projection, centre, camera, pixel, start, weight, points, t)
        bound = loss_px * loss_px * (start[t + 1] - start[t] - 1)
        cost += bound * np.log1p(misfits[t] / bound)
    return cost


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
        Block of each pair of observations of a point, in the order of the loops below.
    blocks : (B, 6, 6) float64
        Output, zero on entry: upper blocks of the reduced normal matrix.
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
    jc = np.zeros((longest, 2, 6))
    jp = np.zeros((2, 2))
    reduced = np.zeros((6, 2))
    pair = 0
    for t in range(len(start) - 1):
        first, count = start[t], start[t + 1] - start[t]
        bound = loss_px * loss_px * (count - 1)
        total = misfit(projection, centre, camera, pixel, start, weight, points, t)
        track_weight = weight[t] / (1.0 + total / bound)
        v00, v01, v11 = 0.0, 0.0, 0.0
        g0, g1 = 0.0, 0.0
        pair_first = pair
        for a in range(count):
            k = first + a
            i = camera[k]
            g = projection[i]
            d = np.array([points[t, 0] - centre[i, 0], points[t, 1] - centre[i, 1], -centre[i, 2]])
            y0 = g[0, 0] * d[0] + g[0, 1] * d[1] + g[0, 2] * d[2]
            y1 = g[1, 0] * d[0] + g[1, 1] * d[1] + g[1, 2] * d[2]
            y2 = g[2, 0] * d[0] + g[2, 1] * d[1] + g[2, 2] * d[2]
            seen = y2 >= MIN_DEPTH
            y2 = max(y2, MIN_DEPTH)
            u, v = y0 / y2, y1 / y2
            r0, r1 = u - pixel[k, 0], v - pixel[k, 1]
            w = track_weight if seen else 0.0
            for q in range(2):
                jp[0, q] = (g[0, q] - u * g[2, q]) / y2
                jp[1, q] = (g[1, q] - v * g[2, q]) / y2
                jc[a, 0, q] = -jp[0, q]
                jc[a, 1, q] = -jp[1, q]
            for q in range(3):
                h = turned[i, q]
                z0 = h[0, 0] * d[0] + h[0, 1] * d[1] + h[0, 2] * d[2]
                z1 = h[1, 0] * d[0] + h[1, 1] * d[1] + h[1, 2] * d[2]
                z2 = h[2, 0] * d[0] + h[2, 1] * d[1] + h[2, 2] * d[2]
                jc[a, 0, 2 + q] = (z0 - u * z2) / y2
                jc[a, 1, 2 + q] = (z1 - v * z2) / y2
            jc[a, 0, 5] = -(g[0, 2] - u * g[2, 2]) / y2 * centre[i, 2]
            jc[a, 1, 5] = -(g[1, 2] - v * g[2, 2]) / y2 * centre[i, 2]
            v00 += w * (jp[0, 0] * jp[0, 0] + jp[1, 0] * jp[1, 0])
            v01 += w * (jp[0, 0] * jp[0, 1] + jp[1, 0] * jp[1, 1])
            v11 += w * (jp[0, 1] * jp[0, 1] + jp[1, 1] * jp[1, 1])
            g0 += w * (jp[0, 0] * r0 + jp[1, 0] * r1)
            g1 += w * (jp[0, 1] * r0 + jp[1, 1] * r1)
            own = pair_block[pair]
            for p in range(6):
                gradient[i, p] += w * (jc[a, 0, p] * r0 + jc[a, 1, p] * r1)
                for q in range(2):
                    coupling[k, p, q] = w * (jc[a, 0, p] * jp[0, q] + jc[a, 1, p] * jp[1, q])
                for q in range(6):
                    blocks[own, p, q] += w * (jc[a, 0, p] * jc[a, 0, q] + jc[a, 1, p] * jc[a, 1, q])
            pair += count - a
        determinant = v00 * v11 - v01 * v01
        i00, i01, i11 = 0.0, 0.0, 0.0
        if determinant > 0.0:
            i00, i01, i11 = v11 / determinant, -v01 / determinant, v00 / determinant
        point_inverse[t, 0, 0], point_inverse[t, 1, 1] = i00, i11
        point_inverse[t, 0, 1] = point_inverse[t, 1, 0] = i01
        point_gradient[t, 0], point_gradient[t, 1] = g0, g1
        pair = pair_first
        for a in range(count):
            i = camera[first + a]
            w = coupling[first + a]
            for p in range(6):
                reduced[p, 0] = w[p, 0] * i00 + w[p, 1] * i01
                reduced[p, 1] = w[p, 0] * i01 + w[p, 1] * i11
                gradient[i, p] -= reduced[p, 0] * g0 + reduced[p, 1] * g1
            for b in range(a, count):
                other = coupling[first + b]
                block = blocks[pair_block[pair]]
                for p in range(6):
                    for q in range(6):
                        block[p, q] -= reduced[p, 0] * other[q, 0] + reduced[p, 1] * other[q, 1]
                pair += 1


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
