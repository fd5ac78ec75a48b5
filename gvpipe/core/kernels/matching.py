"""Loops of the matcher: segment hypotheses between overhead views and guided neighbours."""

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.kernels.jit import kernel
from gvpipe.core.types import Float

SIZE = 128
"""Bytes of a descriptor."""

_BLOCK = 256  # descriptors multiplied at once: the products stay in the cache

_PROFILE_SAMPLES = 24  # grey values compared along a segment (k + 1 of thesis eq. 3.3.5)


@kernel
def _profile(
    image: NDArray[np.uint8], raster: Float, ax: float, ay: float, bx: float, by: float, out: Float
) -> bool:
    """Bilinear grey values from ground point a to b into `out`; False where they leave `image`."""
    height, width = image.shape
    for k in range(len(out)):
        t = k / (len(out) - 1)
        x, y = ax + t * (bx - ax), ay + t * (by - ay)
        u = raster[0, 0] * x + raster[0, 1] * y + raster[0, 2]
        v = raster[1, 0] * x + raster[1, 1] * y + raster[1, 2]
        if not (u >= 0 and v >= 0 and u < width - 1 and v < height - 1):
            return False
        c, r = int(u), int(v)
        fu, fv = u - c, v - r
        out[k] = (1 - fv) * ((1 - fu) * image[r, c] + fu * image[r, c + 1]) + fv * (
            (1 - fu) * image[r + 1, c] + fu * image[r + 1, c + 1]
        )
    return True


@kernel
def _correlation(a: Float, b: Float) -> float:
    """Normalised cross-correlation of two profiles (thesis eq. 3.3.5); 0 without contrast."""
    n = len(a)
    mean_a, mean_b = a.sum() / n, b.sum() / n
    ab, aa, bb = 0.0, 0.0, 0.0
    for k in range(n):
        ab += (a[k] - mean_a) * (b[k] - mean_b)
        aa += (a[k] - mean_a) ** 2
        bb += (b[k] - mean_b) ** 2
    return ab / np.sqrt(aa * bb) if aa > 1e-6 and bb > 1e-6 else 0.0


@kernel
def _like_neighbours(
    c: float, s: float, tx: float, ty: float, ground_i: Float, distance: Float,
    raster_j: Float, near_j: NDArray[np.int32], max_distance: float,
) -> int:  # fmt: skip
    """Corners of i that an isometry takes to where a like corner of j is near."""
    height, width = near_j.shape
    score = 0
    for k in range(len(ground_i)):
        x = c * ground_i[k, 0] - s * ground_i[k, 1] + tx
        y = s * ground_i[k, 0] + c * ground_i[k, 1] + ty
        u = int(np.rint(raster_j[0, 0] * x + raster_j[0, 1] * y + raster_j[0, 2]))
        v = int(np.rint(raster_j[1, 0] * x + raster_j[1, 1] * y + raster_j[1, 2]))
        if 0 <= u < width and 0 <= v < height:
            neighbour = near_j[v, u]
            if neighbour >= 0 and distance[k, neighbour] < max_distance:
                score += 1
    return score


@kernel
def segment_trial(
    p: int, q: int, ground_i: Float, ground_j: Float, distance: Float,
    grey_i: NDArray[np.uint8], raster_i: Float, grey_j: NDArray[np.uint8], raster_j: Float,
    near_j: NDArray[np.int32], max_distance: float, max_stretch: float, min_correlation: float,
) -> tuple[Float, NDArray[np.int64]]:  # fmt: skip
    """Best isometry that takes the segment between corners p and q of i to a segment of j.

    Parameters
    ----------
    p, q : int
        Corners of view i.
    ground_i, ground_j : (N, 2), (M, 2) float64
        Ground points of the corners, metres.
    distance : (N, M) float64
        Distances of the invariant vectors.
    grey_i, grey_j : (h, w) uint8
        Overhead views.
    raster_i, raster_j : (3, 3) float64
        Overhead pixels from ground metres.
    near_j : (h, w) int32
        Overhead view j: the corner whose best-fit window covers the pixel, or -1.
    max_distance, max_stretch, min_correlation : float
        Gates on invariants, segment length (relative) and profile correlation.

    Returns
    -------
    best : (4,) float64
        Corners of i with a like neighbour under the best isometry; its yaw, x, y.
    counts : (2,) int64
        Segments that passed the length gate, and of these the correlation gate.
    """
    best = np.zeros(4)
    counts = np.zeros(2, np.int64)
    px, py, qx, qy = ground_i[p, 0], ground_i[p, 1], ground_i[q, 0], ground_i[q, 1]
    length = np.hypot(qx - px, qy - py)
    profile_i, profile_j = np.empty(_PROFILE_SAMPLES), np.empty(_PROFILE_SAMPLES)
    if length == 0.0 or not _profile(grey_i, raster_i, px, py, qx, qy, profile_i):
        return best, counts
    for m in range(len(ground_j)):
        if distance[p, m] >= max_distance:
            continue
        mx, my = ground_j[m, 0], ground_j[m, 1]
        for n in range(len(ground_j)):
            if distance[q, n] >= max_distance:
                continue
            nx, ny = ground_j[n, 0], ground_j[n, 1]
            if abs(np.hypot(nx - mx, ny - my) - length) >= max_stretch * length:
                continue
            counts[0] += 1
            if not _profile(grey_j, raster_j, mx, my, nx, ny, profile_j):
                continue
            if _correlation(profile_i, profile_j) <= min_correlation:
                continue
            counts[1] += 1
            cross = (qx - px) * (ny - my) - (qy - py) * (nx - mx)
            dot = (qx - px) * (nx - mx) + (qy - py) * (ny - my)
            yaw = np.arctan2(cross, dot)
            c, s = np.cos(yaw), np.sin(yaw)
            tx = 0.5 * (mx + nx - c * (px + qx) + s * (py + qy))
            ty = 0.5 * (my + ny - s * (px + qx) - c * (py + qy))
            score = _like_neighbours(
                c, s, tx, ty, ground_i, distance, raster_j, near_j, max_distance
            )
            if score > best[0]:
                best[0], best[1], best[2], best[3] = score, yaw, tx, ty
    return best, counts


