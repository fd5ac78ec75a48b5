"""Matching two views of a ground plane: the registry of methods and the thesis' own."""

from collections.abc import Callable

import numpy as np
from scipy.stats import binom

from gvpipe.core.geometry.homography import transfer_errors
from gvpipe.core.geometry.twoview import PairPrior, TwoView, two_views
from gvpipe.core.matching.features import Features, MatchOptions
from gvpipe.core.matching.guided import WINDOWS_PX, Guided, guided_match
from gvpipe.core.matching.invariants import extract_invariants
from gvpipe.core.matching.isometry import find_isometry
from gvpipe.core.matching.overhead_matching import match_sift
from gvpipe.core.matching.sift import extract_sift
from gvpipe.core.types import PairMatch, Rejected, View

_LOG10_TESTS = 9.0  # isometries a pair can try, and the freedom of the refinement after them


def extract(view: View, options: MatchOptions) -> Features:
    """Features of one image, to be computed once and used in every pair it is part of.

    Parameters
    ----------
    view : View
        The image.
    options : MatchOptions
        ``options.features`` selects the method.

    Returns
    -------
    features : Features
    """
    return EXTRACTORS[options.features](view, options)


def match_views(
    view_i: View,
    view_j: View,
    features_i: Features,
    features_j: Features,
    options: MatchOptions,
    rng: np.random.Generator,
) -> PairMatch | Rejected:
    """Ground homography between two views, or why there is none.

    Parameters
    ----------
    view_i, view_j : View
        The views.
    features_i, features_j : Features
        Of the same views, by :func:`extract` with the same options.
    options : MatchOptions
        Thresholds.
    rng : Generator
        All randomness.

    Returns
    -------
    match : PairMatch or Rejected
    """
    return MATCHERS[options.features](view_i, view_j, features_i, features_j, options, rng)


def match_invariants(
    view_i: View,
    view_j: View,
    features_i: Features,
    features_j: Features,
    options: MatchOptions,
    rng: np.random.Generator,
) -> PairMatch | Rejected:
    """Match by the thesis' chapter 3; parameters as in :func:`match_views`."""
    fewest = min(len(features_i.pixels), len(features_j.pixels))
    if fewest < 8:
        return Rejected(f"{fewest} corners on the ground, at least 8 are needed")
    found = find_isometry(view_i, view_j, features_i, features_j, options, rng)
    counts = {"candidates": found.candidates, "trials": found.trials}
    if not found.fits:
        return Rejected(
            f"no segment of one view looks like one of the other ({found.candidates} corner "
            f"pairs, correlation above {options.min_correlation:g} needed)",
            **counts,
        )
    expected = two_views(view_i, view_j)
    tilt, roll = options.tilt_sigma, options.roll_sigma
    prior = PairPrior(tilt, tilt, roll, options.height_sigma, options.max_tilt_error)
    gate = options.min_colour
    best: tuple[int, TwoView, Guided] | None = None
    for _, *motion in found.fits:
        start = expected.with_parameters(np.array([*motion, *expected.parameters[3:]]))
        guided = guided_match(
            start, expected, prior, features_i.pixels, features_j.pixels, found.distance, gate
        )
        if guided is not None and (best is None or len(guided.inlier_i) > best[0]):
            best = len(guided.inlier_i), start, guided
    if best is None:
        return Rejected("fewer than 4 corners agree with the best isometry", **counts)
    inliers, start, guided = best
    area = view_j.camera.width * view_j.camera.height
    square = (2 * WINDOWS_PX[-1]) ** 2
    similar = float((found.distance < gate).mean())
    chance = min(len(features_j.pixels) * square / area * similar, 0.99)
    odds = -(_LOG10_TESTS + binom.logsf(inliers - 1, guided.offered, chance) / np.log(10.0))
    if not odds > options.min_log10_odds:
        return Rejected(
            f"{inliers} of {guided.offered} corners agree, where {guided.offered * chance:.1f} "
            f"do by chance: odds 1e{odds:.1f} against chance, 1e{options.min_log10_odds:g} needed",
            inliers=inliers,
            **counts,
        )
    drift = guided.geometry.drift(expected)
    if drift > options.max_tilt_error:
        return Rejected(
            f"the plane would need a camera turned {np.degrees(drift):.0f} degrees from its "
            f"configured tilt and roll, {np.degrees(options.max_tilt_error):.0f} are allowed",
            inliers=inliers,
            **counts,
        )
    points_i, points_j = features_i.pixels[guided.inlier_i], features_j.pixels[guided.inlier_j]
    errors = transfer_errors(guided.homography, points_i, points_j)
    return PairMatch(
        homography=guided.homography,
        homography_initial=start.homography,
        overhead_j_from_i=guided.geometry.ground_j_from_ground_i,
        points_i=points_i,
        points_j=points_j,
        error_px=float(np.sqrt((errors**2).mean())),
        tilt_i=guided.geometry.mount_i.tilt,
        tilt_j=guided.geometry.mount_j.tilt,
        candidates=found.candidates,
        trials=found.trials,
    )


Extractor = Callable[[View, MatchOptions], Features]
Matcher = Callable[
    [View, View, Features, Features, MatchOptions, np.random.Generator], PairMatch | Rejected
]

EXTRACTORS: dict[str, Extractor] = {"sift": extract_sift, "invariants": extract_invariants}
"""How the features of one image are made, by the name in the configuration."""

MATCHERS: dict[str, Matcher] = {"sift": match_sift, "invariants": match_invariants}
"""How a pair is matched from them; the same keys."""
