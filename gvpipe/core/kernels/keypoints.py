"""Blobs of a scale space, their orientation and their gradient histograms."""

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.kernels.jit import kernel
from gvpipe.core.types import Float

Float32 = NDArray[np.float32]

CELLS = 4  # descriptor cells a side
BINS = 8  # directions a cell
_GRID = 16  # gradient samples a side of the descriptor
_APART = 0.75  # distance of samples in units of the blob's sigma: cells are 3 sigma, as in SIFT
_TURNS = 36  # directions of the orientation histogram
_TURN_HALF = 6  # samples from the centre to the side of the orientation window
_SECOND_PEAK = 0.8  # of the strongest direction: also a keypoint


@kernel
def _highest(values: Float32, r: int, c: int, value: float) -> bool:
    """Whether no pixel of the 3 by 3 around (r, c) is above `value`."""
    for dr in range(-1, 2):
        for dc in range(-1, 2):
            if values[r + dr, c + dc] > value:
                return False
    return True


@kernel
def _lowest(values: Float32, r: int, c: int, value: float) -> bool:
    """Whether no pixel of the 3 by 3 around (r, c) is below `value`."""
    for dr in range(-1, 2):
        for dc in range(-1, 2):
            if values[r + dr, c + dc] < value:
                return False
    return True


@kernel
def _refined(below: Float32, here: Float32, above: Float32, r: int, c: int, out: Float) -> bool:
    """Offset (row, column, layer) and value at the extremum of the local parabola."""
    g0 = 0.5 * (here[r + 1, c] - here[r - 1, c])
    g1 = 0.5 * (here[r, c + 1] - here[r, c - 1])
    g2 = 0.5 * (above[r, c] - below[r, c])
    twice = 2.0 * here[r, c]
    h00 = here[r + 1, c] + here[r - 1, c] - twice
    h11 = here[r, c + 1] + here[r, c - 1] - twice
    h22 = above[r, c] + below[r, c] - twice
    h01 = 0.25 * (here[r + 1, c + 1] - here[r + 1, c - 1] - here[r - 1, c + 1] + here[r - 1, c - 1])
    h02 = 0.25 * (above[r + 1, c] - above[r - 1, c] - below[r + 1, c] + below[r - 1, c])
    h12 = 0.25 * (above[r, c + 1] - above[r, c - 1] - below[r, c + 1] + below[r, c - 1])
    trace, det2 = h00 + h11, h00 * h11 - h01 * h01
    if det2 <= 0.0 or trace * trace > 12.1 * det2:  # (10 + 1)^2 / 10: an edge, not a blob
        return False
    c00, c01, c02 = h11 * h22 - h12 * h12, h02 * h12 - h01 * h22, h01 * h12 - h02 * h11
    det = h00 * c00 + h01 * c01 + h02 * c02
    if abs(det) < 1e-12:
        return False
    c11, c12, c22 = h00 * h22 - h02 * h02, h01 * h02 - h00 * h12, det2
    out[0] = -(c00 * g0 + c01 * g1 + c02 * g2) / det
    out[1] = -(c01 * g0 + c11 * g1 + c12 * g2) / det
    out[2] = -(c02 * g0 + c12 * g1 + c22 * g2) / det
    if not (abs(out[0]) < 1.0 and abs(out[1]) < 1.0 and abs(out[2]) < 1.0):
        return False
    out[3] = here[r, c] + 0.5 * (g0 * out[0] + g1 * out[1] + g2 * out[2])
    return True


@kernel
def _standing_out(values: Float32, r: int, rough: np.float32, out: NDArray[np.bool_]) -> None:
    """Which pixels of a row, but the first and the last, no neighbour of four exceeds."""
    row, up, down = values[r], values[r - 1, 1:-1], values[r + 1, 1:-1]
    left, here, right = row[:-2], row[1:-1], row[2:]
    for c in range(len(out)):
        value = here[c]
        high = max(max(left[c], right[c]), max(up[c], down[c]))
        low = min(min(left[c], right[c]), min(up[c], down[c]))
        out[c] = ((value > rough) & (value >= high)) | ((value < -rough) & (value <= low))


