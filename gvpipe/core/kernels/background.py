"""The bare ground behind every pixel of one view, as the other views show it."""

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.kernels.jit import kernel
from gvpipe.core.types import Float

Single = NDArray[np.float32]
Bytes = NDArray[np.uint8]

LEAST_SHARPNESS = 0.05
"""Weight of a view that sees the ground far more coarsely than the view it is compared with."""

HIDDEN_WEIGHT = 0.01
"""Weight of a view that an obstacle probably keeps from seeing the point."""


@kernel
def _sharpness(horizontal2: float, height: float) -> float:
    """Pixels per square metre of ground seen from a height, up to the focal length squared."""
    return height / (horizontal2 + height * height) ** 1.5


@kernel
def _collect(
    x: float,
    y: float,
    images: Bytes,
    hidden: Bytes,
    sizes: NDArray[np.int64],
    pixel_from_ground: Float,
    centres: Float,
    others: NDArray[np.int64],
    own_sharpness: float,
    reach2: float,
    colours: Single,
    weights: Single,
) -> tuple[int, float, float]:
    """Fetch a ground point's colours: their number, total weight, and weight not hidden."""
    m, total, open_weight = 0, 0.0, 0.0
    for j in others:
        h = pixel_from_ground[j]
        depth = h[2, 0] * x + h[2, 1] * y + h[2, 2]
        if depth <= 1e-6:
            continue
        u = (h[0, 0] * x + h[0, 1] * y + h[0, 2]) / depth
        v = (h[1, 0] * x + h[1, 1] * y + h[1, 2]) / depth
        if not (u >= 1 and v >= 1 and u < sizes[j, 0] - 2 and v < sizes[j, 1] - 2):
            continue
        away2 = (x - centres[j, 0]) ** 2 + (y - centres[j, 1]) ** 2
        if away2 > reach2 * centres[j, 2] ** 2:
            continue
        relative = np.sqrt(_sharpness(away2, centres[j, 2]) / own_sharpness)
        weight = min(1.0, max(LEAST_SHARPNESS, relative))
        total += weight
        weight *= 1.0 - (1.0 - HIDDEN_WEIGHT) * hidden[j, int(v + 0.5), int(u + 0.5)] / 255.0
        open_weight += weight
        iu, iv = int(u), int(v)
        fu, fv = np.float32(u - iu), np.float32(v - iv)
        for k in range(3):
            a = np.float32(images[j, iv, iu, k])
            b = np.float32(images[j, iv, iu + 1, k])
            c = np.float32(images[j, iv + 1, iu, k])
            d = np.float32(images[j, iv + 1, iu + 1, k])
            top, bottom = a + fu * (b - a), c + fu * (d - c)
            colours[m, k] = top + fv * (bottom - top)
        weights[m] = weight
        m += 1
    return m, total, open_weight


@kernel
def _distance2(a: Single, b: Single) -> float:
    return (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2


@kernel
def _mode(colours: Single, weights: Single, m: int, scale2: float, mode: Single) -> float:
    """Find the colour most of the weight agrees on; returns the weight that agrees."""
    best, chosen = -1.0, 0
    for a in range(m):
        votes = 0.0
        for b in range(m):
            d = _distance2(colours[a], colours[b]) / scale2
            votes += weights[b] / (1.0 + d * d)
        votes *= 0.3 + weights[a]  # a sharp view's colour is a better start
        if votes > best:
            best, chosen = votes, a
    support = 0.0
    mode[:] = colours[chosen]
    mean = np.zeros(3, np.float32)
    for _ in range(2):
        support = 0.0
        mean[:] = 0.0
        for b in range(m):
            d = _distance2(colours[b], mode) / scale2
            w = weights[b] / (1.0 + d * d)
            support += w
            for k in range(3):
                mean[k] += np.float32(w * colours[b, k])
        for k in range(3):
            mode[k] = np.float32(mean[k] / support)
    return support


@kernel
def ground_behind(
    view: int,
    others: NDArray[np.int64],
    images: Bytes,
    hidden: Bytes,
    sizes: NDArray[np.int64],
    pixel_from_ground: Float,
    ground_from_pixel: Float,
    ray_z: Float,
    centres: Float,
    colour_scale: float,
    reach: float,
    colour: Single,
    support: Single,
    open_weight: Single,
    total_weight: Single,
) -> None:
    """Fill the ground's colour behind every pixel of a view from the views `others`.

    Parameters
    ----------
    view : int
        Index of the view whose background is wanted.
    others : (M,) int64
        Views to ask, without `view`.
    images, hidden : (N, H, W, 3) uint8, (N, H, W) uint8
        Pictures padded to one size; 255 where an obstacle hides the ground in them.
    sizes : (N, 2) int64
        True width and height of each picture.
    pixel_from_ground : (N, 3, 3) float64
        Homographies, third row the depth, metres.
    ground_from_pixel : (3, 3) float64
        Inverse homography of the view itself.
    ray_z : (3,) float64
        Upward component of the view's rays as a function of (u, v, 1).
    centres : (N, 3) float64
        Camera centres, metres.
    colour_scale : float
        Colours closer than this agree, levels.
    reach : float
        Ground farther from a camera than this many of its heights is not asked.
    colour, support, open_weight, total_weight
        (h, w, 3) and (h, w) float32, filled: the colour most agree on, the weight that agrees,
        the weight of all views not hidden there, and of all views. Zero where nothing is seen.
    """
    height, width = support.shape
    n = len(others)
    colours, weights = np.zeros((n, 3), np.float32), np.zeros(n, np.float32)
    mode = np.zeros(3, np.float32)
    g = ground_from_pixel
    for v in range(height):
        for u in range(width):
            support[v, u], open_weight[v, u], total_weight[v, u] = 0.0, 0.0, 0.0
            if ray_z[0] * u + ray_z[1] * v + ray_z[2] >= -1e-4:
                continue
            w = g[2, 0] * u + g[2, 1] * v + g[2, 2]
            x = (g[0, 0] * u + g[0, 1] * v + g[0, 2]) / w
            y = (g[1, 0] * u + g[1, 1] * v + g[1, 2]) / w
            away2 = (x - centres[view, 0]) ** 2 + (y - centres[view, 1]) ** 2
            if away2 > (reach * centres[view, 2]) ** 2:
                continue
            m, total, opened = _collect(
                x,
                y,
                images,
                hidden,
                sizes,
                pixel_from_ground,
                centres,
                others,
                _sharpness(away2, centres[view, 2]),
                reach * reach,
                colours,
                weights,
            )
            total_weight[v, u], open_weight[v, u] = total, opened
            if m:
                support[v, u] = _mode(colours, weights, m, colour_scale**2, mode)
                colour[v, u] = mode
