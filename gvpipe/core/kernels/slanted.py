"""How well a small tilted piece of surface looks alike in several views."""

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.kernels.jit import kernel
from gvpipe.core.types import Float

Single = NDArray[np.float32]
Index = NDArray[np.int32]
Triple = tuple[float, float, float]

RADIUS, STRIDE = 4, 2
"""Half side of the patches and distance between their samples, pixels."""

SIDE = RADIUS // STRIDE * 2 + 1
"""Samples along a side of a patch."""

COLOUR_SCALE = 25.0
"""Levels: samples that differ from the middle by this much count a third, so that patches do not
reach across outlines."""

NOISE2 = 9.0
"""Variance, levels squared, of what sensor and compression add: flat patches match nothing."""

WORST = 2.0
"""Cost of a hypothesis that cannot be compared: that of perfect anticorrelation."""

HOPE = 0.4
"""Correlation by which views to come may exceed the best one so far."""

ONE = np.uint64(1)
"""Added to an unsigned index, keeps it unsigned."""

FACING = 0.15
"""Least cosine between a plane's normal and the line of sight."""


@kernel
def dot(a: Triple, b: Triple) -> float:
    """Scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel
def centred_patches(
    picture: Single, near: Single, far: Single
) -> tuple[Index, Single, Single, Float]:
    """Patches around all pixels that have a range of depths.

    Parameters
    ----------
    picture : (H, W) float32
        Grey levels.
    near, far : (h, w) float32
        Range of depths, metres; samples whose `near` is infinite do not count.

    Returns
    -------
    number : (h, w) int32
        Which patch is a pixel's; -1 where the range is empty.
    values, weights : (P, SIDE * SIDE) float32
        Centred samples times weights, and weights of unit sum.
    variance : (P,) float64
        Of the weighted samples.
    """
    height, width = near.shape
    number, count = np.full((height, width), -1, np.int32), 0
    for v in range(height):
        for u in range(width):
            if near[v, u] < far[v, u]:
                number[v, u] = count
                count += 1
    shape = count, SIDE * SIDE
    values, weights = np.empty(shape, np.float32), np.empty(shape, np.float32)
    variance = np.empty(count)
    for v in range(height):
        for u in range(width):
            p = number[v, u]
            if p >= 0:
                variance[p] = _centred_patch(picture, near, u, v, values[p], weights[p])
    return number, values, weights, variance


@kernel
def _centred_patch(
    picture: Single, near: Single, u: int, v: int, values: Single, weights: Single
) -> float:
    """Fill centred samples times weights, and weights of unit sum; returns their variance."""
    height, width = near.shape
    middle = picture[v, u]
    total = np.float32(0)
    for a in range(SIDE):
        for b in range(SIDE):
            y, x = v + STRIDE * a - RADIUS, u + STRIDE * b - RADIUS
            y, x = min(max(y, 0), height - 1), min(max(x, 0), width - 1)
            value = picture[y, x]
            off = (value - middle) / np.float32(COLOUR_SCALE)
            weight = np.exp(-abs(off)) if near[y, x] < np.inf else np.float32(0)
            values[a * SIDE + b], weights[a * SIDE + b] = value, weight
            total += weight
    mean = np.float32(0)
    for k in range(SIDE * SIDE):
        weights[k] /= total
        mean += weights[k] * values[k]
    variance = np.float32(0)
    for k in range(SIDE * SIDE):
        values[k] -= mean
        variance += weights[k] * values[k] ** 2
        values[k] *= weights[k]
    return float(variance)


@kernel
def _correlation(
    pictures: Single, start: int, width: int, last_u: int, last_v: int,
    s: int, infinite: Float, shifts: Float, plane: Triple, u: int, v: int,
    patch: int, values: Single, weights: Single, variance: float,
) -> float:  # fmt: skip
    """Weighted normalised correlation of a patch with its image under a plane's homography.

    The homography, ``infinite[s] + shifts[s] plane^T``, is taken as affine over the patch. Its
    corners are then off by 0.02 pixels as a rule, by 0.1 on planes 60 degrees from facing the
    camera. Arrays come whole, with an index: cutting them up takes as long as half a patch.
    """
    a, b, c = plane
    m00, m01 = infinite[s, 0, 0] + shifts[s, 0] * a, infinite[s, 0, 1] + shifts[s, 0] * b
    m10, m11 = infinite[s, 1, 0] + shifts[s, 1] * a, infinite[s, 1, 1] + shifts[s, 1] * b
    m20, m21 = infinite[s, 2, 0] + shifts[s, 2] * a, infinite[s, 2, 1] + shifts[s, 2] * b
    depth = m20 * u + m21 * v + infinite[s, 2, 2] + shifts[s, 2] * c
    if depth <= 1e-6:
        return -1.0
    inverse = 1.0 / depth
    p = (m00 * u + m01 * v + infinite[s, 0, 2] + shifts[s, 0] * c) * inverse
    q = (m10 * u + m11 * v + infinite[s, 1, 2] + shifts[s, 1] * c) * inverse
    pu, pv = (m00 - p * m20) * inverse, (m01 - p * m21) * inverse
    qu, qv = (m10 - q * m20) * inverse, (m11 - q * m21) * inverse
    reach_p, reach_q = RADIUS * (abs(pu) + abs(pv)), RADIUS * (abs(qu) + abs(qv))
    if not (p >= reach_p and q >= reach_q and p + reach_p < last_u and q + reach_q < last_v):
        return -1.0
    total, total2, common = np.float32(0), np.float32(0), np.float32(0)
    u_p, v_p, u_q, v_q = np.float32(pu), np.float32(pv), np.float32(qu), np.float32(qv)
    p0, q0 = np.float32(p), np.float32(q)
    for k in range(SIDE):
        y = np.float32(STRIDE * k - RADIUS)
        for n in range(SIDE):
            x = np.float32(STRIDE * n - RADIUS)
            column, row = p0 + u_p * x + v_p * y, q0 + u_q * x + v_q * y
            i, j = np.int32(row), np.int32(column)
            fq, fp = row - np.float32(i), column - np.float32(j)
            # unsigned: an index that cannot count from the end
            at = np.uint64(start + i * width + j)
            below = at + np.uint64(width)
            upper = pictures[at] + fp * (pictures[at + ONE] - pictures[at])
            lower = pictures[below] + fp * (pictures[below + ONE] - pictures[below])
            value = upper + fq * (lower - upper)
            weighted = weights[patch, k * SIDE + n] * value
            total += weighted
            total2 += weighted * value
            common += values[patch, k * SIDE + n] * value
    spread = max(float(total2) - float(total) * float(total), 0.0)
    return float(common) / np.sqrt((spread + NOISE2) * (variance + NOISE2))


@kernel
def slanted_cost(
    pictures: Single, area: int, width: int, sizes: NDArray[np.int64], sources: NDArray[np.int64],
    infinite: Float, shifts: Float, inverse: Float,
    u: int, v: int, depth: float, ray: Triple, normal: Triple,
    patch: int, values: Single, weights: Single, variance: float, limit: float,
) -> float:  # fmt: skip
    """One minus the mean correlation with the two views that agree best.

    `pictures` are flat, `area` values each, in rows of `width`; `infinite` (S, 3, 3) are the
    sources' pixels from the reference's for a plane at infinity. Views are asked until it is
    plain that the cost will not be below `limit`.
    """
    facing = dot(ray, normal)
    if facing > -FACING * np.sqrt(dot(ray, ray)):
        return WORST
    c = 1.0 / (depth * facing)
    plane = (
        c * (normal[0] * inverse[0, 0] + normal[1] * inverse[1, 0] + normal[2] * inverse[2, 0]),
        c * (normal[0] * inverse[0, 1] + normal[1] * inverse[1, 1] + normal[2] * inverse[2, 1]),
        c * (normal[0] * inverse[0, 2] + normal[1] * inverse[1, 2] + normal[2] * inverse[2, 2]),
    )
    first, second = -1.0, -1.0
    for s in range(len(sources)):
        source = sources[s]
        found = _correlation(
            pictures, source * area, width, sizes[source, 0] - 1, sizes[source, 1] - 1,
            s, infinite, shifts, plane, u, v, patch, values, weights, variance,
        )  # fmt: skip
        if found > first:
            first, second = found, first
        elif found > second:
            second = found
        if s > 0 and 0.5 * (first + min(first + HOPE, 1.0)) < 1.0 - limit:
            return WORST
    return 1.0 - 0.5 * (first + second)
