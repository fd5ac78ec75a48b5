"""The bare ground behind every pixel of one view, as the other views show it."""

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.kernels.jit import kernel
from gvpipe.core.types import Float

Single = NDArray[np.float32]
Bytes = NDArray[np.uint8]
Colour = tuple[np.float32, np.float32, np.float32]

LEAST_SHARPNESS = 0.05
"""Weight of a view that sees the ground far more coarsely than the view it is compared with."""

HIDDEN_WEIGHT = 0.01
"""Weight of a view that an obstacle probably keeps from seeing the point."""

GLOSS_RANGE = 0.35
"""Share of the ground's brightness that gloss and reflections may add or take."""

GLOSS_SHARE, GLOSS_WEIGHT = 0.25, 1.5
"""Share of the views that agree, and weight of views, that must see the ground in a picture's own
brightness for it to be another look of the ground."""


@kernel
def _sharpness(horizontal2: float, height: float) -> float:
    """Pixels per square metre of ground seen from a height, up to the focal length squared."""
    distance2 = horizontal2 + height * height
    return height / (distance2 * np.sqrt(distance2))


@kernel
def _ground_at(ground_from_pixel: Float, u: int, v: int) -> tuple[float, float]:
    """Ground point of a pixel, metres."""
    g = ground_from_pixel
    w = g[2, 0] * u + g[2, 1] * v + g[2, 2]
    x = (g[0, 0] * u + g[0, 1] * v + g[0, 2]) / w
    return x, (g[1, 0] * u + g[1, 1] * v + g[1, 2]) / w


