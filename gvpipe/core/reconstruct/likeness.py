"""How far a picture differs from the ground expected in it, in units of what ground does itself."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gvpipe.core.types import Image

Single = NDArray[np.float32]
Bool = NDArray[np.bool_]

WINDOW = 1.0
"""Standard deviation of the comparison window, pixels: texture needs a few, outlines no more."""

BLURS = (0.8, 1.5)
"""Extra blurs, pixels, under which the picture may match: the background was often seen from
farther away."""

CONTRAST = (0.6, 1.6)
"""Range of the ratio of contrasts that light and gloss can make between views."""

GLOSS = 0.25
"""Share of a squared difference towards white that counts."""

GLOSS_LEVELS, GLOSS_WIDTH, GLOSS_PRIOR = 30.0, 0.06, 0.03
"""Smooth differences of light: their size, levels, their extent as a share of the picture's width,
and the weight of there being none."""

FIELD_SIGMA = 12.0
"""Pixels, at least, of that extent's standard deviation in the reduced picture it is worked on."""

GROUND_LIKE = 4.0
"""Difference, in units of the expected, up to which a pixel teaches the noise of the ground."""

FLOORS = (1.0, 2.0)
"""Least expected squares of texture and shade, levels squared: rounding and compression."""


@dataclass(frozen=True)
class Features:
    """What is compared at each pixel, levels squared.

    Attributes
    ----------
    texture : array of float32
        Variance in the window that the background's texture, at any allowed contrast, does not
        explain, summed over the channels.
    shade : array of float32
        Squared difference of the window's mean colours, less towards white.
    contrast : array of float32
        Variance of the background in the window.
    own : array of float32
        Variance of the picture in the window.
    """

    texture: Single
    shade: Single
    contrast: Single
    own: Single

    def pick(self, where: Bool) -> "Features":
        """Return the features at some pixels, (N,) each."""
        return Features(
            self.texture[where], self.shade[where], self.contrast[where], self.own[where]
        )


@dataclass(frozen=True)
class GroundNoise:
    """Expected squares on bare ground: ``base + slope * contrast``, levels squared."""

    texture_base: float
    texture_slope: float
    shade_base: float
    shade_slope: float


def features(picture: Image, background: Single, known: Bool) -> Features:
    """Compare a picture with its background, window by window.

    Parameters
    ----------
    picture : (H, W, 3) uint8
        RGB.
    background : (H, W, 3) float32
        Ground expected there.
    known : (H, W) bool
        Where the background is known.

    Returns
    -------
    features : Features
        (H, W) each.
    """
    inside = known.astype(np.float32)
    once, mask = 1 / np.maximum(blurred(inside, WINDOW), 1e-3), cv2.merge([inside] * 3)
    inverse_share = cv2.merge([once] * 3)

    def mean(values: Single) -> Single:
        total = blurred(np.asarray(cv2.multiply(values, mask), np.float32), WINDOW)
        return np.asarray(cv2.multiply(total, inverse_share, total), np.float32)

    base_mean = mean(background)
    contrast = total_variance(mean(background**2), base_mean)
    texture = np.full(known.shape, np.inf, np.float32)
    shade, own = texture, texture
    for blur in (0.0, *BLURS):
        image = picture.astype(np.float32)
        if blur:
            image = blurred(image, blur)
        image_mean = mean(image)
        variance = total_variance(mean(image**2), image_mean)
        common = summed(mean(image * background) - image_mean * base_mean)
        gain = np.clip(common / np.maximum(contrast, 1e-3), *CONTRAST)
        left = variance - 2 * gain * common + gain**2 * contrast
        texture = np.minimum(texture, np.maximum(left, 0)).astype(np.float32)
        if not blur:
            shade, own = _shade(image_mean - base_mean), variance
    return Features(texture, shade, contrast, own)


def difference(f: Features, noise: GroundNoise) -> tuple[Single, Single]:
    """Weigh the features by what ground does itself.

    Parameters
    ----------
    f : Features
        Of any shape.
    noise : GroundNoise
        What bare ground makes.

    Returns
    -------
    difference : array of float32
        Squared difference in units of the expected, about 1.5 on bare ground. Where the
        background's texture is found again, a change of shade counts little: gloss and soft
        light do that, obstacles do not.
    recognised : array of float32
        0..1: how surely the background's texture was found again; 0 where it has none.
    """
    texture_scale = noise.texture_base + noise.texture_slope * f.contrast + FLOORS[0]
    shade_scale = noise.shade_base + noise.shade_slope * f.contrast + FLOORS[1]
    explained = np.clip((f.own - f.texture) / np.maximum(f.own, 1e-3), 0, 1)
    recognised = explained * f.contrast / (f.contrast + 4 * texture_scale)
    total = f.texture / texture_scale + 0.5 * f.shade / shade_scale * (1 - recognised) ** 2
    return np.asarray(total, np.float32), np.asarray(recognised, np.float32)