@kernel
def guided_neighbours(
    mapped: Float, points_j: Float, distance: Float, window: float, max_distance: float
) -> NDArray[np.int64]:
    """Mutual nearest corners inside a search window that also look alike.

    Parameters
    ----------
    mapped : (N, 2) float64
        Corners of i mapped to image j, pixels.
    points_j : (M, 2) float64
        Corners of j, pixels.
    distance : (N, M) float64
        Distances of their invariants.
    window, max_distance : float
        Half the side of the search window, pixels; gate on `distance`.

    Returns
    -------
    partner : (N,) int64
        Corner of j, or -1.
    """
    n, m = len(mapped), len(points_j)
    forward, forward_best = np.full(n, -1), np.full(n, np.inf)
    backward, backward_best = np.full(m, -1), np.full(m, np.inf)
    for a in range(n):
        for b in range(m):
            du, dv = mapped[a, 0] - points_j[b, 0], mapped[a, 1] - points_j[b, 1]
            if not (abs(du) <= window and abs(dv) <= window) or distance[a, b] >= max_distance:
                continue
            square = du * du + dv * dv
            if square < forward_best[a]:
                forward[a], forward_best[a] = b, square
            if square < backward_best[b]:
                backward[b], backward_best[b] = a, square
    for a in range(n):
        if forward[a] >= 0 and backward[forward[a]] != a:
            forward[a] = -1
    return forward


@kernel
def _two_least(
    products: NDArray[np.float32],
    squares_a: NDArray[np.float32],
    squares_b: NDArray[np.float32],
    first: NDArray[np.int64],
    last: NDArray[np.int64],
    nearest: NDArray[np.int64],
    ratio: Float,
) -> None:
    """Write the nearest of each row and its ratio, from scalar products and squared lengths."""
    far = np.float32(np.inf)
    for k in range(len(products)):
        best, second = far, far
        for m in range(first[k], last[k]):
            square = squares_b[m] - 2 * products[k, m]
            if square < second:
                if square < best:
                    best, second, nearest[k] = square, best, m
                else:
                    second = square
        if second < far:
            ratio[k] = np.sqrt((best + squares_a[k]) / max(second + squares_a[k], 1.0))


def nearest_two(
    a: NDArray[np.uint8],
    b: NDArray[np.uint8],
    first: NDArray[np.int64],
    last: NDArray[np.int64],
) -> tuple[NDArray[np.int64], Float]:
    """Nearest of each descriptor and how it compares with the second nearest.

    Parameters
    ----------
    a, b : (N, SIZE), (M, SIZE) uint8
        Descriptors.
    first, last : (N,) int64
        Row n of `a` is compared with the rows ``first[n]`` to ``last[n]`` - 1 of `b`.

    Returns
    -------
    nearest : (N,) int64
        Row of `b`, or -1.
    ratio : (N,) float64
        Distance to it over that to the second nearest; 1 where there is no second.

    Notes
    -----
    Twice a scalar product of SIZE bytes stays below 2^24, so a library's product of float32
    matrices is exact and the same on every machine.
    """
    nearest, ratio = np.full(len(a), -1), np.ones(len(a))
    floats_a, floats_b = a.astype(np.float32), b.astype(np.float32)
    squares_a, squares_b = ((f * f).sum(axis=1) for f in (floats_a, floats_b))
    for start in range(0, len(a), _BLOCK):
        rows = slice(start, start + _BLOCK)
        low, high = int(first[rows].min()), int(last[rows].max())
        _two_least(
            floats_a[rows] @ floats_b[low:high].T,
            squares_a[rows],
            squares_b[low:high],
            first[rows] - low,
            last[rows] - low,
            nearest[rows],
            ratio[rows],
        )
        nearest[rows] += np.where(nearest[rows] >= 0, low, 0)
    return nearest, ratio