@kernel
def _collect(
    x: float,
    y: float,
    images: Bytes,
    hidden: Bytes,
    sizes: NDArray[np.int64],
    h: Float,
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
        depth = h[j, 2, 0] * x + h[j, 2, 1] * y + h[j, 2, 2]
        if depth <= 1e-6:
            continue
        inverse = 1.0 / depth
        u = (h[j, 0, 0] * x + h[j, 0, 1] * y + h[j, 0, 2]) * inverse
        v = (h[j, 1, 0] * x + h[j, 1, 1] * y + h[j, 1, 2]) * inverse
        if not (u >= 1 and v >= 1 and u < sizes[j, 0] - 2 and v < sizes[j, 1] - 2):
            continue
        away2 = (x - centres[j, 0]) ** 2 + (y - centres[j, 1]) ** 2
        if away2 > reach2 * centres[j, 2] ** 2:
            continue
        relative = np.sqrt(_sharpness(away2, centres[j, 2]) / own_sharpness)
        weight = min(1.0, max(LEAST_SHARPNESS, relative))
        total += weight
        weight *= 1.0 - (1.0 - HIDDEN_WEIGHT) / 255.0 * hidden[j, int(v + 0.5), int(u + 0.5)]
        open_weight += weight
        iu, iv = int(u), int(v)
        fu, fv = np.float32(u - iu), np.float32(v - iv)
        for k in range(3):
            a = np.float32(images[j, iv, iu, k])
            b = np.float32(images[j, iv, iu + 1, k])
            c = np.float32(images[j, iv + 1, iu, k])
            d = np.float32(images[j, iv + 1, iu + 1, k])
            top, bottom = a + fu * (b - a), c + fu * (d - c)
            colours[k, m] = top + fv * (bottom - top)
        weights[m] = weight
        m += 1
    return m, total, open_weight


@kernel
def _agreement(colours: Single, b: int, colour: Colour, inverse_scale2: np.float32) -> np.float32:
    """How much a fetched colour counts for another one, 0..1."""
    red, green, blue = (
        colours[0, b] - colour[0],
        colours[1, b] - colour[1],
        colours[2, b] - colour[2],
    )
    d = (red * red + green * green + blue * blue) * inverse_scale2
    return np.float32(1) / (np.float32(1) + d * d)


@kernel
def _mode(
    colours: Single, weights: Single, m: int, inverse_scale2: np.float32, votes: Single
) -> tuple[float, Colour]:
    """Find the colour most of the weight agrees on: that weight, and the colour."""
    votes[:m] = 0.0
    for b in range(m):
        colour, weight = (colours[0, b], colours[1, b], colours[2, b]), weights[b]
        for a in range(m):
            votes[a] += weight * _agreement(colours, a, colour, inverse_scale2)
    best, chosen = -1.0, 0
    for a in range(m):
        vote = votes[a] * (0.3 + weights[a])  # a sharp view's colour is a better start
        if vote > best:
            best, chosen = vote, a
    start = (colours[0, chosen], colours[1, chosen], colours[2, chosen])
    return _mean_around(colours, weights, m, inverse_scale2, start)


@kernel
def _mean_around(
    colours: Single, weights: Single, m: int, inverse_scale2: np.float32, start: Colour
) -> tuple[float, Colour]:
    """Follow the colours that agree with a first one: their weight, and their mean."""
    support, mean = 0.0, start
    for _ in range(2):
        support, red, green, blue = 0.0, 0.0, 0.0, 0.0
        for b in range(m):
            w = weights[b] * _agreement(colours, b, mean, inverse_scale2)
            support += w
            red += w * colours[0, b]
            green += w * colours[1, b]
            blue += w * colours[2, b]
        if support <= 0.0:
            return 0.0, start
        mean = (
            np.float32(red / support), np.float32(green / support), np.float32(blue / support)
        )  # fmt: skip
    return support, mean


@kernel
def _other_look(
    colours: Single,
    weights: Single,
    m: int,
    inverse_scale2: np.float32,
    own: Bytes,
    mode: Colour,
    agreed: float,
) -> Colour:
    """Exchange the usual colour for the one of views that see the ground as bright as this one."""
    brightness = (mode[0] + mode[1] + mode[2]) / np.float32(3)
    change = (np.float32(own[0]) + own[1] + own[2]) / np.float32(3) - brightness
    if abs(change) > GLOSS_RANGE * brightness:
        return mode
    start = (mode[0] + change, mode[1] + change, mode[2] + change)
    support, look = _mean_around(colours, weights, m, inverse_scale2, start)
    return look if support >= max(GLOSS_SHARE * agreed, GLOSS_WEIGHT) else mode


@kernel
def ground_behind(
    view: int, others: NDArray[np.int64], images: Bytes, hidden: Bytes, sizes: NDArray[np.int64],
    pixel_from_ground: Float, ground_from_pixel: Float, ray_z: Float, centres: Float,
    colour_scale: float, reach: float, solid: NDArray[np.bool_],
    colour: Single, support: Single, open_weight: Single, total_weight: Single,
) -> None:  # fmt: skip
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
    solid : (h, w) bool
        Where the view may show an obstacle: there, what looks like gloss may be its colour.
    colour, support, open_weight, total_weight
        (h, w, 3) and (h, w) float32, filled: the colour most agree on, the weight that agrees,
        the weight of all views not hidden there, and of all views. Zero where nothing is seen.
    """
    height, width = support.shape
    n = len(others)
    colours, weights = np.zeros((3, n), np.float32), np.zeros(n, np.float32)
    votes, inverse_scale2 = np.zeros(n, np.float32), np.float32(1 / colour_scale**2)
    for v in range(height):
        for u in range(width):
            support[v, u], open_weight[v, u], total_weight[v, u] = 0.0, 0.0, 0.0
            if ray_z[0] * u + ray_z[1] * v + ray_z[2] >= -1e-4:
                continue
            x, y = _ground_at(ground_from_pixel, u, v)
            away2 = (x - centres[view, 0]) ** 2 + (y - centres[view, 1]) ** 2
            if away2 > (reach * centres[view, 2]) ** 2:
                continue
            m, total, opened = _collect(
                x, y, images, hidden, sizes, pixel_from_ground, centres, others,
                _sharpness(away2, centres[view, 2]), reach * reach, colours, weights,
            )  # fmt: skip
            total_weight[v, u], open_weight[v, u] = total, opened
            if m:
                agreed, mode = _mode(colours, weights, m, inverse_scale2, votes)
                support[v, u] = agreed
                if not solid[v, u]:
                    own = images[view, v, u]
                    mode = _other_look(colours, weights, m, inverse_scale2, own, mode, agreed)
                colour[v, u, 0], colour[v, u, 1], colour[v, u, 2] = mode