@kernel
def find_blobs(
    below: Float32, here: Float32, above: Float32, threshold: float, border: int, most: int
) -> Float:
    """Extrema of one layer of a difference-of-Gaussians stack.

    Parameters
    ----------
    below, here, above : (h, w) float32
        Three neighbouring layers.
    threshold : float
        Least contrast, grey levels.
    border : int
        Pixels along the sides that are left out, at least 1.
    most : int
        Room for this many.

    Returns
    -------
    blobs : (N, 4) float64
        u, v (pixels), layer offset (-1 to 1) and the value there: its size is the contrast.
    """
    found = np.empty((most, 4))
    count = 0
    offset = np.empty(4)
    rows, columns = here.shape
    rough = np.float32(0.8 * threshold)  # the parabola's top may be above the pixel's value
    likely = np.empty(columns - 2, np.bool_)
    for r in range(border, rows - border):
        # four neighbours settle most pixels before the other 22 are looked at
        _standing_out(here, r, rough, likely)
        for c in range(border, columns - border):
            if not likely[c - 1]:
                continue
            value = here[r, c]
            if value > 0:
                extreme = (
                    _highest(here, r, c, value)
                    and _highest(below, r, c, value)
                    and _highest(above, r, c, value)
                )
            else:
                extreme = (
                    _lowest(here, r, c, value)
                    and _lowest(below, r, c, value)
                    and _lowest(above, r, c, value)
                )
            if not extreme:
                continue
            if not _refined(below, here, above, r, c, offset) or abs(offset[3]) < threshold:
                continue
            if count < most:
                found[count, 0], found[count, 1] = c + offset[1], r + offset[0]
                found[count, 2], found[count, 3] = offset[2], offset[3]
                count += 1
    return found[:count]


@kernel
def _bilinear(image: Float32, u: float, v: float) -> float:
    """Value between pixels."""
    c, r = int(u), int(v)
    fu, fv = u - c, v - r
    top = image[r, c] + fu * (image[r, c + 1] - image[r, c])
    low = image[r + 1, c] + fu * (image[r + 1, c + 1] - image[r + 1, c])
    return top + fv * (low - top)


@kernel
def _patch(
    image: Float32, u: float, v: float, apart: float, angle: float, half: float, out: Float
) -> None:
    """Fill `out` with a square turned by `angle`, rows along its second axis."""
    c, s = apart * np.cos(angle), apart * np.sin(angle)
    side = out.shape[0]
    last_u, last_v = image.shape[1] - 1.001, image.shape[0] - 1.001
    us, vs = np.empty(side), np.empty(side)
    for r in range(side):
        y = r - half
        for k in range(side):
            x = k - half
            us[k] = min(max(u + c * x - s * y, 0.0), last_u)
            vs[k] = min(max(v + s * x + c * y, 0.0), last_v)
        for k in range(side):
            out[r, k] = _bilinear(image, us[k], vs[k])


@kernel
def _direction(gx: float, gy: float) -> float:
    """Angle in turns, 0 to 1; a polynomial good to a thousandth of a turn."""
    ax, ay = abs(gx), abs(gy)
    small, large = min(ax, ay), max(ax, ay)
    t = small / max(large, 1e-300)  # no gradient: direction 0
    a = t * (0.1591549 + 0.0434 * (1.0 - t))  # atan(t) / 2 pi to 0.0003
    if ay > ax:
        a = 0.25 - a
    if gx < 0:
        a = 0.5 - a
    return a if gy >= 0 else 1.0 - a


@kernel
def _gradients(patch: Float, weights: Float, bins: int, size: Float, place: Float) -> None:
    """Weighted length and direction, in bins, of the gradients inside a patch."""
    for r in range(weights.shape[0]):
        here, up, down = patch[r + 1], patch[r], patch[r + 2]
        for c in range(weights.shape[1]):
            gx, gy = here[c + 2] - here[c], down[c + 1] - up[c + 1]
            size[r, c] = weights[r, c] * np.sqrt(gx * gx + gy * gy)
            place[r, c] = _direction(gx, gy) * bins


