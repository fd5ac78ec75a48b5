"""The default matcher: SIFT on overhead views, then patches of ground aligned in the pictures."""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.geometry.homography import transfer_errors
from gvpipe.core.geometry.twoview import PairPrior, TwoView, two_views
from gvpipe.core.matching.features import Features, MatchOptions
from gvpipe.core.matching.hypotheses import INLIER_PX, Matches, find_hypotheses
from gvpipe.core.matching.patches import (
    COARSENESS,
    Aligned,
    Pyramid,
    align,
    correlations,
    grey_pyramid,
    texture,
)
from gvpipe.core.matching.rivals import distinctness, lower_plane, repetitions, shifted
from gvpipe.core.matching.sift import candidate_matches
from gvpipe.core.matching.verdict import Evidence, objection, weigh
from gvpipe.core.types import Float, Mount, PairMatch, Rejected, View

_MAX_MATCHES = 500  # the most distinct ones: a right geometry never needs more
_MIN_MATCHES = 4
_TRIED = 3  # hypotheses whose patches are compared, for each set of assumed tilts
_WELL_KNOWN = 40  # keypoint matches that place patches to a pixel or two
_CERTAIN = 15.0  # decimal exponent of the odds at which looking further is a waste
_LEAST_GROUND = 0.3  # patches of a lower plane, of those on the found one: less may be reflections
_AMBIGUOUS = 0.6  # share of agreeing patches of a shifted geometry, of the found one's
_COMPARED = 2.0  # sample distance: coarse enough that views which resolve the ground unlike agree
_DISTINCT = 0.3
"""Least distinctness of a geometry that shifted ones rival. Chosen on 450 rendered pairs of five
repetitive floors: wrong ones reached 0.20 there, right ones up to 0.9 where the ground has marks
of its own, and are refused where these are faint."""

_WIDER = np.radians(6.0)  # next tilts to try where the configured ones lead nowhere
_UNKNOWN = np.radians([-20.0, -10.0, 10.0, 20.0])  # the same for a tilt that is not known
_UNKNOWN_SIGMA = np.radians(20.0)


@dataclass(frozen=True)
class Pair:
    """All that stays the same while geometries of two views are compared.

    Attributes
    ----------
    expected : TwoView
        As configured.
    prior : PairPrior
        Error of the configuration.
    texture_i : (H, W) float32
        From :func:`gvpipe.core.matching.patches.texture`.
    pyramids : pair of tuple of (h, w) uint8
        From :func:`gvpipe.core.matching.patches.grey_pyramid`.
    matches : Matches
        Putative ones.
    options : MatchOptions
        Thresholds.
    """

    expected: TwoView
    prior: PairPrior
    texture_i: NDArray[np.float32]
    pyramids: tuple[Pyramid, Pyramid]
    matches: Matches
    options: MatchOptions


@dataclass(frozen=True)
class Candidate:
    """A geometry with its evidence and what is to be said against it.

    Attributes
    ----------
    start : TwoView
        Before refinement.
    aligned : Aligned
        Its patches.
    covariance : (9, 9) float64
        Of its homography.
    evidence : Evidence
        For it.
    objection : str or None
        Against it.
    """

    start: TwoView
    aligned: Aligned
    covariance: Float
    evidence: Evidence
    objection: str | None

    @property
    def rank(self) -> tuple[bool, float]:
        """The larger, the better."""
        return self.objection is None, self.evidence.log10_odds


def _matches(features_i: Features, features_j: Features, max_ratio: float) -> Matches:
    index_i, index_j, _ = candidate_matches(features_i, features_j, max_ratio)
    index_i, index_j = index_i[:_MAX_MATCHES], index_j[:_MAX_MATCHES]
    return Matches(
        features_i.pixels[index_i],
        features_j.pixels[index_j],
        features_j.angle[index_j] - features_i.angle[index_i],
        np.log(features_j.size[index_j] / features_i.size[index_i]),
    )


