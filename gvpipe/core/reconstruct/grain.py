"""Whether an area shows the ground's texture, however faint, or none of it."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gvpipe.core.reconstruct.likeness import WINDOW, blurred, fitted_line, summed, total_variance
from gvpipe.core.types import Image

Single = NDArray[np.float32]
Bool = NDArray[np.bool_]

MEDIAN_SQUARE = 0.455
"""Median of the square of a normal number, as a share of its mean."""

TINY = np.float32(1e-3)
"""Least divisor, of levels squared and of weights: less is rounding."""

FLOOR = np.float32(0.1)
"""Least expected square of what lacks, levels squared: rounding and compression, averaged."""

LEAST_KNOWN = 0.5
"""Share of a window whose ground must be known."""

LEAST_COMMON = 0.5
"""Share of the ground's contrast that must be found again; gloss and shade leave more."""

FEWEST_SAMPLES = 100
"""Pixels that teach the noise, at least."""


@dataclass(frozen=True)
class Grain:
    """How much of the ground's texture a wide window around each pixel shows, levels squared.

    Attributes
    ----------
    contrast : array of float32
        Variance of the background in the window.
    common : array of float32
        Covariance of picture and background: the contrast where all of the texture is there.
    own : array of float32
        Variance of the picture in the window.
    known : array of float32
        Share of the window whose ground is known.
    side : int
        Of the square window, pixels.
    """

    contrast: Single
    common: Single
    own: Single
    known: Single
    side: int

    @property
    def lacking(self) -> Single:
        """Squared difference of what is found from what should be, levels squared."""
        square = (self.contrast - self.common) ** 2 / np.maximum(self.contrast, TINY)
        return np.asarray(square, np.float32)

    @property
    def found(self) -> Single:
        """Squared difference of what is found from nothing, levels squared."""
        square = np.maximum(self.common, 0) ** 2 / np.maximum(self.contrast, TINY)
        return np.asarray(square, np.float32)


@dataclass(frozen=True)
class GrainNoise:
    """What bare ground does itself, levels squared.

    Attributes
    ----------
    base, slope : float
        Expected square of what lacks: ``base + slope * contrast``.
    other : float
        Usual variance of a picture that is not the background's.
    """

    base: float
    slope: float
    other: float


def grain(picture: Image, background: Single, weight: Single, side: int) -> Grain:
    """Look for the texture of the ground in wide windows, where noise averages out.

    A plain obstacle of the ground's colour differs from it nowhere by much, but over an area the
    ground's texture is there or it is not.

    Parameters
    ----------
    picture : (H, W, 3) uint8
        RGB.
    background : (H, W, 3) float32
        Ground expected there, see :func:`gvpipe.core.reconstruct.likeness.without_gloss`.
    weight : (H, W) float32
        How surely the background is ground, 0..1; 0 where it is not known.
    side : int
        Of the windows, odd, pixels.

    Returns
    -------
    grain : Grain
        (H, W) each.
    """
    known = cv2.blur(weight, (side, side)).astype(np.float32, copy=False)
    total = np.maximum(known, TINY)[..., None]

    def mean(values: Single) -> Single:
        weighed = np.asarray(values * weight[..., None], np.float32)
        return np.asarray(cv2.blur(weighed, (side, side)) / total, np.float32)

    own, ground = (blurred(p.astype(np.float32), WINDOW) for p in (picture, background))
    own_mean, ground_mean = mean(own), mean(ground)
    return Grain(
        contrast=total_variance(mean(ground**2), ground_mean),
        common=summed(mean(own * ground) - own_mean * ground_mean),
        own=total_variance(mean(own**2), own_mean),
        known=known,
        side=side,
    )


def missing(g: Grain, noise: GrainNoise, odds: float) -> Single:
    """Weigh what lacks by what lacks on ground itself.

    Parameters
    ----------
    g : Grain
        Of a whole picture.
    noise : GrainNoise
        What lacks on bare ground.
    odds : float
        Difference in units of the expected at which obstacle and ground are equally likely.

    Returns
    -------
    missing : (H, W) float32
        Squared difference in units of the expected. Ground with too little texture to be missed
        says nothing: 0, unless places that lack theirs lie around it, less than a window apart.
    """
    # light or texture of its own, as coarse as the window, may drown the ground's
    drowned = np.maximum(g.own - noise.other, 0)
    expected = np.maximum(noise.base + noise.slope * g.contrast, FLOOR) + drowned
    able = (g.known > LEAST_KNOWN) & (g.contrast > odds * expected)
    lacks = able & (g.common < LEAST_COMMON * g.contrast)
    square = np.where(lacks, g.lacking / expected, np.float32(0)).astype(np.float32)
    # a window speaks for all its pixels; closing lends that to gaps, but takes no ground beyond
    closed = cv2.morphologyEx(square, cv2.MORPH_CLOSE, np.ones((g.side, g.side), np.uint8))
    return np.asarray(closed, np.float32)


def learn_grain_noise(samples: Sequence[tuple[Grain, Bool]]) -> GrainNoise:
    """Learn from pixels (H, W) most of which show bare ground."""
    contrast = np.concatenate([g.contrast[where] for g, where in samples])
    square = np.concatenate([g.lacking[where] for g, where in samples])
    if len(square) < FEWEST_SAMPLES:
        return GrainNoise(0.0, 1.0, 0.0)
    other = np.concatenate([(g.own - g.found)[where] for g, where in samples])
    base, slope = fitted_line(contrast, square)
    return GrainNoise(base / MEDIAN_SQUARE, slope / MEDIAN_SQUARE, float(np.median(other)))
