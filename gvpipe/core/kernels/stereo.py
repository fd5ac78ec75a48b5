"""Multi-view stereo by slanted patches: random search and propagation (PatchMatch)."""

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.kernels.jit import kernel
from gvpipe.core.kernels.slanted import WORST, Index, Triple, centred_patches, dot, slanted_cost
from gvpipe.core.types import Float

Single = NDArray[np.float32]
State = NDArray[np.uint64]
Plane = tuple[float, Triple]
"""Depth along a ray, and the normal."""

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
def _random(state: State) -> float:
    """Uniform in 0..1 (xorshift64*): the same on every machine."""
    x = state[0]
    x ^= x >> np.uint64(12)
    x ^= x << np.uint64(25)
    x ^= x >> np.uint64(27)
    state[0] = x
    return float((x * np.uint64(2685821657736338717)) >> np.uint64(11)) / 9007199254740992.0


@kernel
def _direction(state: State) -> Triple:
    """Draw a uniform random unit vector."""
    z, angle = 2.0 * _random(state) - 1.0, 2.0 * np.pi * _random(state)
    r = np.sqrt(max(1.0 - z * z, 0.0))
    return r * np.cos(angle), r * np.sin(angle), z


@kernel
def _guess(k: int, state: State, up: Triple, ray: Triple) -> Triple:
    """Draw a normal to start from: floors and tops, walls and any other surface in turn."""
    n = _direction(state)
    if k % 3 == 0:
        n = up
    elif k % 3 == 1:
        along = dot(n, up)
        n = (n[0] - along * up[0], n[1] - along * up[1], n[2] - along * up[2])
    return (-n[0], -n[1], -n[2]) if dot(n, ray) > 0 else n


@kernel
def _ray(inverse: Float, u: int, v: int) -> Triple:
    """Ray of a pixel."""
    return (
        inverse[0, 0] * u + inverse[0, 1] * v + inverse[0, 2],
        inverse[1, 0] * u + inverse[1, 1] * v + inverse[1, 2],
        inverse[2, 0] * u + inverse[2, 1] * v + inverse[2, 2],
    )


@kernel
def _unit(n: Triple) -> Triple:
    length = np.sqrt(dot(n, n))
    return n[0] / length, n[1] / length, n[2] / length


@kernel
def _extended(n: Triple, ray: Triple, there: Triple) -> float:
    """Depth along a ray of the plane through a point on another, as a multiple of its depth."""
    here = dot(n, ray)
    return dot(n, there) / here if abs(here) > 1e-6 else np.inf


@kernel
def _normal(normal: Single, y: int, x: int) -> Triple:
    return float(normal[y, x, 0]), float(normal[y, x, 1]), float(normal[y, x, 2])


@kernel
def _started(k: int, state: State, low: float, high: float, up: Triple, ray: Triple) -> Plane:
    """Draw a depth and a normal to start from."""
    d = low + (high - low) * _random(state)
    return d, _guess(k, state, up, ray)


@kernel
def _inherited(y: int, x: int, depth: Single, normal: Single, inverse: Float, ray: Triple) -> Plane:
    """Extend the plane of a neighbour, pixel (x, y), to a ray."""
    n = _normal(normal, y, x)
    return depth[y, x] * _extended(n, ray, _ray(inverse, x, y)), n


@kernel
def _varied(state: State, d: float, n: Triple, reach: float, scale: float) -> Plane:
    """Draw a plane near another one."""
    o = _direction(state)
    tilted = (n[0] + scale * o[0], n[1] + scale * o[1], n[2] + scale * o[2])
    return d + reach * (2 * _random(state) - 1), tilted


