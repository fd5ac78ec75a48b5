"""How well a small tilted piece of surface looks alike in several views."""

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.kernels.jit import kernel
from gvpipe.core.types import Float

Single = NDArray[np.float32]

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

FACING = 0.15
"""Least cosine between a plane's normal and the line of sight."""


@kernel
def centred_patch(
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
    picture: Single, size: NDArray[np.int64], m: Float, u: int, v: int,
    values: Single, weights: Single, variance: float,
) -> float:  # fmt: skip
    """Weighted normalised correlation of a patch with its image under the homography m."""
    total, total2, common = 0.0, 0.0, 0.0
    for a in range(SIDE):
        y = v + STRIDE * a - RADIUS
        for b in range(SIDE):
            x = u + STRIDE * b - RADIUS
            depth = m[2, 0] * x + m[2, 1] * y + m[2, 2]
            if depth <= 1e-6:
                return -1.0
            p = (m[0, 0] * x + m[0, 1] * y + m[0, 2]) / depth
            q = (m[1, 0] * x + m[1, 1] * y + m[1, 2]) / depth
            if not (p >= 0.0 and q >= 0.0 and p < size[0] - 1 and q < size[1] - 1):
                return -1.0
            i, j = int(q), int(p)
            fq, fp = np.float32(q - i), np.float32(p - j)
            upper = picture[i, j] + fp * (picture[i, j + 1] - picture[i, j])
            lower = picture[i + 1, j] + fp * (picture[i + 1, j + 1] - picture[i + 1, j])
            value = upper + fq * (lower - upper)
            weight = weights[a * SIDE + b]
            total += weight * value
            total2 += weight * value * value
            common += values[a * SIDE + b] * value
    spread = max(total2 - total * total, 0.0)
    return common / np.sqrt((spread + NOISE2) * (variance + NOISE2))


@kernel
def slanted_cost(
    pictures: Single, sizes: NDArray[np.int64], sources: NDArray[np.int64],
    rotations: Float, shifts: Float, ray: Float, inverse: Float,
    u: int, v: int, depth: float, normal: Float,
    values: Single, weights: Single, variance: float,
) -> float:  # fmt: skip
    """One minus the mean correlation with the two views that agree best."""
    facing = ray[0] * normal[0] + ray[1] * normal[1] + ray[2] * normal[2]
    length = np.sqrt(ray[0] ** 2 + ray[1] ** 2 + ray[2] ** 2)
    if facing > -FACING * length:
        return WORST
    c = depth * facing
    m, in_rays = np.empty((3, 3)), np.empty((3, 3))
    first, second = -1.0, -1.0
    for s in range(len(sources)):
        for a in range(3):
            for b in range(3):
                in_rays[a, b] = rotations[s, a, b] + shifts[s, a] * normal[b] / c
        for a in range(3):
            for b in range(3):
                m[a, b] = (
                    in_rays[a, 0] * inverse[0, b]
                    + in_rays[a, 1] * inverse[1, b]
                    + in_rays[a, 2] * inverse[2, b]
                )
        found = _correlation(
            pictures[sources[s]], sizes[sources[s]], m, u, v, values, weights, variance
        )
        if found > first:
            first, second = found, first
        elif found > second:
            second = found
    return 1.0 - 0.5 * (first + second)