def learn_noise(samples: Sequence[Features]) -> GroundNoise:
    """Fit the expected squares to pixels most of which show bare ground.

    Starts from the pixels with small differences and alternates between fitting lines through
    the medians of flat and of strongly textured ground and choosing the pixels that agree.

    Parameters
    ----------
    samples : sequence of Features
        (N,) each; most of their pixels show bare ground.

    Returns
    -------
    noise : GroundNoise
        A usual one if there are fewer than 100 pixels.
    """
    f = Features(
        *(
            np.concatenate([getattr(s, name) for s in samples])
            for name in ("texture", "shade", "contrast", "own")
        )
    )
    if len(f.texture) < 100:
        return GroundNoise(1.0, 0.05, 4.0, 0.01)
    use = (f.texture <= np.quantile(f.texture, 0.8)) & (f.shade <= np.quantile(f.shade, 0.7))
    noise = GroundNoise(1.0, 0.0, 1.0, 0.0)
    for _ in range(4):
        if use.sum() < 100:
            break
        g = f.pick(use)
        noise = GroundNoise(*fitted_line(g.contrast, g.texture), *fitted_line(g.contrast, g.shade))
        use = difference(f, noise)[0] < GROUND_LIKE
    return noise


def without_gloss(picture: Image, background: Single, weight: Single) -> Single:
    """Bring the background to the picture's light: gloss and soft shadows move with the view.

    Parameters
    ----------
    picture : (H, W, 3) uint8
    background : (H, W, 3) float32
    weight : (H, W) float32
        How surely the background is ground; 0 where it is not known.

    Returns
    -------
    background : (H, W, 3) float32
        Plus the mean difference around each pixel of what differs little.
    """
    off = picture.astype(np.float32) - background
    likely = np.minimum(weight, 1) / (1 + summed(off**2) / GLOSS_LEVELS**2) ** 2
    sigma = GLOSS_WIDTH * picture.shape[1]
    # so smooth a field needs few pixels
    factor = max(1, int(sigma / FIELD_SIGMA))
    small = (-(-picture.shape[1] // factor), -(-picture.shape[0] // factor))
    parts = cv2.merge([likely, *cv2.split(likely[..., None] * off)])
    parts = blurred(cv2.resize(parts, small, interpolation=cv2.INTER_AREA), sigma / factor)
    field = parts[..., 1:] / (parts[..., :1] + np.float32(GLOSS_PRIOR))
    size = (picture.shape[1], picture.shape[0])
    return np.asarray(background + cv2.resize(field, size), np.float32)


def _shade(off: Single) -> Single:
    """Squared colour difference (H, W), less for what is whiter than expected: gloss adds white."""
    grey = summed(off) / 3
    total = summed(off**2)
    return np.asarray(total - (1 - GLOSS) * 3 * np.maximum(grey, 0) ** 2, np.float32)


def fitted_line(x: Single, y: Single) -> tuple[float, float]:
    """Fit base and slope, both >= 0, to the medians of the lowest and the highest third in x."""
    low, high = np.quantile(x, [0.33, 0.67])
    x0, y0 = np.median(x[x <= low]), np.median(y[x <= low])
    x1, y1 = np.median(x[x >= high]), np.median(y[x >= high])
    slope = max(0.0, float((y1 - y0) / max(x1 - x0, 1e-6)))
    return max(float(y0 - slope * x0), 0.3 * float(y0)), slope


def blurred(values: Single, sigma: float) -> Single:
    """Gaussian blur of any channels, `sigma` in pixels."""
    return np.asarray(cv2.GaussianBlur(values, (0, 0), sigma), np.float32)


def total_variance(mean_square: Single, mean: Single) -> Single:
    """Sum over the channels of the variance in the window."""
    return summed(np.maximum(mean_square - mean**2, 0))


def summed(channels: Single) -> Single:
    """Sum over three channels: numpy's own, along so short an axis, takes three times as long."""
    return np.asarray(channels[..., 0] + channels[..., 1] + channels[..., 2], np.float32)