@kernel
def _sweep(
    sweep: int, pictures: Single, area: int, stride: int, sizes: NDArray[np.int64],
    sources: NDArray[np.int64], infinite: Float, shifts: Float, inverse: Float, up: Triple,
    near: Single, far: Single, number: Index, values: Single, weights: Single, variance: Float,
    state: State, changed: NDArray[np.int8], depth: Single, normal: Single, cost: Single,
) -> None:  # fmt: skip
    """Pass over the picture once, forwards or backwards: every pixel keeps its best plane."""
    height, width = depth.shape
    scale, step = 0.5**sweep, 1 if sweep % 2 == 1 else -1
    for row in range(height):
        v = row if step > 0 else height - 1 - row
        for column in range(width):
            u = column if step > 0 else width - 1 - column
            p = number[v, u]
            if p < 0:
                continue
            low, high, ray = near[v, u], far[v, u], _ray(inverse, u, v)
            best, best_depth = WORST, 0.5 * (low + high)
            tries = STARTS if u % 2 == 0 and v % 2 == 0 else 0
            if sweep > 0:
                best, best_depth, tries = cost[v, u], depth[v, u], TRIES + 2
            for k in range(tries):
                if sweep == 0:
                    d, n = _started(k, state, low, high, up, ray)
                elif k < 2:
                    y, x = (v - step, u) if k == 0 else (v, u - step)
                    if not (0 <= y < height and 0 <= x < width and number[y, x] >= 0):
                        continue
                    if sweep > 2 and changed[y, x] < sweep - 1:  # it was asked two sweeps ago
                        continue
                    d, n = _inherited(y, x, depth, normal, inverse, ray)
                else:
                    reach = 0.3 * scale * (high - low)
                    d, n = _varied(state, best_depth, _normal(normal, v, u), reach, scale)
                if not low <= d <= high:
                    continue
                n = _unit(n)
                c = slanted_cost(
                    pictures, area, stride, sizes, sources, infinite, shifts, inverse,
                    u, v, d, ray, n, p, values, weights, variance[p], best,
                )  # fmt: skip
                if c < best:
                    best, best_depth = c, d
                    depth[v, u], cost[v, u], changed[v, u] = d, c, sweep
                    normal[v, u, 0], normal[v, u, 1], normal[v, u, 2] = n
            if sweep == 0 and best >= WORST:
                depth[v, u], cost[v, u] = best_depth, WORST
                normal[v, u, 0], normal[v, u, 1], normal[v, u, 2] = up


@kernel
def match_depths(
    view: int, sources: NDArray[np.int64], pictures: Single, sizes: NDArray[np.int64],
    infinite: Float, shifts: Float, inverse: Float, up: Float, near: Single, far: Single,
    sweeps: int, depth: Single, normal: Single, cost: Single,
) -> None:  # fmt: skip
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
    infinite, shifts : (S, 3, 3), (S, 3) float64
        K R K^-1 and K t that take reference pixels at infinity, and the rest of the way, to
        homogeneous pixels of a source.
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
    number, values, weights, variance = centred_patches(pictures[view], near, far)
    flat, area, stride = pictures.ravel(), pictures[0].size, pictures.shape[2]
    upright = (up[0], up[1], up[2])
    changed = np.zeros((height, width), np.int8)  # in which sweep, last
    state = np.full(1, 88172645463325252 + view, np.uint64)
    for sweep in range(sweeps + 1):
        _sweep(
            sweep, flat, area, stride, sizes, sources, infinite, shifts, inverse, upright, near,
            far, number, values, weights, variance, state, changed, depth, normal, cost,
        )  # fmt: skip
    _doubt(
        flat, area, stride, sizes, sources, infinite, shifts, inverse, number, values, weights,
        variance, depth, normal, cost,
    )  # fmt: skip


@kernel
def _doubt(
    pictures: Single, area: int, stride: int, sizes: NDArray[np.int64],
    sources: NDArray[np.int64], infinite: Float, shifts: Float, inverse: Float,
    number: Index, values: Single, weights: Single, variance: Float,
    depth: Single, normal: Single, cost: Single,
) -> None:  # fmt: skip
    """Give up pixels that match nearly as well at other depths: smooth shading matches anywhere."""
    height, width = depth.shape
    for v in range(height):
        for u in range(width):
            p = number[v, u]
            if p < 0 or cost[v, u] >= LIKE:
                continue
            ray, limit = _ray(inverse, u, v), cost[v, u] + DISTINCT
            n = _normal(normal, v, u)
            for k in range(RIVALS):
                away = (k // 2 + 1) * (1 - k % 2 * 2)  # 1, -1, 2, -2, ...: the likeliest first
                d = depth[v, u] * (1.0 + RIVAL_STEP * away)
                c = slanted_cost(
                    pictures, area, stride, sizes, sources, infinite, shifts, inverse,
                    u, v, d, ray, n, p, values, weights, variance[p], limit,
                )  # fmt: skip
                if c < limit:
                    cost[v, u] = WORST
                    break
