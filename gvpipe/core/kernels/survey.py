"""Coarse cells of the ground: their colour in every view, and the vote on which views see it.

Arrays of a tile are (h, w, n): cells by views; a view that does not see a cell has radius -1 there.
"""

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.kernels.jit import kernel
from gvpipe.core.kernels.median import median

Single = NDArray[np.float32]


@kernel
def cell_colours(
    pixels: NDArray[np.uint8],
    rows: NDArray[np.int32],
    columns: NDArray[np.int32],
    pixel_from_cell: NDArray[np.float64],
    max_depth: float,
    centre: NDArray[np.float64],
    radius: float,
    colours: Single,
    slopes: Single,
    radii: Single,
) -> None:
    """Mean colour and slope of a picture over each cell, from three by three bilinear samples.

    Writes ``colours[v, u]`` (RGB); ``slopes[v, u]``, how much brighter the right and lower edges
    are than the left and upper ones, each 2/3 of a cell apart, grey levels; and ``radii[v, u]``,
    the squared distance of the cell's centre from the image centre in units of `radius`; -1 where
    the picture shows less than half of it.
    """
    a = pixel_from_cell
    u_last, v_last = pixels.shape[1] - 1.0, pixels.shape[0] - 1.0
    for v in range(radii.shape[0]):
        for u in range(radii.shape[1]):
            r, g, b, n = np.float32(0.0), np.float32(0.0), np.float32(0.0), 0
            square, slope = np.float32(0.0), np.float32(0.0)
            for k in range(9):
                du, dv = u + (k % 3 - 1) / 3.0, v + (k // 3 - 1) / 3.0
                w = a[2, 0] * du + a[2, 1] * dv + a[2, 2]
                if w <= 0.0 or w > max_depth:
                    continue
                x = (a[0, 0] * du + a[0, 1] * dv + a[0, 2]) / w
                y = (a[1, 0] * du + a[1, 1] * dv + a[1, 2]) / w
                if not (0.0 <= x <= u_last and 0.0 <= y <= v_last):
                    continue
                i, j = min(int(x), pixels.shape[1] - 2), min(int(y), pixels.shape[0] - 2)
                if not (rows[j, 0] <= i < rows[j, 1] and columns[i, 0] <= j < columns[i, 1]):
                    continue
                fx, fy = np.float32(x - i), np.float32(y - j)
                w00, w01 = (1 - fx) * (1 - fy), fx * (1 - fy)
                w10, w11 = (1 - fx) * fy, fx * fy
                p, q = pixels[j, i], pixels[j, i + 1]
                s, t = pixels[j + 1, i], pixels[j + 1, i + 1]
                red = w00 * p[0] + w01 * q[0] + w10 * s[0] + w11 * t[0]
                green = w00 * p[1] + w01 * q[1] + w10 * s[1] + w11 * t[1]
                blue = w00 * p[2] + w01 * q[2] + w10 * s[2] + w11 * t[2]
                r, g, b = r + red, g + green, b + blue
                slope += (k % 3 + k // 3 - 2) * (red + green + blue)
                square += np.float32((x - centre[0]) ** 2 + (y - centre[1]) ** 2)
                n += 1
            if n < 5:
                radii[v, u] = -1.0
                continue
            colours[v, u, 0], colours[v, u, 1], colours[v, u, 2] = r / n, g / n, b / n
            slopes[v, u] = slope / 9
            radii[v, u] = square / (n * radius * radius)


@kernel
def successive(
    colours: Single, radii: Single, step: int, same: float
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Pair every view of a cell with the next one that sees it, round the list.

    So every chain of views closes. Every `step`-th cell each way is taken, where both views see
    the cells right of and below it too.

    Returns
    -------
    pairs : (N, 2) int64
        The two views, as places in the last axis.
    log_ratio : (N,) float64
        Logarithm of the brightness in the first over that in the second.
    both : (N, 2) float64
        The radii in the two.
    weight : (N,) float64
        ``1 / (1 + (c / same)^2)`` of the larger change c of the log ratio to these two cells.
    """
    h, w, n = radii.shape
    most = (h // step + 1) * (w // step + 1) * n
    pairs, both = np.empty((most, 2), np.int64), np.empty((most, 2))
    ratio, weight = np.empty(most), np.empty(most)
    light, seen = np.empty((3, n)), np.empty(n, np.bool_)
    count = 0
    for v in range(0, h - 1, step):
        for u in range(0, w - 1, step):
            for k in range(n):
                seen[k] = min(radii[v, u, k], radii[v, u + 1, k], radii[v + 1, u, k]) >= 0
                if seen[k]:
                    for q in range(3):
                        c = colours[v + q // 2, u + q % 2, k]
                        light[q, k] = np.log1p((c[0] + c[1] + c[2]) / 3.0)
            for a in range(n):
                if not seen[a]:
                    continue
                b = (a + 1) % n
                while not seen[b]:
                    b = (b + 1) % n
                if b == a:
                    continue
                r = light[0, a] - light[0, b]
                change = max(abs(light[1, a] - light[1, b] - r), abs(light[2, a] - light[2, b] - r))
                pairs[count, 0], pairs[count, 1], ratio[count] = a, b, r
                both[count, 0], both[count, 1] = radii[v, u, a], radii[v, u, b]
                weight[count] = 1.0 / (1.0 + (change / same) ** 2)
                count += 1
    # copies: what is kept of every tile must not hold the whole room
    return pairs[:count], ratio[:count].copy(), both[:count].copy(), weight[:count].copy()


@kernel
def likeness(
    c: Single, d: Single, s: np.float32, t: np.float32, spread: float, noise: float, grain: float
) -> float:
    """How much a view of colour `c` (3,) and slope `s` speaks for another of `d` and `t`.

    A Gaussian of their colours, of deviation `spread`, times ``1 + grain g`` of their slopes'
    likeness ``g = 2 s t / (s^2 + t^2 + 2 noise^2)``: 1 where both show a grain that is stronger
    than the deviation `noise`, 0 in the mean where they do not, or there is none.
    """
    square = (c[0] - d[0]) ** 2 + (c[1] - d[1]) ** 2 + (c[2] - d[2]) ** 2
    shared = 2.0 * s * t / (s * s + t * t + 2.0 * noise * noise)
    return np.exp(-0.5 / (spread * spread) * square) * (1.0 + grain * shared)


@kernel
def _crowd(k: int, alone: Single, bearing_x: Single, bearing_y: Single) -> np.float32:
    """Weight of all views from the direction of view k: cos^16 of the angle between counts."""
    crowd = np.float32(0.0)
    for m in range(len(alone)):
        if alone[m] > 0:
            c = bearing_x[k] * bearing_x[m] + bearing_y[k] * bearing_y[m]
            if c > 0:
                c *= c
                c *= c
                c *= c
                crowd += c * c * alone[m]
    return crowd


@kernel
def vote(
    colours: Single,
    slopes: Single,
    radii: Single,
    cameras: NDArray[np.float64],
    x_first: float,
    y_first: float,
    step: float,
    reach: float,
    spread: float,
    noise: float,
    grain: float,
    weights: Single,
    support: Single,
) -> None:
    """How much of the evidence in a cell backs each view's colour there.

    `cameras` (n, 3) are the camera centres in the map, the cells lie at ``x_first + u step``,
    ``y_first - v step``. A view's weight falls with the length of its line of sight over the
    ground in camera heights (constant `reach`), since a longer one passes more places where an
    obstacle may stand, and views from the same direction share one weight, since the same
    obstacle hides the ground from all of them: by cos^16 of the angle between, half at 17
    degrees. The support of a view is its own weight and that of all others by their
    :func:`likeness`.
    """
    h, w, n = radii.shape
    bearing_x, bearing_y = np.zeros(n, np.float32), np.zeros(n, np.float32)
    alone = np.zeros(n, np.float32)
    for v in range(h):
        for u in range(w):
            for k in range(n):
                weights[v, u, k] = 0.0
                support[v, u, k] = 0.0
                alone[k] = 0.0
                if radii[v, u, k] < 0:
                    continue
                dx = cameras[k, 0] - (x_first + u * step)
                dy = cameras[k, 1] - (y_first - v * step)
                distance = max(np.sqrt(dx * dx + dy * dy), 1e-6)
                bearing_x[k], bearing_y[k] = dx / distance, dy / distance
                alone[k] = np.exp(-distance / (reach * cameras[k, 2]))
            for k in range(n):
                if alone[k] <= 0:
                    continue
                weights[v, u, k] = alone[k] / _crowd(k, alone, bearing_x, bearing_y)
            for k in range(n):
                if alone[k] <= 0:
                    continue
                support[v, u, k] += weights[v, u, k]
                for m in range(k + 1, n):
                    if alone[m] > 0:
                        like = likeness(
                            colours[v, u, k],
                            colours[v, u, m],
                            slopes[v, u, k],
                            slopes[v, u, m],
                            spread,
                            noise,
                            grain,
                        )
                        support[v, u, k] += weights[v, u, m] * like
                        support[v, u, m] += weights[v, u, k] * like


@kernel
def agree(
    colours: Single,
    radii: Single,
    support: Single,
    spread: float,
    tolerance: float,
    clean: Single,
) -> None:
    """Mark, per cell, how well each view's colour fits the ground there, 0 to 1.

    The ground is the mean of the colours like that of the view with the highest `support`
    (deviation `spread`); the fit is a Gaussian of deviation `tolerance` around it.
    """
    h, w, n = radii.shape
    near, fit = -0.5 / (spread * spread), -0.5 / (tolerance * tolerance)
    for v in range(h):
        for u in range(w):
            best = -1
            for k in range(n):
                clean[v, u, k] = 0.0
                if radii[v, u, k] >= 0 and (best < 0 or support[v, u, k] > support[v, u, best]):
                    best = k
            if best < 0:
                continue
            total, r, g, b = 0.0, 0.0, 0.0, 0.0
            for k in range(n):
                if radii[v, u, k] >= 0:
                    c, d = colours[v, u, k], colours[v, u, best]
                    s = (c[0] - d[0]) ** 2 + (c[1] - d[1]) ** 2 + (c[2] - d[2]) ** 2
                    weight = np.exp(near * s)
                    total += weight
                    r += weight * c[0]
                    g += weight * c[1]
                    b += weight * c[2]
            r, g, b = r / total, g / total, b / total
            for k in range(n):
                if radii[v, u, k] >= 0:
                    c = colours[v, u, k]
                    s = (c[0] - r) ** 2 + (c[1] - g) ** 2 + (c[2] - b) ** 2
                    clean[v, u, k] = np.exp(fit * s)


@kernel
def median_light(brightness: Single, clean: Single, share: float, light: Single) -> None:
    """Median brightness of the clean views of each cell; NaN where no view sees it.

    `brightness` (h, w, n) is that of each view there; clean are the views down to `share` of the
    cleanest one's weight.
    """
    h, w, n = clean.shape
    few = np.empty(n, np.float32)
    for v in range(h):
        for u in range(w):
            cleanest = np.float32(0.0)
            for k in range(n):
                cleanest = max(cleanest, clean[v, u, k])
            m = 0
            for k in range(n):
                if clean[v, u, k] > 0.0 and clean[v, u, k] >= share * cleanest:
                    few[m] = brightness[v, u, k]
                    m += 1
            light[v, u] = median(few, m) if m > 0 else np.nan