def prepare(view_i: View, view_j: View, matches: Matches, options: MatchOptions) -> Pair:
    """Collect what is needed to compare geometries of two views.

    Parameters
    ----------
    view_i, view_j : View
        The views.
    matches : Matches
        Putative ones; they are asked whether anything lies below a found plane.
    options : MatchOptions
        Thresholds.

    Returns
    -------
    pair : Pair
    """
    tilt_i, tilt_j = (
        options.tilt_sigma if v.mount.tilt_known else _UNKNOWN_SIGMA for v in (view_i, view_j)
    )
    return Pair(
        expected=two_views(view_i, view_j),
        prior=PairPrior(
            tilt_i, tilt_j, options.roll_sigma, options.height_sigma, options.max_tilt_error
        ),
        texture_i=texture(view_i.pixels),
        pyramids=(grey_pyramid(view_i.pixels), grey_pyramid(view_j.pixels)),
        matches=matches,
        options=options,
    )


def _tilt_errors(mount: Mount) -> tuple[float, ...]:
    return (0.0, *(float(t) for t in ((-_WIDER, _WIDER) if mount.tilt_known else _UNKNOWN)))


def examine(
    pair: Pair, start: TwoView, geometry: TwoView, coarseness: tuple[float, ...] = COARSENESS
) -> Candidate | None:
    """Align the ground patches of a geometry and weigh what they say.

    Parameters
    ----------
    pair : Pair
        The views.
    start, geometry : TwoView
        Before refinement, and after it.
    coarseness : tuple of float
        As of :func:`gvpipe.core.matching.patches.align`.

    Returns
    -------
    candidate : Candidate or None
        None if hardly any patch could be aligned.
    """
    aligned = align(
        geometry,
        pair.expected,
        pair.prior,
        pair.texture_i,
        *pair.pyramids,
        coarseness=coarseness,
    )
    if aligned is None:
        return None
    covariance = aligned.fit.homography_covariance
    evidence = weigh(aligned, covariance, pair.expected, pair.prior)
    return Candidate(start, aligned, covariance, evidence, objection(evidence, pair.options))


def _search(pair: Pair, rng: np.random.Generator) -> tuple[Candidate | None, int, int]:
    """Best candidate, hypotheses drawn, most keypoint matches on a plane."""
    mount_i, mount_j = pair.expected.mount_i, pair.expected.mount_j
    grid = list(product(_tilt_errors(mount_i), _tilt_errors(mount_j)))
    best: Candidate | None = None
    trials = most = 0
    for assumed in (grid[:1], grid[1:]):
        draws = pair.options.hypotheses
        found = find_hypotheses(
            pair.expected,
            pair.prior,
            pair.matches,
            tuple(assumed),
            draws,
            rng,
        )
        trials += draws * len(assumed)
        most = max([most, *(int(h.inliers.sum()) for h in found)])
        for hypothesis in found[:_TRIED]:
            well_known = hypothesis.inliers.sum() > _WELL_KNOWN
            rounds = COARSENESS[1:] if well_known else COARSENESS
            candidate = examine(pair, hypothesis.start, hypothesis.geometry, rounds)
            if candidate and (best is None or candidate.rank > best.rank):
                best = candidate
            if best and best.rank > (True, _CERTAIN):
                return best, trials, most
    return best, trials, most


def _lowest(pair: Pair, found: Candidate) -> Candidate:
    """Return the plane below the found one, if the pictures show one."""
    below = lower_plane(found.aligned.fit.geometry, pair.matches, INLIER_PX)
    lower = examine(pair, found.start, below) if below is not None else None
    if lower is None or lower.objection is not None:
        return found
    ground, top = lower.aligned.fit.geometry, found.aligned.fit.geometry
    enough = lower.evidence.inliers > _LEAST_GROUND * found.evidence.inliers
    return lower if enough and np.hypot(ground.x, ground.y) < np.hypot(top.x, top.y) else found


