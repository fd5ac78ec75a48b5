"""Alignment of small ground patches between two pictures to a fraction of a pixel."""

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.kernels.jit import kernel
from gvpipe.core.types import Float

HALF = 6
"""Samples from a patch's centre to its side."""

LEAVES, BLANK, LOST = -4.0, -3.0, -2.0
"""Instead of a correlation, for patches that could not be aligned: see `align_patches`."""

SIDE = 2 * HALF + 1
_COUNT = SIDE * SIDE
_MIN_CONTRAST = 1.5  # standard deviation in grey levels below which a patch is noise
_MIN_SHARPNESS = 1e-3  # least eigenvalue of the structure tensor, of the template's variance
_CONVERGED = 0.02  # samples


@kernel
def _sample(image: NDArray[np.uint8], u: float, v: float) -> float:
    """Bilinear grey value, or -1 outside."""
    height, width = image.shape
    if not (u >= 0.0 and v >= 0.0 and u < width - 1 and v < height - 1):
        return -1.0
    c, r = int(u), int(v)
    fu, fv = u - c, v - r
    top = image[r, c] + fu * (image[r, c + 1] * 1.0 - image[r, c])
    low = image[r + 1, c] + fu * (image[r + 1, c + 1] * 1.0 - image[r + 1, c])
    return top + fv * (low - top)


@kernel
def _fill(
    image: NDArray[np.uint8],
    level: int,
    projection: Float,
    x: float,
    y: float,
    spacing: float,
    half: int,
    places: Float,
    out: Float,
) -> bool:
    """Sample a square of ground around (x, y); False if any of it is not in the picture."""
    shrink = 1.0 / (1 << level)
    n = 2 * half + 1
    u, v, w = places[0, :n], places[1, :n], places[2, :n]
    qu, qv, qw = projection[0, 1], projection[1, 1], projection[2, 1]
    ou, ov, ow = projection[0, 2], projection[1, 2], projection[2, 2]
    for r in range(n):
        gx = x + (r - half) * spacing
        # products first, and a loop without branches: the compiler vectorises it
        pu, pv, pw = projection[0, 0] * gx, projection[1, 0] * gx, projection[2, 0] * gx
        for c in range(n):
            gy = y + (c - half) * spacing
            w[c] = pw + qw * gy + ow
            u[c] = (pu + qu * gy + ou) / w[c]
            v[c] = (pv + qv * gy + ov) / w[c]
        for c in range(n):
            if w[c] <= 1e-9:
                return False
            value = _sample(image, u[c] * shrink, v[c] * shrink)
            if value < 0.0:
                return False
            out[r, c] = value
    return True


@kernel
def _density(projection: Float, x: float, y: float) -> float:
    """Pixels per metre, the root of the area ratio, at a ground point; 0 behind the camera."""
    w = projection[2, 0] * x + projection[2, 1] * y + projection[2, 2]
    if w <= 1e-9:
        return 0.0
    p = projection
    det = (
        p[0, 0] * (p[1, 1] * p[2, 2] - p[1, 2] * p[2, 1])
        - p[0, 1] * (p[1, 0] * p[2, 2] - p[1, 2] * p[2, 0])
        + p[0, 2] * (p[1, 0] * p[2, 1] - p[1, 1] * p[2, 0])
    )
    return np.sqrt(abs(det) / w**3)


@kernel
def _level(samples_apart_px: float, levels: int) -> int:
    """Pyramid level for samples that many full-size pixels apart."""
    level = 0
    while level < levels - 1 and samples_apart_px > 1.5:
        samples_apart_px *= 0.5
        level += 1
    return level


@kernel
def _mean(values: Float) -> float:
    total = 0.0
    for r in range(SIDE):
        for c in range(SIDE):
            total += values[r, c]
    return total / _COUNT


@kernel
def _differentiate(padded: Float, template: Float, gx: Float, gy: Float) -> Float:
    """Centre the template and its gradients; return their second moments and its energy."""
    for r in range(SIDE):
        for c in range(SIDE):
            template[r, c] = padded[r + 1, c + 1]
            gx[r, c] = 0.5 * (padded[r + 2, c + 1] - padded[r, c + 1])
            gy[r, c] = 0.5 * (padded[r + 1, c + 2] - padded[r + 1, c])
    mean, mean_x, mean_y = _mean(template), _mean(gx), _mean(gy)
    moments = np.zeros(4)
    for r in range(SIDE):
        for c in range(SIDE):
            template[r, c] -= mean
            gx[r, c] -= mean_x
            gy[r, c] -= mean_y
            moments[0] += gx[r, c] ** 2
            moments[1] += gx[r, c] * gy[r, c]
            moments[2] += gy[r, c] ** 2
            moments[3] += template[r, c] ** 2
    return moments


@kernel
def _correlate(patch: Float, template: Float, energy: float) -> tuple[float, float]:
    """Centre the patch; return its correlation with the template and the gain to match it."""
    mean = _mean(patch)
    cross, energy_j = 0.0, 0.0
    for r in range(SIDE):
        for c in range(SIDE):
            patch[r, c] -= mean
            cross += patch[r, c] * template[r, c]
            energy_j += patch[r, c] ** 2
    if energy_j < _COUNT * _MIN_CONTRAST**2:
        return -1.0, 0.0
    return cross / np.sqrt(energy * energy_j), np.sqrt(energy / energy_j)


