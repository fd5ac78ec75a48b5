"""How likely each pixel of each view shows an obstacle rather than the ground."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from gvpipe.core.reconstruct.background import (
    WELL_SEEN,
    GroundModel,
    GroundWitnesses,
    Mask,
    rendered_background,
)
from gvpipe.core.reconstruct.evidence_options import EvidenceOptions, Silhouette
from gvpipe.core.reconstruct.foreground import GAIN_LIMIT, compared, cut_out
from gvpipe.core.reconstruct.ghosts import without_ghosts
from gvpipe.core.reconstruct.grain import learn_grain_noise
from gvpipe.core.reconstruct.hiding import bodies_seen, hidden_ground, tolerant_solids
from gvpipe.core.reconstruct.likeness import difference, learn_noise
from gvpipe.core.reconstruct.photometry import levelled
from gvpipe.core.reconstruct.raised import raised_surfaces
from gvpipe.core.reconstruct.views import reduced
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
    level = [replace(v, pixels=p) for v, p in zip(views, levelled(views), strict=True)]
    small = GroundWitnesses([reduced(v) for v in level])
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
        full = GroundWitnesses(level)
        if hidden:
            full.hide(hidden, solid)
        shapes = _round(full, scale, options, raised, not hidden, pool, on_step)
    return without_ghosts(views, shapes, options, threads)


def colour_silhouette(view: PosedView, ground: GroundModel, colour_scale: float) -> Silhouette:
    """Compare a view with the ground model colour by colour (thesis eqs. 5.6.1 and 5.6.2).

    Parameters
    ----------
    view : PosedView
    ground : GroundModel
        The ground without obstacles.
    colour_scale : float
        Difference, levels, at which the probability reaches 63 %.

    Returns
    -------
    silhouette : (H, W) float32
        Probability that a pixel shows an obstacle, NaN where the ground is not known.
    """
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
        known = seen.open_weight > WELL_SEEN
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
    bare = [_every_other(seen.open_weight > WELL_SEEN) for seen in asked.values()]
    pairs = [compared(witnesses.views[k], seen) for k, seen in asked.items()]
    samples = [f.pick(where) for (f, _), where in zip(pairs, bare, strict=True)]
    noise = learn_noise(samples)
    grain_noise = learn_grain_noise([(g, w) for (_, g), w in zip(pairs, bare, strict=True)])
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
        asking = replace(options, odds=even)
        return cut_out(view, seen, noise, grain_noise, asking, extra, first)

    return [_told(shape, on_step) for shape in pool.map(one, range(len(witnesses.views)))]


def _told(shape: Silhouette, on_step: Callable[[], object]) -> Silhouette:
    """Pass a silhouette on, and say that it is done."""
    on_step()
    return shape


def _every_other(where: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Keep a quarter of the pixels: every other one of every other row."""
    thin = np.zeros_like(where)
    thin[1::2, 1::2] = where[1::2, 1::2]
    return thin
