"""Cut a picture into obstacle and ground along its own edges."""

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from gvpipe.core.kernels.segmentation import cut
from gvpipe.core.types import Float, Image

Single = NDArray[np.float32]
Bins = NDArray[np.int32]

EDGE_FLOOR = 0.15
"""Share of the cost of a cut that remains across the strongest edge."""

EDGE_NOISE2 = 20.0
"""Squared colour step, levels, that sensor noise alone makes between neighbours."""

COARSEST = 200
"""Pixels: a picture no larger than this along one side gets no coarser first guess."""

ITERATIONS = 150
"""Primal-dual steps at the coarsest size; a third of them suffice from a good first guess."""

HUE_BINS, HUE_LIMIT = 48, 1.2
"""Bins of each of the two log ratios of channels, and the largest size of a ratio that they cover:
3.3 times as much of one as of the other."""

LEVEL_BINS, LEVEL_WEIGHT = 16, 0.4
"""Bins a channel of the colours themselves, 16 levels each, and their weight where hues say
nothing."""

DARKEST = 8.0
"""Levels added to a channel before its logarithm: in the dark noise makes any hue."""

NOISE_BLUR = 0.7
"""Sigma, pixels, of the blur that takes sensor noise off before neighbours or hues are compared."""

BIN_BLUR = 0.8
"""Sigma, bins, of the blur of histograms: what falls just beside a bin was seen, too."""

RARE = 1e-5
"""Share of a histogram below which a colour counts as never seen."""

LEAST_PIXELS = 200
"""Obstacle pixels below which their histogram says nothing."""


def segment(gain: Single, picture: Image, strength: float) -> Single:
    """Find the region whose gain is largest, its outline cheap where the picture has edges.

    Parameters
    ----------
    gain : (H, W) float32
        Evidence for the region at each pixel, negative against it, 0 where unknown.
    picture : (H, W, 3) uint8
        Its edges attract the outline.
    strength : float
        Cost of a pixel of outline where the picture is flat, in units of gain.

    Returns
    -------
    region : (H, W) float32
        1 inside, 0 outside, in between where the evidence leaves it open.
    """
    height, width = gain.shape
    iterations, start = ITERATIONS, (gain > 0).astype(np.float32)
    if min(height, width) > COARSEST:
        half = (width // 2, height // 2)
        # four pixels of gain become one, two of outline: the balance doubles
        coarse = segment(
            2 * cv2.resize(gain, half, interpolation=cv2.INTER_AREA).astype(np.float32),
            cv2.resize(picture, half, interpolation=cv2.INTER_AREA).astype(np.uint8),
            strength,
        )
        finer = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)
        start = finer.astype(np.float32)
        iterations //= 3
    weight_x, weight_y = _outline_cost(picture, strength)
    return cut(gain, weight_x, weight_y, iterations, start)


def without_specks(region: Single, smallest: int) -> Single:
    """Flip parts of a region, and holes in it, that have fewer pixels than `smallest`.

    A hole of a few pixels, where an obstacle happens to look like the ground behind it, would
    drill a tunnel through the obstacle.
    """
    cleaned = region.copy()
    for value in (0.0, 1.0):
        part = (cleaned > 0.5) == (value == 0.0)
        _, labels, stats, _ = cv2.connectedComponentsWithStats(
            part.astype(np.uint8), connectivity=4
        )
        small = stats[:, cv2.CC_STAT_AREA] < smallest
        small[0] = False
        cleaned[small[labels]] = value
    return cleaned


def _outline_cost(picture: Image, strength: float) -> tuple[Single, Single]:
    """Cost of a cut between a pixel and the next to the right, and the next below."""
    smooth = cv2.GaussianBlur(picture.astype(np.float32), (0, 0), NOISE_BLUR)
    right = np.zeros(smooth.shape[:2], np.float32)
    below = np.zeros_like(right)
    right[:, :-1] = (np.diff(smooth, axis=1) ** 2).sum(axis=-1)
    below[:-1] = (np.diff(smooth, axis=0) ** 2).sum(axis=-1)
    scale2 = right.mean() + below.mean() + EDGE_NOISE2
    x, y = (
        (strength * (EDGE_FLOOR + (1 - EDGE_FLOOR) * np.exp(-d / scale2))).astype(np.float32)
        for d in (right, below)
    )
    return x, y


def colour_gain(picture: Image, region: Single, known: NDArray[np.bool_], limit: float) -> Single:
    """How much more common each pixel's colour is inside a region than outside it.

    Hues speak first: ground in the shade of an obstacle keeps its hue, while by its brightness it
    would belong to the obstacle's dark side. Where hues leave it open, brightness has its say, the
    more the less they say.

    Parameters
    ----------
    picture : (H, W, 3) uint8
        RGB.
    region : (H, W) float32
        Membership in 0..1.
    known : (H, W) bool
        Pixels to learn from.
    limit : float
        Largest size of the answer.

    Returns
    -------
    gain : (H, W) float32
        Log ratio of the histograms, within -limit..limit; 0 if the region, or what is outside
        it, is tiny.
    """
    inside = region[known].astype(np.float64)
    if inside.sum() < LEAST_PIXELS or (1 - inside).sum() < LEAST_PIXELS:
        return np.zeros(region.shape, np.float32)
    hue = _log_ratio(_hue(picture), (HUE_BINS,) * 2, known, inside, limit)
    level = _log_ratio(_level(picture), (LEVEL_BINS,) * 3, known, inside, limit)
    gain = hue + LEVEL_WEIGHT * (1 - np.abs(hue) / limit) * level
    return gain.astype(np.float32)


def _log_ratio(
    index: Bins, shape: tuple[int, ...], known: NDArray[np.bool_], inside: Float, limit: float
) -> Single:
    """How much more common each pixel's bin is inside than outside, log within -limit..limit.

    The histograms have `shape`; `inside` (K,) is the membership of the known pixels.
    """
    logs = []
    for weight in (inside, 1 - inside):
        counts = np.bincount(index[known], weights=weight, minlength=int(np.prod(shape)))
        share = counts.reshape(shape) / counts.sum()
        smooth = ndimage.gaussian_filter(share, BIN_BLUR, mode="nearest")
        logs.append(np.log(smooth + RARE).ravel())
    ratio = np.clip(logs[0] - logs[1], -limit, limit).astype(np.float32)
    found: Single = ratio[index]
    return found


def _level(picture: Image) -> Bins:
    """Bin (H, W) of each pixel's three channels."""
    r, g, b = np.moveaxis(picture.astype(np.int32) * LEVEL_BINS // 256, -1, 0)
    index: Bins = (r * LEVEL_BINS + g) * LEVEL_BINS + b
    return index


def _hue(picture: Image) -> Bins:
    """Bin (H, W) of each pixel's log ratios of red and blue to green."""
    smooth = cv2.GaussianBlur(picture.astype(np.float32), (0, 0), NOISE_BLUR)
    red, green, blue = np.moveaxis(np.log(smooth + DARKEST), -1, 0)
    ratios = (np.stack([red - green, blue - green]) + HUE_LIMIT) / (2 * HUE_LIMIT)
    a, b = np.clip(ratios * HUE_BINS, 0, HUE_BINS - 1).astype(np.int32)
    index: Bins = a * HUE_BINS + b
    return index
