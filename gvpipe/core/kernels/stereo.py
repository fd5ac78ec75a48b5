"""Multi-view stereo by slanted patches: random search and propagation (PatchMatch)."""

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.kernels.jit import kernel
from gvpipe.core.types import Float

Single = NDArray[np.float32]
Bytes = NDArray[np.uint8]

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

STARTS = 10
"""Random hypotheses every other pixel of every other row starts from; the rest hear of them."""

LIKE = 0.35
"""Cost, 1 - correlation, up to which a depth counts."""

RIVALS, RIVAL_STEP = 6, 0.02
"""Other depths a match is compared with, and their distance as a share of the depth."""

DISTINCT = 0.15
"""How much worse all of them must be."""

TRIES = 2
"""Random refinements of a pixel's best hypothesis in each sweep."""


@kernel
def _random(state: NDArray[np.uint64]) -> float:
    """Uniform in 0..1 (xorshift64*): the same on every machine."""
    x = state[0]
    x ^= x >> np.uint64(12)
    x ^= x << np.uint64(25)
    x ^= x >> np.uint64(27)
    state[0] = x
    return float((x * np.uint64(2685821657736338717)) >> np.uint64(11)) / 9007199254740992.0


@kernel
def _patch(
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
def _cost(
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


@kernel
def _direction(state: NDArray[np.uint64], out: Float) -> None:
    """Fill a uniform random unit vector."""
    z, angle = 2.0 * _random(state) - 1.0, 2.0 * np.pi * _random(state)
    r = np.sqrt(max(1.0 - z * z, 0.0))
    out[0], out[1], out[2] = r * np.cos(angle), r * np.sin(angle), z


@kernel
def match_depths(
    view: int,
    sources: NDArray[np.int64],
    pictures: Single,
    sizes: NDArray[np.int64],
    rotations: Float,
    shifts: Float,
    inverse: Float,
    up: Float,
    near: Single,
    far: Single,
    sweeps: int,
    depth: Single,
    normal: Single,
    cost: Single,
) -> None:
    """Find the depth and the plane of each pixel that other views agree on best.

    Parameters
    ----------
    view : int
        Index of the reference view.
    sources : (S,) int64
        Views to compare with.
    pictures : (N, H, W) float32
        Grey pictures padded to one size.
    sizes : (N, 2) int64
        True width and height of each.
    rotations, shifts : (S, 3, 3), (S, 3) float64
        K R and K t that take reference camera coordinates to homogeneous pixels of a source.
    inverse : (3, 3) float64
        Reference rays from pixels, K^-1.
    up : (3,) float64
        The map's z axis in reference camera coordinates.
    near, far : (h, w) float32
        Range of depths, metres; pixels where it is empty are left alone.
    sweeps : int
        Passes over the picture, forwards and backwards in turn.
    depth, normal, cost : (h, w), (h, w, 3), (h, w) float32
        Filled: metres, unit normal in camera coordinates towards the camera, 1 - correlation.

    Notes
    -----
    Bleyer, Rhemann and Rother, BMVC 2011, with patches compared under plane-induced homographies
    and the best two of several views (Galliani, Lasinger and Schindler, ICCV 2015).
    """
    height, width = depth.shape
    picture = pictures[view]
    values, weights = np.empty(SIDE * SIDE, np.float32), np.empty(SIDE * SIDE, np.float32)
    ray, n, other = np.empty(3), np.empty(3), np.empty(3)
    state = np.empty(1, np.uint64)
    state[0] = np.uint64(88172645463325252 + view)
    for sweep in range(sweeps + 1):
        scale = 0.5**sweep
        forwards = sweep % 2 == 1
        step = 1 if forwards else -1
        for row in range(height):
            v = row if forwards else height - 1 - row
            for column in range(width):
                u = column if forwards else width - 1 - column
                low, high = near[v, u], far[v, u]
                if not low < high:
                    continue
                for a in range(3):
                    ray[a] = inverse[a, 0] * u + inverse[a, 1] * v + inverse[a, 2]
                variance = _patch(picture, near, u, v, values, weights)
                best, best_depth = WORST, 0.5 * (low + high)
                if sweep > 0:
                    best, best_depth = cost[v, u], depth[v, u]
                tries = STARTS if sweep == 0 else TRIES + 2
                if sweep == 0 and (u + v) % 2 + v % 2 > 0:
                    tries = 0
                for k in range(tries):
                    if sweep == 0:
                        d = low + (high - low) * _random(state)
                        _direction(state, n)
                        if k % 3 == 0:  # floors and tops
                            n[:] = up
                        elif k % 3 == 1:  # walls
                            n -= (n[0] * up[0] + n[1] * up[1] + n[2] * up[2]) * up
                        if n[0] * ray[0] + n[1] * ray[1] + n[2] * ray[2] > 0:
                            n *= -1
                    elif k < 2:
                        y = v - step if k == 0 else v
                        x = u if k == 0 else u - step
                        if not (0 <= y < height and 0 <= x < width and near[y, x] < far[y, x]):
                            continue
                        n[:] = normal[y, x]
                        for a in range(3):
                            other[a] = inverse[a, 0] * x + inverse[a, 1] * y + inverse[a, 2]
                        over = n[0] * ray[0] + n[1] * ray[1] + n[2] * ray[2]
                        if abs(over) < 1e-6:
                            continue
                        d = depth[y, x] * (n[0] * other[0] + n[1] * other[1] + n[2] * other[2])
                        d /= over
                    else:
                        _direction(state, other)
                        n[:] = normal[v, u]
                        n += scale * other
                        d = best_depth + 0.3 * scale * (high - low) * (2 * _random(state) - 1)
                    n /= np.sqrt(n[0] ** 2 + n[1] ** 2 + n[2] ** 2)
                    if not low <= d <= high:
                        continue
                    c = _cost(
                        pictures, sizes, sources, rotations, shifts, ray, inverse,
                        u, v, d, n, values, weights, variance,
                    )  # fmt: skip
                    if c < best:
                        best, best_depth = c, d
                        depth[v, u], cost[v, u] = d, c
                        normal[v, u] = n.astype(np.float32)
                if sweep == 0 and best >= WORST:
                    depth[v, u], cost[v, u] = best_depth, WORST
                    normal[v, u] = up.astype(np.float32)
    _doubt(
        pictures, sizes, sources, rotations, shifts, inverse, near, far, view,
        depth, normal, cost,
    )  # fmt: skip


@kernel
def _doubt(
    pictures: Single, sizes: NDArray[np.int64], sources: NDArray[np.int64],
    rotations: Float, shifts: Float, inverse: Float, near: Single, far: Single, view: int,
    depth: Single, normal: Single, cost: Single,
) -> None:  # fmt: skip
    """Give up pixels that match nearly as well at other depths: smooth shading matches anywhere."""
    height, width = depth.shape
    values, weights = np.empty(SIDE * SIDE, np.float32), np.empty(SIDE * SIDE, np.float32)
    ray, n = np.empty(3), np.empty(3)
    for v in range(height):
        for u in range(width):
            if not (near[v, u] < far[v, u] and cost[v, u] < LIKE):
                continue
            for a in range(3):
                ray[a] = inverse[a, 0] * u + inverse[a, 1] * v + inverse[a, 2]
            variance = _patch(pictures[view], near, u, v, values, weights)
            n[:] = normal[v, u]
            for k in range(RIVALS):
                d = depth[v, u] * (1.0 + RIVAL_STEP * (k - RIVALS // 2 + (k >= RIVALS // 2)))
                c = _cost(
                    pictures, sizes, sources, rotations, shifts, ray, inverse,
                    u, v, d, n, values, weights, variance,
                )  # fmt: skip
                if c < cost[v, u] + DISTINCT:
                    cost[v, u] = WORST
                    break


@kernel
def fuse_depth(
    depth: Single,
    confidence: Single,
    matrix: Float,
    origin: Float,
    spacing: Float,
    band: float,
    votes: Single,
    weight: Single,
) -> None:
    """Add one depth map's truncated signed distances to the voxels before and at its surface.

    Parameters
    ----------
    depth, confidence : (H, W) float32
        Metres, and 0..1: nothing is known where it is 0.
    matrix : (3, 4) float64
        Pixels from map, third row the depth.
    origin, spacing : (3,) float64
        Of the voxel centres, metres.
    band : float
        Distance, metres, to which the surface speaks for what is behind it, and at which a vote
        for free space is a full one.
    votes, weight : (nx, ny, nz) float32
        Changed in place: plus confidence times the distance to the surface in units of the band,
        positive before it, in -1..1; plus confidence (Curless and Levoy, SIGGRAPH 1996).
    """
    nx, ny, nz = votes.shape
    height, width = depth.shape
    for i in range(nx):
        x = origin[0] + i * spacing[0]
        for j in range(ny):
            y = origin[1] + j * spacing[1]
            for k in range(nz):
                z = origin[2] + k * spacing[2]
                c = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z + matrix[2, 3]
                if c <= 1e-6:
                    continue
                u = (matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z + matrix[0, 3]) / c
                v = (matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z + matrix[1, 3]) / c
                if not (u >= -0.5 and v >= -0.5 and u < width - 0.5 and v < height - 0.5):
                    continue
                iu, iv = int(u + 0.5), int(v + 0.5)
                trust = confidence[iv, iu]
                if trust <= 0.0:
                    continue
                vote = (depth[iv, iu] - c) / band
                if vote < -1.0:
                    continue
                votes[i, j, k] += trust * min(vote, 1.0)
                weight[i, j, k] += trust
