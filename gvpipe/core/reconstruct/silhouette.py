"""How likely each pixel of each view shows an obstacle rather than the ground."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from gvpipe.core.reconstruct.background import (
    GroundBehind,
    GroundModel,
    GroundWitnesses,
    Mask,
    rendered_background,
)
from gvpipe.core.reconstruct.evidence_options import EvidenceOptions, Silhouette
from gvpipe.core.reconstruct.ghosts import without_ghosts
from gvpipe.core.reconstruct.hiding import bodies_seen, hidden_ground, tolerant_solids
from gvpipe.core.reconstruct.likeness import (
    Features,
    GroundNoise,
    difference,
    features,
    learn_noise,
    without_gloss,
)
from gvpipe.core.reconstruct.photometry import levelled
from gvpipe.core.reconstruct.raised import raised_surfaces
from gvpipe.core.reconstruct.segmentation import colour_gain, segment, without_specks
from gvpipe.core.reconstruct.views import below_horizon, reduced
from gvpipe.core.types import PosedView

FIRST_SCALE = 20.0
"""Levels within which colours of the same ground agree, before it is measured."""

SCALE_RANGE = (12.0, 60.0)
"""Levels: the measured scale stays in this range, between JPEG noise and any other colour."""

CALIBRATION_VIEWS = 5
"""Views that teach the noise of the ground; it depends on the ground more than on the view."""

TAIL_SHARE, TAIL_FACTOR = 0.6, 2.5
"""Quantile of the differences that is ground even where obstacles fill a third of the pictures,
and its multiple at which obstacle and ground are equally likely."""

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


def count_steps(views: Sequence[PosedView], options: EvidenceOptions) -> int:
    """How often :func:`silhouettes` calls its `on_step`: once a view and round."""
    return len(views) * (1 if _by_mosaic(views, options) else len(options.tolerances) + 1)


def _by_mosaic(views: Sequence[PosedView], options: EvidenceOptions) -> bool:
    """Whether views are compared with the mosaic: by option, or because they are too few."""
    return options.background == "mosaic" or len(views) < options.min_views


def silhouettes(
    views: Sequence[PosedView],
    ground: GroundModel,
    options: EvidenceOptions,
    threads: int = 2,
    on_step: Callable[[], object] = lambda: None,
) -> list[Silhouette]:
    """Soft obstacle silhouettes of all views against the ground.

    With ``options.background == "views"`` every view is compared with the ground as the other
    views show it. What obstacles hide is found in rounds: silhouettes give a tolerant hull, the
    hull says which views cannot see a ground point, and those lose their say.

    Parameters
    ----------
    views : sequence of PosedView
        Pictures with poses.
    ground : GroundModel
        The ground without obstacles; used with ``options.background == "mosaic"``, and where
        there are too few views to tell each other.
    options : EvidenceOptions
        Scales and thresholds.
    threads : int
        Views worked on side by side; does not change the result.
    on_step : callable
        Called as the rounds go on, :func:`count_steps` times.

    Returns
    -------
    silhouettes : list of (H, W) float32
        Probability that a pixel shows an obstacle, NaN where unknown (above the horizon, or the
        ground there was never seen).
    """
    if _by_mosaic(views, options):
        return [_told(colour_silhouette(v, ground, options.colour_scale), on_step) for v in views]
    even = [replace(v, pixels=p) for v, p in zip(views, levelled(views), strict=True)]
    small = GroundWitnesses([reduced(v) for v in even])
    scale = _colour_scale(small)
    with ThreadPoolExecutor(threads) as pool:
        hidden: list[Mask] = []
        solid: list[Mask] = []
        raised: list[NDArray[np.float32]] = []
        for index, tolerance in enumerate(options.tolerances):
            shapes = _round(small, scale, options, raised, index == 0, pool, on_step)
            solids = tolerant_solids(small.views, shapes, options, tolerance, threads)
            hidden = hidden_ground(small.views, shapes, solids, pool)
            solid = bodies_seen(small.views, solids, pool)
            small.hide(hidden, solid)
            raised = raised_surfaces(small.views, solids, threads)
        full = GroundWitnesses(even)
        if hidden:
            full.hide(hidden, solid)
        shapes = _round(full, scale, options, raised, not hidden, pool, on_step)
    return without_ghosts(views, shapes, options, threads)


def colour_silhouette(view: PosedView, ground: GroundModel, colour_scale: float) -> Silhouette:
    """Compare a view with the ground model colour by colour (thesis eqs. 5.6.1 and 5.6.2)."""
    background = rendered_background(view, ground)
    squared = ((view.pixels - background.colour) ** 2).sum(axis=-1)
    probability = -np.expm1(-squared / colour_scale**2)
    return np.where(background.known, probability, np.nan).astype(np.float32)


def _spread(count: int, wanted: int) -> list[int]:
    """Choose some of the views, evenly spread over all."""
    return sorted({int(k) for k in np.linspace(0, count - 1, wanted)})


def _colour_scale(witnesses: GroundWitnesses) -> float:
    """Twice the median distance between a picture and its background, levels."""
    distances = []
    for k in _spread(len(witnesses.views), CALIBRATION_VIEWS):
        seen = witnesses.behind(k, FIRST_SCALE)
        known = seen.open_weight > 1.5
        off = witnesses.views[k].pixels[known] - seen.colour[known]
        if len(off):
            distances.append(float(np.median(np.sqrt((off**2).sum(axis=-1)))))
    return float(np.clip(2 * np.median(distances or [FIRST_SCALE]), *SCALE_RANGE))


def _round(
    witnesses: GroundWitnesses,
    scale: float,
    options: EvidenceOptions,
    raised: Sequence[NDArray[np.float32]],
    first: bool,
    pool: ThreadPoolExecutor,
    on_step: Callable[[], object],
) -> list[Silhouette]:
    """Silhouettes of all views, given what is known to be hidden and to stand out."""
    some = _spread(len(witnesses.views), CALIBRATION_VIEWS)
    asked = dict(zip(some, pool.map(lambda k: witnesses.behind(k, scale), some), strict=True))
    samples = [
        _compared(witnesses.views[k], seen).pick(_every_other(seen.open_weight > 1.5))
        for k, seen in asked.items()
    ]
    noise = learn_noise(samples)
    usual = np.concatenate([difference(f, noise)[0] for f in samples])
    even = options.odds
    if len(usual):  # gloss and uneven light make long tails: ask for more there
        tail = TAIL_FACTOR * float(np.quantile(usual, TAIL_SHARE))
        even = float(np.clip(tail, options.odds, 2 * options.odds))

    def one(index: int) -> Silhouette:
        view, seen = witnesses.views[index], asked.pop(index, None)
        seen = seen or witnesses.behind(index, scale)
        size = (view.camera.width, view.camera.height)
        extra = GAIN_LIMIT * cv2.resize(raised[index], size) if raised else np.zeros(1, np.float32)
        return _silhouette(view, seen, noise, replace(options, odds=even), extra, first)

    return [_told(shape, on_step) for shape in pool.map(one, range(len(witnesses.views)))]


def _told(shape: Silhouette, on_step: Callable[[], object]) -> Silhouette:
    """Pass a silhouette on, and say that it is done."""
    on_step()
    return shape


def _compared(view: PosedView, seen: GroundBehind) -> Features:
    """Compare a view with the ground in the view's own light."""
    ground = without_gloss(view.pixels, seen.colour, seen.support)
    return features(view.pixels, ground, seen.support > 0)


