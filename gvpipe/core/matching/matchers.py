"""Matching two views of a ground plane: the registry of methods and the thesis' own."""

from collections.abc import Callable

import numpy as np

from gvpipe.core.matching.candidate import Candidate, examine, prepare
from gvpipe.core.matching.features import Features, MatchOptions
from gvpipe.core.matching.guided import guided_match
from gvpipe.core.matching.hypotheses import Matches
from gvpipe.core.matching.invariants import extract_invariants
from gvpipe.core.matching.isometry import find_isometry
from gvpipe.core.matching.overhead_matching import conclude, match_sift
from gvpipe.core.matching.sift import extract_sift
from gvpipe.core.types import PairMatch, Rejected, View


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
    # most corners that look alike are not the same: they say nothing of planes below
    nothing = Matches(np.empty((0, 2)), np.empty((0, 2)), np.empty(0), np.empty(0))
    pair = prepare(view_i, view_j, nothing, options)
    best: Candidate | None = None
    for _, *motion in found.fits:
        start = pair.expected.with_parameters(np.array([*motion, *pair.expected.parameters[3:]]))
        guided = guided_match(
            start,
            pair.expected,
            pair.prior,
            features_i.pixels,
            features_j.pixels,
            found.distance,
            options.min_colour,
        )
        candidate = examine(pair, start, guided) if guided is not None else None
        if candidate is not None and (best is None or candidate.rank > best.rank):
            best = candidate
    if best is None:
        return Rejected(
            f"no ground patches look alike under the {len(found.fits)} best isometries", **counts
        )
    return conclude(pair, best, view_i, **counts)


Extractor = Callable[[View, MatchOptions], Features]
Matcher = Callable[
    [View, View, Features, Features, MatchOptions, np.random.Generator], PairMatch | Rejected
]

EXTRACTORS: dict[str, Extractor] = {"sift": extract_sift, "invariants": extract_invariants}
"""How the features of one image are made, by the name in the configuration."""

MATCHERS: dict[str, Matcher] = {"sift": match_sift, "invariants": match_invariants}
"""How a pair is matched from them; the same keys."""
