"""Sampling of pictures on a map tile, and the choice among the samples of one map pixel.

A tile's samples are packed: pixel (v, u) of a tile has ``count[v, u]`` of them, in
``colours[v, u, :count]`` and so on; see ``gvpipe.core.mosaic.blend.Samples``.
"""

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.kernels.jit import kernel
from gvpipe.core.kernels.median import median

Single = NDArray[np.float32]


CLEAN_SHARE = 0.5
"""Samples are used down to this share of the cleanest one's weight."""

PRIOR_VARIANCE = np.float32(100.0)
"""Variance of one sample's brightness as good as known beforehand: 10 grey levels, grain and an
error of a pixel; one view alone says nothing about it."""

ERROR_STEPS = np.float32(8.0)
"""Steps of the error layer in one grey level."""

ERROR_LAST = np.float32(254.0)
"""Largest step of the error layer; 255 = nothing was seen."""


@kernel
def error_steps(total: np.float32, squares: np.float32, n: int) -> int:
    """Count the steps of the standard error of a mean, from the sum and squares of n samples."""
    mean = total / np.float32(n)
    scatter = max(squares - mean * total, np.float32(0.0)) + PRIOR_VARIANCE
    return int(min(ERROR_STEPS * np.sqrt(scatter) / np.float32(n) + np.float32(0.5), ERROR_LAST))