def _rivals(pair: Pair, found: Candidate, view_i: View) -> list[tuple[float, Candidate]]:
    """Shifts of a repetitive ground in metres, and what the pictures say for each."""
    geometry = found.aligned.fit.geometry
    rivals = []
    for shift in repetitions(view_i, geometry):
        for sign in (1.0, -1.0):
            other = shifted(geometry, sign * shift)
            rival = examine(pair, other, other, coarseness=(1.0,))
            if rival is None:
                continue
            moved = rival.aligned.fit.geometry
            length = float(np.hypot(*shift))
            if np.hypot(moved.x - geometry.x, moved.y - geometry.y) > 0.5 * length:
                rivals.append((length, rival))
    return rivals


def _ambiguity(pair: Pair, found: Candidate, view_i: View) -> str | None:
    """Say which shift of a repetitive ground agrees as well, or None."""
    rivals = _rivals(pair, found, view_i)
    least = _AMBIGUOUS * found.evidence.share
    equal = [(length, rival) for length, rival in rivals if rival.evidence.share > least]
    if not equal:
        return None
    points = found.aligned.points_i
    own, *others = (
        correlations(candidate.aligned.fit.geometry, *pair.pyramids, points, _COMPARED)
        for candidate in (found, *(rival for _, rival in rivals))
    )
    if distinctness(own, np.array(others)) > _DISTINCT:
        return None
    length, rival = equal[0]
    return (
        f"the ground repeats every {length:.2f} m: "
        f"{found.evidence.inliers} of {found.evidence.tested} patches agree, shifted "
        f"by that {rival.evidence.inliers} of {rival.evidence.tested}"
    )


def match_sift(
    view_i: View,
    view_j: View,
    features_i: Features,
    features_j: Features,
    options: MatchOptions,
    rng: np.random.Generator,
) -> PairMatch | Rejected:
    """Match on overhead views; parameters as in `gvpipe.core.matching.matchers.match_views`."""
    matches = _matches(features_i, features_j, options.max_ratio)
    candidates = len(matches.pixels_i)
    if candidates < _MIN_MATCHES:
        return Rejected(
            f"{candidates} of {len(features_i.pixels)} keypoints have a distinct counterpart, at "
            f"least {_MIN_MATCHES} are needed",
            candidates=candidates,
        )
    pair = prepare(view_i, view_j, matches, options)
    best, trials, most = _search(pair, rng)
    if best is None:
        return Rejected(
            f"the best ground plane has {most} of {candidates} keypoint matches and no ground "
            "patches that look alike",
            candidates=candidates,
            trials=trials,
        )
    return conclude(pair, best, view_i, candidates, trials)


def conclude(
    pair: Pair, best: Candidate, view_i: View, candidates: int, trials: int
) -> PairMatch | Rejected:
    """Accept the best candidate, or say what is to be said against it.

    Parameters
    ----------
    pair : Pair
        The views.
    best : Candidate
        What was found.
    view_i : View
        The first view, whose ground may repeat.
    candidates, trials : int
        How it was found, for the record.

    Returns
    -------
    match : PairMatch or Rejected
    """
    reason, equals = best.objection, 1.0
    if reason is None:
        best = _lowest(pair, best)
        reason = _ambiguity(pair, best, view_i)
        equals = 2.0  # the rival is as likely
    if reason is not None:
        probability = best.evidence.probability / equals
        return Rejected(reason, candidates, trials, best.evidence.inliers, probability)
    return _accepted(best, candidates, trials)


def _accepted(best: Candidate, candidates: int, trials: int) -> PairMatch:
    geometry, agrees = best.aligned.fit.geometry, best.aligned.agrees
    points_i, points_j = best.aligned.points_i[agrees], best.aligned.points_j[agrees]
    errors = transfer_errors(geometry.homography, points_i, points_j)
    return PairMatch(
        homography=geometry.homography,
        homography_initial=best.start.homography,
        overhead_j_from_i=geometry.ground_j_from_ground_i,
        points_i=points_i,
        points_j=points_j,
        error_px=float(np.sqrt((errors**2).mean())),
        tilt_i=geometry.mount_i.tilt,
        tilt_j=geometry.mount_j.tilt,
        candidates=candidates,
        trials=trials,
        probability=best.evidence.probability,
        covariance=best.covariance,
    )
