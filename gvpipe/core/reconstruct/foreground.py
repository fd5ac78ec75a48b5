"""Cut one view into obstacle and ground, by how it differs from the ground the others see."""

import cv2
import numpy as np
from numpy.typing import NDArray

from gvpipe.core.reconstruct.background import WELL_SEEN, GroundBehind
from gvpipe.core.reconstruct.evidence_options import EvidenceOptions, Silhouette
from gvpipe.core.reconstruct.grain import Grain, GrainNoise, grain, missing
from gvpipe.core.reconstruct.likeness import (
    Features,
    GroundNoise,
    difference,
    features,
    without_gloss,
)
from gvpipe.core.reconstruct.segmentation import colour_gain, segment, without_specks
from gvpipe.core.reconstruct.views import below_horizon
from gvpipe.core.types import PosedView

GAIN_LIMIT = 1.5
"""Largest log odds of one pixel: texture that happens to match must not outvote its area."""

PLAIN_SHARE = 0.5
"""Share of the log odds for ground that equal colour has without texture found again: neighbours
of one colour are no independent witnesses, and obstacles may have it too."""

HALF_SUPPORT = 0.7
"""Weight of agreeing views at which the ground behind a pixel is half certain."""

FIRST_LEARNING = 2
"""Times the colours of the first silhouette are learnt and applied: an obstacle's lower part,
taken for ground at first, joins the upper one by its colour."""

FIRST_GROUND_LIMIT = 0.4
"""Largest log odds for ground while those colours are applied: a difference from the ground
seldom lies, but what looks like ground may be an obstacle that all views see in its place."""

AGREEING_SHARE = 0.4
"""Share of the open views that must agree for the ground behind a pixel to be certain."""

HIDDEN_SHARE = 0.3
"""Share of the views' weight, below which too little is open: obstacles hide the ground there."""

LEAST_OPEN = 0.5
"""Weight of views from which nothing known hides the ground, from which on it counts as seen."""

LEAST_GAIN = 0.5
"""Mean measured log odds, over a silhouette's pixels with ground seen behind, of an obstacle."""

FIRST_SHARE = 0.2
"""Share of a first silhouette, where ground is seen behind, that must differ that much."""

SPECK_SHARE = 0.02
"""Side of the smallest part or hole of a silhouette, as a share of the picture's width."""

SMEAR = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
"""Pixels by which the comparison window smears an obstacle's difference over its outline."""


def compared(view: PosedView, seen: GroundBehind) -> tuple[Features, Grain]:
    """Compare a view with the ground behind it in the view's own light, (H, W) each.

    The windows of the grain are as large as the smallest part of a silhouette.
    """
    ground = without_gloss(view.pixels, seen.colour, seen.support)
    side = round(SPECK_SHARE * view.camera.width) // 2 * 2 + 1
    return (
        features(view.pixels, ground, seen.support > 0),
        grain(view.pixels, ground, _certain(seen), side),
    )


def _agreeing(seen: GroundBehind) -> NDArray[np.float32]:
    """How well the open views agree on the ground, 0..1."""
    share = seen.support / np.maximum(seen.open_weight, np.float32(1e-3)) / AGREEING_SHARE
    return np.clip(share, 0, 1).astype(np.float32)


def _certain(seen: GroundBehind) -> NDArray[np.float32]:
    """How surely the ground is known, 0..1."""
    certain = seen.support / (seen.support + HALF_SUPPORT) * _agreeing(seen)
    return certain.astype(np.float32)


