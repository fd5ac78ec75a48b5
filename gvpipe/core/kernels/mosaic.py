"""Sampling of pictures on a map tile, and the choice among the samples of one map pixel.

A tile's samples are packed: pixel (v, u) of a tile has ``count[v, u]`` of them, in
``samples[v, u, :count]`` (RGB, float32) with their densities and the number of their view.
"""

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.kernels.jit import kernel

Single = NDArray[np.float32]


@kernel
def sample_view(
    pixels: NDArray[np.uint8],
    pixel_from_tile: NDArray[np.float64],
    max_depth: float,
    view: int,
    samples: Single,
    density: Single,
    views: NDArray[np.int16],
    count: NDArray[np.int16],
) -> None:
    """Add one picture's bilinear samples to a tile.

    ``pixel_from_tile`` takes tile pixels to image pixels, its third component the depth in
    metres; samples deeper than `max_depth` or outside the picture are left out. The density is
    image pixels per tile pixel, ``|det A| / depth^3``.
    """
    a = pixel_from_tile
    u_last, v_last = pixels.shape[1] - 1.0, pixels.shape[0] - 1.0
    det = abs(
        a[0, 0] * (a[1, 1] * a[2, 2] - a[1, 2] * a[2, 1])
        - a[0, 1] * (a[1, 0] * a[2, 2] - a[1, 2] * a[2, 0])
        + a[0, 2] * (a[1, 0] * a[2, 1] - a[1, 1] * a[2, 0])
    )
    for v in range(count.shape[0]):
        for u in range(count.shape[1]):
            w = a[2, 0] * u + a[2, 1] * v + a[2, 2]
            if w <= 0.0 or w > max_depth:
                continue
            x = (a[0, 0] * u + a[0, 1] * v + a[0, 2]) / w
            y = (a[1, 0] * u + a[1, 1] * v + a[1, 2]) / w
            if not (0.0 <= x <= u_last and 0.0 <= y <= v_last):
                continue
            x0, y0 = min(int(x), pixels.shape[1] - 2), min(int(y), pixels.shape[0] - 2)
            fx, fy = np.float32(x - x0), np.float32(y - y0)
            k = count[v, u]
            for c in range(3):
                p00, p01 = np.float32(pixels[y0, x0, c]), np.float32(pixels[y0, x0 + 1, c])
                p10, p11 = np.float32(pixels[y0 + 1, x0, c]), np.float32(pixels[y0 + 1, x0 + 1, c])
                top, bottom = p00 + fx * (p01 - p00), p10 + fx * (p11 - p10)
                samples[v, u, k, c] = top + fy * (bottom - top)
            density[v, u, k] = det / (w * w * w)
            views[v, u, k] = view
            count[v, u] = k + 1


@kernel
def blend_best(
    samples: Single, density: Single, count: NDArray[np.int16], rgba: NDArray[np.uint8]
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
                    rgba[v, u, c] = np.uint8(samples[v, u, best, c] + np.float32(0.5))
                rgba[v, u, 3] = 255


@kernel
def blend_robust(
    samples: Single, density: Single, count: NDArray[np.int16], rgba: NDArray[np.uint8]
) -> None:
    """Drop the sample farthest from the mean until ceil(n / 2) remain; average the rest.

    Of two equally far samples the one of lower density goes. Changes the order of `samples`.
    """
    for v in range(count.shape[0]):
        for u in range(count.shape[1]):
            n = int(count[v, u])
            if n == 0:
                continue
            r, g, b = np.float32(0.0), np.float32(0.0), np.float32(0.0)
            p, q = samples[v, u], density[v, u]
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