@kernel
def orientations(image: Float32, u: Float, v: Float, sigma: Float) -> tuple[Float, Float]:
    """Dominant gradient directions around blobs.

    Parameters
    ----------
    image : (h, w) float32
        Smoothed picture.
    u, v, sigma : (N,) float64
        Blobs, pixels.

    Returns
    -------
    first, second : (N,) float64
        Radians from right towards down; `second` is NaN where one direction dominates.
    """
    n = len(u)
    first, second = np.zeros(n), np.full(n, np.nan)
    side = 2 * _TURN_HALF + 1
    patch, weights = np.empty((side + 2, side + 2)), np.zeros((side, side))
    for r in range(side):
        for c in range(side):
            square = float((r - _TURN_HALF) ** 2 + (c - _TURN_HALF) ** 2)
            if square <= _TURN_HALF * _TURN_HALF:
                weights[r, c] = np.exp(-square / 8.0)  # Gaussian of 1.5 sigma = 2 samples
    size, places = np.empty((side, side)), np.empty((side, side))
    raw, smooth = np.zeros(_TURNS), np.zeros(_TURNS)
    for k in range(n):
        _patch(image, u[k], v[k], _APART * sigma[k], 0.0, _TURN_HALF + 1.0, patch)
        for b in range(_TURNS):
            raw[b] = 0.0
        _gradients(patch, weights, _TURNS, size, places)
        for r in range(side):
            for c in range(side):
                if weights[r, c] == 0.0:
                    continue
                b = int(places[r, c])
                part = places[r, c] - b
                raw[b % _TURNS] += size[r, c] * (1.0 - part)
                raw[(b + 1) % _TURNS] += size[r, c] * part
        for b in range(_TURNS):
            near = raw[b - 1] + raw[(b + 1) % _TURNS]
            far = raw[b - 2] + raw[(b + 2) % _TURNS]
            smooth[b] = (6.0 * raw[b] + 4.0 * near + far) / 16.0
        best, other = -1, -1
        for b in range(_TURNS):
            if smooth[b] < smooth[b - 1] or smooth[b] <= smooth[(b + 1) % _TURNS]:
                continue
            if best < 0 or smooth[b] > smooth[best]:
                best, other = b, best
            elif other < 0 or smooth[b] > smooth[other]:
                other = b
        if best >= 0:
            first[k] = _peak(smooth, best)
        if other >= 0 and smooth[other] > _SECOND_PEAK * smooth[best]:
            second[k] = _peak(smooth, other)
    return first, second


@kernel
def _peak(histogram: Float, b: int) -> float:
    """Radians of a peak between bins."""
    n = len(histogram)
    left, right = histogram[b - 1], histogram[(b + 1) % n]
    curve = left + right - 2.0 * histogram[b]
    place = b + (0.5 * (left - right) / curve if curve < 0 else 0.0)
    return 2.0 * np.pi * place / n


@kernel
def describe(image: Float32, u: Float, v: Float, sigma: Float, angle: Float) -> NDArray[np.uint8]:
    """Gradient histograms around blobs, turned upright.

    Parameters
    ----------
    image : (h, w) float32
        Picture smoothed to about the blobs' sigma.
    u, v, sigma, angle : (N,) float64
        Blobs, pixels and radians from right towards down.

    Returns
    -------
    descriptors : (N, CELLS * CELLS * BINS) uint8
        Square roots of the share of each cell and direction, times 512, at most 255.
    """
    n = len(u)
    out = np.zeros((n, CELLS * CELLS * BINS), np.uint8)
    patch, weights = np.empty((_GRID + 2, _GRID + 2)), np.empty((_GRID, _GRID))
    middle = 0.5 * (_GRID - 1)
    for r in range(_GRID):
        for c in range(_GRID):  # the centre is most certain
            weights[r, c] = 1.0 / (1.0 + ((c - middle) ** 2 + (r - middle) ** 2) / 64.0)
    size, places = np.empty((_GRID, _GRID)), np.empty((_GRID, _GRID))
    # one cell and one direction of room on each side take what falls outside
    histogram = np.zeros((CELLS + 2, CELLS + 2, BINS + 1))
    for k in range(n):
        _patch(image, u[k], v[k], _APART * sigma[k], angle[k], 0.5 * (_GRID + 1), patch)
        _gradients(patch, weights, BINS, size, places)
        histogram[:] = 0.0
        for r in range(_GRID):
            row = (r + 0.5) / CELLS + 0.5
            r0 = int(row)
            fr = row - r0
            for c in range(_GRID):
                column = (c + 0.5) / CELLS + 0.5
                c0 = int(column)
                fc = column - c0
                b = int(places[r, c])
                fb = places[r, c] - b
                b = min(b, BINS - 1)
                for dr in range(2):
                    wr = size[r, c] * (fr if dr else 1.0 - fr)
                    for dc in range(2):
                        wc = wr * (fc if dc else 1.0 - fc)
                        histogram[r0 + dr, c0 + dc, b] += wc * (1.0 - fb)
                        histogram[r0 + dr, c0 + dc, b + 1] += wc * fb
        total = 1e-9
        for r in range(1, CELLS + 1):
            for c in range(1, CELLS + 1):
                histogram[r, c, 0] += histogram[r, c, BINS]
                for b in range(BINS):
                    total += histogram[r, c, b]
        place_out = 0
        for r in range(1, CELLS + 1):
            for c in range(1, CELLS + 1):
                for b in range(BINS):
                    share = 512.0 * np.sqrt(histogram[r, c, b] / total)
                    out[k, place_out] = np.uint8(min(share + 0.5, 255.0))
                    place_out += 1
    return out