def _every_other(where: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Keep a quarter of the pixels: every other one of every other row."""
    thin = np.zeros_like(where)
    thin[1::2, 1::2] = where[1::2, 1::2]
    return thin


def _silhouette(
    view: PosedView,
    seen: GroundBehind,
    noise: GroundNoise,
    options: EvidenceOptions,
    extra: NDArray[np.float32],
    first: bool,
) -> Silhouette:
    """Cut one view into obstacle and ground."""
    known = seen.support > 0
    measured = _measured_gain(view, seen, noise, options, first)
    hidden = (seen.total_weight > 1.5) & (seen.open_weight < 0.3 * seen.total_weight)
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
    view: PosedView, seen: GroundBehind, noise: GroundNoise, options: EvidenceOptions, first: bool
) -> NDArray[np.float32]:
    """Log odds from the difference between the picture and the ground seen by others."""
    known = seen.support > 0
    off, recognised = difference(_compared(view, seen), noise)
    eroded = cv2.erode(np.where(known, off, options.odds).astype(np.float32), SMEAR)
    odds = np.clip(np.log((eroded + 0.3) / options.odds), -GAIN_LIMIT, GAIN_LIMIT)
    odds = np.where(odds < 0, odds * (PLAIN_SHARE + (1 - PLAIN_SHARE) * recognised), odds)
    agreeing = seen.support / np.maximum(seen.open_weight, 1e-3) / AGREEING_SHARE
    agreeing = np.clip(agreeing, 0, 1)
    certain = seen.support / (seen.support + HALF_SUPPORT) * agreeing
    # views thought not to see the ground that still agree on its texture do see it
    certain = np.where(odds < 0, np.maximum(certain, recognised * agreeing), certain)
    if not first:  # where most views see a body, gloss on it may pass for ground, texture will not
        certain = np.where(seen.solid & (odds < 0), recognised * agreeing, certain)
    return np.where(known, odds * certain, 0).astype(np.float32)