def cut_out(
    view: PosedView,
    seen: GroundBehind,
    noise: GroundNoise,
    grain_noise: GrainNoise,
    options: EvidenceOptions,
    extra: NDArray[np.float32],
    first: bool,
) -> Silhouette:
    """Cut a view into obstacle and ground.

    Parameters
    ----------
    view : PosedView
        With the picture to cut.
    seen : GroundBehind
        The ground behind its pixels.
    noise, grain_noise : GroundNoise, GrainNoise
        What bare ground differs by, and what it lacks.
    options : EvidenceOptions
        Scales and thresholds.
    extra : (H, W) or (1,) float32
        Log odds from elsewhere, positive for an obstacle.
    first : bool
        Whether nothing is known yet of what stands where.

    Returns
    -------
    silhouette : (H, W) float32
        Probability that a pixel shows an obstacle, NaN where unknown.
    """
    known = seen.support > 0
    measured = _measured_gain(view, seen, noise, grain_noise, options, first)
    hidden = (seen.total_weight > WELL_SEEN) & (seen.open_weight < HIDDEN_SHARE * seen.total_weight)
    gain = measured + options.hidden_gain * hidden.astype(np.float32) + extra
    region = segment(gain, view.pixels, options.outline)
    if first:
        weights = [options.first_colour_gain] * FIRST_LEARNING
        unsure = np.ones_like(gain)
        gain = np.maximum(gain, -FIRST_GROUND_LIMIT)
    else:  # by now colours decide only where the ground behind is not known
        weights, unsure = [options.colour_gain], 1 - np.clip(seen.support, 0, 1)
    for weight in weights:
        learnt = colour_gain(view.pixels, region, known, GAIN_LIMIT)
        region = segment(gain + weight * unsure * learnt, view.pixels, options.outline)
    region = without_specks(region, round((SPECK_SHARE * view.camera.width) ** 2))
    unknown = ~(known & below_horizon(view)) & (region <= 0.5)
    if first:  # an obstacle's foot, which all views see in its place, does not differ yet
        unknown |= _guessed(region, (measured > LEAST_GAIN).astype(np.float32), seen, FIRST_SHARE)
    else:
        unknown |= _guessed(region, measured, seen, LEAST_GAIN)
    return np.where(unknown, np.nan, region).astype(np.float32)


def _guessed(
    region: Silhouette,
    measured: NDArray[np.float32],
    seen: GroundBehind,
    least: float,
) -> NDArray[np.bool_]:
    """Parts of a region that hardly differ from ground that other views do see there.

    They were filled in by colours, or because earlier rounds thought the ground hidden: guesses
    that would prove each other. Their mean of `measured` there is `least` or less.
    """
    bare = seen.open_weight > LEAST_OPEN
    count, labels = cv2.connectedComponents((region > 0.5).astype(np.uint8), connectivity=4)
    pixels = np.bincount(labels[bare], minlength=count)
    total = np.bincount(labels[bare], weights=measured[bare], minlength=count)
    guessed = total <= least * pixels
    guessed[0] = False
    found: NDArray[np.bool_] = guessed[labels]
    return found


def _measured_gain(
    view: PosedView,
    seen: GroundBehind,
    noise: GroundNoise,
    grain_noise: GrainNoise,
    options: EvidenceOptions,
    first: bool,
) -> NDArray[np.float32]:
    """Log odds from the difference between the picture and the ground seen by others."""
    known = seen.support > 0
    pixelwise, areal = compared(view, seen)
    off, recognised = difference(pixelwise, noise)
    eroded = cv2.erode(np.where(known, off, options.odds).astype(np.float32), SMEAR)
    odds = np.clip(np.log((eroded + 0.3) / options.odds), -GAIN_LIMIT, GAIN_LIMIT)
    odds = np.where(odds < 0, odds * (PLAIN_SHARE + (1 - PLAIN_SHARE) * recognised), odds)
    # equal colour says little where the ground's texture is not there
    lacks = missing(areal, grain_noise, options.odds)
    gone = np.clip(np.log((lacks + 0.3) / options.odds) / GAIN_LIMIT, 0, 1)
    odds = np.where(odds < 0, odds + gone * (PLAIN_SHARE * GAIN_LIMIT - odds), odds)
    agreeing, certain = _agreeing(seen), _certain(seen)
    # views thought not to see the ground that still agree on its texture do see it
    certain = np.where(odds < 0, np.maximum(certain, recognised * agreeing), certain)
    if not first:  # where most views see a body, gloss on it may pass for ground, texture will not
        certain = np.where(seen.solid & (odds < 0), recognised * agreeing, certain)
    return np.where(known, odds * certain, 0).astype(np.float32)