@kernel
def black_border(
    pixels: NDArray[np.uint8],
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """First and last pixel of each row (H, 2) and column (W, 2) inside a picture's black border.

    Undistortion leaves black where the camera saw nothing. One pixel more goes, because it is
    half interpolated from black; where there is no black, nothing goes.
    """
    height, width = pixels.shape[0], pixels.shape[1]
    rows, columns = np.empty((height, 2), np.int32), np.empty((width, 2), np.int32)
    for v in range(height):
        a, b = 0, width - 1
        while a <= b and pixels[v, a, 0] == 0 and pixels[v, a, 1] == 0 and pixels[v, a, 2] == 0:
            a += 1
        while b >= a and pixels[v, b, 0] == 0 and pixels[v, b, 1] == 0 and pixels[v, b, 2] == 0:
            b -= 1
        rows[v, 0] = a + 1 if a > 0 else 0
        rows[v, 1] = b - 1 if b < width - 1 else b
    for u in range(width):
        a, b = 0, height - 1
        while a <= b and pixels[a, u, 0] == 0 and pixels[a, u, 1] == 0 and pixels[a, u, 2] == 0:
            a += 1
        while b >= a and pixels[b, u, 0] == 0 and pixels[b, u, 1] == 0 and pixels[b, u, 2] == 0:
            b -= 1
        columns[u, 0] = a + 1 if a > 0 else 0
        columns[u, 1] = b - 1 if b < height - 1 else b
    return rows, columns


@kernel
def sample_view(
    pixels: NDArray[np.uint8],
    rows: NDArray[np.int32],
    columns: NDArray[np.int32],
    pixel_from_tile: NDArray[np.float64],
    max_depth: float,
    lens: NDArray[np.float64],
    clean_map: NDArray[np.uint8],
    cells: NDArray[np.float64],
    colours: Single,
    density: Single,
    clean: Single,
    count: NDArray[np.int16],
) -> None:
    """Add one picture's bilinear samples to a tile.

    ``pixel_from_tile`` takes tile pixels to image pixels, its third component the depth in
    metres; samples deeper than `max_depth`, outside the picture or in its black border (`rows` and
    `columns` of :func:`black_border`) are left out. The density is
    image pixels per tile pixel, ``|det A| / depth^3``. `lens` holds the image centre, half the
    width, the log gain and the log falloff; `cells` the step and the first column and row of the
    tile in the clean map.
    """
    a = pixel_from_tile
    u_last, v_last = pixels.shape[1] - 1.0, pixels.shape[0] - 1.0
    det = abs(
        a[0, 0] * (a[1, 1] * a[2, 2] - a[1, 2] * a[2, 1])
        - a[0, 1] * (a[1, 0] * a[2, 2] - a[1, 2] * a[2, 0])
        + a[0, 2] * (a[1, 0] * a[2, 1] - a[1, 1] * a[2, 0])
    )
    radius2, falloff = lens[2] * lens[2], lens[4]
    dark = np.exp(-lens[3])
    h, width = clean_map.shape
    for v in range(count.shape[0]):
        cell_v = min(max(cells[0] * v + cells[2], 0.0), h - 1.0)
        j = min(int(cell_v), max(h - 2, 0))
        j1, gv = min(j + 1, h - 1), cell_v - j
        for u in range(count.shape[1]):
            w = a[2, 0] * u + a[2, 1] * v + a[2, 2]
            if w <= 0.0 or w > max_depth:
                continue
            x = (a[0, 0] * u + a[0, 1] * v + a[0, 2]) / w
            y = (a[1, 0] * u + a[1, 1] * v + a[1, 2]) / w
            if not (0.0 <= x <= u_last and 0.0 <= y <= v_last):
                continue
            x0, y0 = min(int(x), pixels.shape[1] - 2), min(int(y), pixels.shape[0] - 2)
            if not (rows[y0, 0] <= x0 < rows[y0, 1] and columns[x0, 0] <= y0 < columns[x0, 1]):
                continue
            fx, fy = np.float32(x - x0), np.float32(y - y0)
            k = count[v, u]
            # exp(-falloff r^2) to second order: exact to 0.2 % for the vignetting of real lenses
            fade = -falloff * ((x - lens[0]) ** 2 + (y - lens[1]) ** 2) / radius2
            correction = np.float32(dark * (1.0 + fade + 0.5 * fade * fade))
            for c in range(3):
                p00, p01 = np.float32(pixels[y0, x0, c]), np.float32(pixels[y0, x0 + 1, c])
                p10, p11 = np.float32(pixels[y0 + 1, x0, c]), np.float32(pixels[y0 + 1, x0 + 1, c])
                top, bottom = p00 + fx * (p01 - p00), p10 + fx * (p11 - p10)
                colours[v, u, k, c] = correction * (top + fy * (bottom - top))
            density[v, u, k] = det / (w * w * w)
            cell_u = min(max(cells[0] * u + cells[1], 0.0), width - 1.0)
            i = min(int(cell_u), max(width - 2, 0))
            i1, gu = min(i + 1, width - 1), cell_u - i
            upper = clean_map[j, i] + gu * (np.float64(clean_map[j, i1]) - clean_map[j, i])
            lower = clean_map[j1, i] + gu * (np.float64(clean_map[j1, i1]) - clean_map[j1, i])
            clean[v, u, k] = (upper + gv * (lower - upper)) / 255.0
            count[v, u] = k + 1


@kernel
def blend_best(
    colours: Single,
    density: Single,
    clean: Single,
    light: Single,
    count: NDArray[np.int16],
    rgba: NDArray[np.uint8],
    error: NDArray[np.uint8],
) -> None:
    """Keep the sample with the highest density of each pixel; the first of equals."""
    for v in range(count.shape[0]):
        for u in range(count.shape[1]):
            best = -1
            for k in range(count[v, u]):
                if best < 0 or density[v, u, k] > density[v, u, best]:
                    best = k
            if best >= 0:
                for c in range(3):
                    rgba[v, u, c] = np.uint8(colours[v, u, best, c] + np.float32(0.5))
                rgba[v, u, 3] = 255
                error[v, u] = error_steps(np.float32(0.0), np.float32(0.0), 1)


@kernel
def blend_half(
    colours: Single,
    density: Single,
    clean: Single,
    light: Single,
    count: NDArray[np.int16],
    rgba: NDArray[np.uint8],
    error: NDArray[np.uint8],
) -> None:
    """Drop the sample farthest from the mean until ceil(n / 2) remain; average the rest.

    Of two equally far samples the one of lower density goes. Changes the order of `colours`.
    """
    for v in range(count.shape[0]):
        for u in range(count.shape[1]):
            n = int(count[v, u])
            if n == 0:
                continue
            r, g, b = np.float32(0.0), np.float32(0.0), np.float32(0.0)
            p, q = colours[v, u], density[v, u]
            for k in range(n):
                r += p[k, 0]
                g += p[k, 1]
                b += p[k, 2]
            keep = (n + 1) // 2
            while n > keep:
                share = np.float32(1.0) / np.float32(n)
                mr, mg, mb = r * share, g * share, b * share
                worst, farthest = 0, np.float32(-1.0)
                for k in range(n):
                    dr, dg, db = p[k, 0] - mr, p[k, 1] - mg, p[k, 2] - mb
                    d = dr * dr + dg * dg + db * db
                    if d > farthest or (n == 2 and q[k] < q[worst]):
                        worst, farthest = k, d
                r -= p[worst, 0]
                g -= p[worst, 1]
                b -= p[worst, 2]
                n -= 1
                for c in range(3):
                    p[worst, c] = p[n, c]
                q[worst] = q[n]
            share = np.float32(1.0) / np.float32(n)
            rgba[v, u, 0] = np.uint8(max(r, np.float32(0.0)) * share + np.float32(0.5))
            rgba[v, u, 1] = np.uint8(max(g, np.float32(0.0)) * share + np.float32(0.5))
            rgba[v, u, 2] = np.uint8(max(b, np.float32(0.0)) * share + np.float32(0.5))
            rgba[v, u, 3] = 255
            total, squares = np.float32(0.0), np.float32(0.0)
            for k in range(n):
                value = (p[k, 0] + p[k, 1] + p[k, 2]) / np.float32(3.0)
                total += value
                squares += value * value
            error[v, u] = error_steps(total, squares, n)


@kernel
def blend_robust(
    colours: Single,
    density: Single,
    clean: Single,
    light: Single,
    count: NDArray[np.int16],
    rgba: NDArray[np.uint8],
    error: NDArray[np.uint8],
) -> None:
    """Median of the clean samples of each pixel, in the pixel's light.

    Changes the order of `colours`.
    """
    for v in range(count.shape[0]):
        for u in range(count.shape[1]):
            n = int(count[v, u])
            if n == 0:
                continue
            cleanest = np.float32(0.0)
            for k in range(n):
                cleanest = max(cleanest, clean[v, u, k])
            p, m = colours[v, u], 0
            total, squares = np.float32(0.0), np.float32(0.0)
            for k in range(n):
                if clean[v, u, k] >= CLEAN_SHARE * cleanest:
                    value = (p[k, 0] + p[k, 1] + p[k, 2]) / np.float32(3.0)
                    total += value
                    squares += value * value
                    for c in range(3):
                        p[m, c] = p[k, c]
                    m += 1
            error[v, u] = error_steps(total, squares, m)
            for c in range(3):
                middle = median(p[:, c], m) * light[v, u]
                rgba[v, u, c] = np.uint8(min(middle + np.float32(0.5), np.float32(255.0)))
            rgba[v, u, 3] = 255
