"""Multi-view stereo by slanted patches: random search and propagation (PatchMatch)."""

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.kernels.jit import kernel
from gvpipe.core.kernels.slanted import SIDE, WORST, centred_patch, slanted_cost
from gvpipe.core.types import Float

Single = NDArray[np.float32]

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
def _direction(state: NDArray[np.uint64], out: Float) -> None:
    """Fill a uniform random unit vector."""
    z, angle = 2.0 * _random(state) - 1.0, 2.0 * np.pi * _random(state)
    r = np.sqrt(max(1.0 - z * z, 0.0))
    out[0], out[1], out[2] = r * np.cos(angle), r * np.sin(angle), z


@kernel
def _guess(k: int, state: NDArray[np.uint64], up: Float, ray: Float, n: Float) -> None:
    """Fill a normal to start from: floors and tops, walls and any other surface in turn."""
    _direction(state, n)
    if k % 3 == 0:
        n[:] = up
    elif k % 3 == 1:
        n -= (n[0] * up[0] + n[1] * up[1] + n[2] * up[2]) * up
    if n[0] * ray[0] + n[1] * ray[1] + n[2] * ray[2] > 0:
        n *= -1


@kernel
def _extended(n: Float, inverse: Float, ray: Float, x: int, y: int) -> float:
    """Depth along a ray of the plane through pixel (x, y), as a multiple of the depth there."""
    there, here = 0.0, n[0] * ray[0] + n[1] * ray[1] + n[2] * ray[2]
    for a in range(3):
        there += n[a] * (inverse[a, 0] * x + inverse[a, 1] * y + inverse[a, 2])
    return there / here if abs(here) > 1e-6 else np.inf


@kernel
def match_depths(
    view: int,
    sources: NDArray[np.int64],
    pictures: Single,
    sizes: NDArray[np.int64],
    infinite: Float,
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
                variance = centred_patch(picture, near, u, v, values, weights)
                best, best_depth = WORST, 0.5 * (low + high)
                if sweep > 0:
                    best, best_depth = cost[v, u], depth[v, u]
                tries = STARTS if sweep == 0 else TRIES + 2
                if sweep == 0 and (u + v) % 2 + v % 2 > 0:
                    tries = 0
                for k in range(tries):
                    if sweep == 0:
                        d = low + (high - low) * _random(state)
                        _guess(k, state, up, ray, n)
                    elif k < 2:
                        y, x = (v - step, u) if k == 0 else (v, u - step)
                        if not (0 <= y < height and 0 <= x < width and near[y, x] < far[y, x]):
                            continue
                        n[:] = normal[y, x]
                        d = depth[y, x] * _extended(n, inverse, ray, x, y)
                    else:
                        _direction(state, other)
                        n[:] = normal[v, u]
                        n += scale * other
                        d = best_depth + 0.3 * scale * (high - low) * (2 * _random(state) - 1)
                    n /= np.sqrt(n[0] ** 2 + n[1] ** 2 + n[2] ** 2)
                    if not low <= d <= high:
                        continue
                    c = slanted_cost(
                        pictures, sizes, sources, infinite, shifts, ray, inverse,
                        u, v, d, n, values, weights, variance, best,
                    )  # fmt: skip
                    if c < best:
                        best, best_depth = c, d
                        depth[v, u], cost[v, u] = d, c
                        normal[v, u] = n.astype(np.float32)
                if sweep == 0 and best >= WORST:
                    depth[v, u], cost[v, u] = best_depth, WORST
                    normal[v, u] = up.astype(np.float32)
    _doubt(
        pictures, sizes, sources, infinite, shifts, inverse, near, far, view,
        depth, normal, cost,
    )  # fmt: skip


@kernel
def _doubt(
    pictures: Single, sizes: NDArray[np.int64], sources: NDArray[np.int64],
    infinite: Float, shifts: Float, inverse: Float, near: Single, far: Single, view: int,
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
            variance = centred_patch(pictures[view], near, u, v, values, weights)
            n[:] = normal[v, u]
            for k in range(RIVALS):
                d = depth[v, u] * (1.0 + RIVAL_STEP * (k - RIVALS // 2 + (k >= RIVALS // 2)))
                c = slanted_cost(
                    pictures, sizes, sources, infinite, shifts, ray, inverse,
                    u, v, d, n, values, weights, variance, cost[v, u] + DISTINCT,
                )  # fmt: skip
                if c < cost[v, u] + DISTINCT:
                    cost[v, u] = WORST
                    break