@kernel
def _textured(moments: Float) -> bool:
    """Whether a template has contrast, and in both directions."""
    a, b, d, energy = moments[0], moments[1], moments[2], moments[3]
    spread = np.sqrt(0.25 * (a - d) ** 2 + b * b)
    return energy > _COUNT * _MIN_CONTRAST**2 and 0.5 * (a + d) - spread > _MIN_SHARPNESS * energy


@kernel
def _follow(
    patch: Float, template: Float, gx: Float, gy: Float, moments: Float,
    grey: NDArray[np.uint8], level: int, pixel_from_ground: Float,
    x: float, y: float, step: float, max_shift: float, iterations: int, places: Float,
) -> tuple[float, float, float]:  # fmt: skip
    """Move a patch until it looks like the template: correlation, 0 if it never does, and shift."""
    a, b, d, energy = moments[0], moments[1], moments[2], moments[3]
    det = a * d - b * b
    score, dx, dy, settled = 0.0, 0.0, 0.0, False
    for _ in range(iterations + 1):
        score, gain = _correlate(patch, template, energy)
        if score <= 0.0 or settled:
            break
        ex, ey = 0.0, 0.0
        for r in range(SIDE):
            for c in range(SIDE):
                e = gain * patch[r, c] - template[r, c]
                ex += gx[r, c] * e
                ey += gy[r, c] * e
        sx, sy = (d * ex - b * ey) / det, (a * ey - b * ex) / det
        dx -= sx
        dy -= sy
        settled = sx * sx + sy * sy < _CONVERGED**2
        x_j, y_j = x + dx * step, y + dy * step
        if not (abs(dx) <= max_shift and abs(dy) <= max_shift) or not _fill(
            grey, level, pixel_from_ground, x_j, y_j, step, HALF, places, patch
        ):
            return 0.0, dx, dy
    return (score if settled else 0.0), dx, dy


@kernel
def align_patches(
    pyramid_i: tuple[NDArray[np.uint8], ...], pyramid_j: tuple[NDArray[np.uint8], ...],
    pixel_i_from_ground: Float, pixel_j_from_ground: Float, ground: Float,
    coarseness: float, max_shift: float, iterations: int,
) -> tuple[Float, Float, Float]:  # fmt: skip
    """Shift of the ground texture in picture j against picture i.

    Inverse compositional Lucas-Kanade for a shift, blind to gain and offset of the grey values.

    Parameters
    ----------
    pyramid_i, pyramid_j : tuple of (h, w) uint8
        Grey pictures, each half the one before (``cv2.pyrDown``).
    pixel_i_from_ground, pixel_j_from_ground : (3, 3) float64
        From one common ground frame, third component positive in front of the camera.
    ground : (N, 2) float64
        Patch centres in that frame, metres.
    coarseness : float
        Distance of samples in units of the coarser picture's pixels on the ground.
    max_shift : float
        Largest accepted shift, samples.
    iterations : int
        Most steps.

    Returns
    -------
    shift : (N, 2) float64
        Where the patch lies in j, relative to `ground`, metres.
    correlation : (N,) float64
        Normalised cross-correlation there; `LEAVES` where a patch leaves a picture, `BLANK` where
        it has no texture, `LOST` where it does not converge.
    covariance : (N, 2, 2) float64
        Of the shift, metres squared.
    """
    n = len(ground)
    correlation, shift, covariance = np.full(n, LEAVES), np.zeros((n, 2)), np.zeros((n, 2, 2))
    padded, patch = np.empty((SIDE + 2, SIDE + 2)), np.empty((SIDE, SIDE))
    template, gx, gy = np.empty((SIDE, SIDE)), np.empty((SIDE, SIDE)), np.empty((SIDE, SIDE))
    places = np.empty((3, SIDE + 2))
    for k in range(n):
        x, y = ground[k, 0], ground[k, 1]
        density_i = _density(pixel_i_from_ground, x, y)
        density_j = _density(pixel_j_from_ground, x, y)
        if density_i == 0.0 or density_j == 0.0:
            continue
        step = coarseness / min(density_i, density_j)
        level_i = _level(step * density_i, len(pyramid_i))
        level_j = _level(step * density_j, len(pyramid_j))
        grey_i, grey_j = pyramid_i[level_i], pyramid_j[level_j]
        if not (
            _fill(grey_i, level_i, pixel_i_from_ground, x, y, step, HALF + 1, places, padded)
            and _fill(grey_j, level_j, pixel_j_from_ground, x, y, step, HALF, places, patch)
        ):
            continue
        moments = _differentiate(padded, template, gx, gy)
        correlation[k] = LOST if _textured(moments) else BLANK
        if correlation[k] == BLANK:
            continue
        score, dx, dy = _follow(
            patch, template, gx, gy, moments, grey_j, level_j, pixel_j_from_ground, x, y, step,
            max_shift, iterations, places,
        )  # fmt: skip
        if score <= 0.0:
            continue
        a, b, d, energy = moments[0], moments[1], moments[2], moments[3]
        correlation[k], shift[k, 0], shift[k, 1] = score, dx * step, dy * step
        variance = 2.0 * energy * (1.0 - score) / _COUNT * step * step / (a * d - b * b)
        covariance[k, 0, 0], covariance[k, 1, 1] = variance * d, variance * a
        covariance[k, 0, 1] = covariance[k, 1, 0] = -variance * b
    return shift, correlation, covariance
