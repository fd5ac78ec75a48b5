"""The default matcher: SIFT on overhead views, then patches of ground aligned in the pictures."""

from dataclasses import dataclass
from itertools import product

import numpy as np

from gvpipe.core.features import Features, MatchOptions
from gvpipe.core.homography import transfer_errors
from gvpipe.core.hypotheses import Hypothesis, Matches, find_hypotheses
from gvpipe.core.patches import Aligned, Pyramid, align, grey_pyramid
from gvpipe.core.sift import candidate_matches
from gvpipe.core.twoview import PairPrior, TwoView, two_views
from gvpipe.core.types import Float, Mount, PairMatch, Rejected, View
from gvpipe.core.verdict import Evidence, objection, weigh

_MAX_MATCHES = 500  # the most distinct ones: a right geometry never needs more
_MIN_MATCHES = 4
_TRIED = 3  # hypotheses whose patches are compared, for each set of assumed tilts
_CERTAIN = 15.0  # decimal exponent of the odds at which looking further is a waste
_WIDER = np.radians(6.0)  # next tilts to try where the configured ones lead nowhere
_UNKNOWN = np.radians([-20.0, -10.0, 10.0, 20.0])  # the same for a tilt that is not known
_UNKNOWN_SIGMA = np.radians(20.0)


@dataclass(frozen=True)
class _Candidate:
    hypothesis: Hypothesis
    aligned: Aligned
    covariance: Float
    evidence: Evidence


def _matches(features_i: Features, features_j: Features, max_ratio: float) -> Matches:
    index_i, index_j, _ = candidate_matches(features_i, features_j, max_ratio)
    index_i, index_j = index_i[:_MAX_MATCHES], index_j[:_MAX_MATCHES]
    return Matches(
        features_i.pixels[index_i],
        features_j.pixels[index_j],
        features_j.angle[index_j] - features_i.angle[index_i],
        np.log(features_j.size[index_j] / features_i.size[index_i]),
    )


def _tilt_errors(mount: Mount) -> tuple[float, ...]:
    return (0.0, *(float(t) for t in ((-_WIDER, _WIDER) if mount.tilt_known else _UNKNOWN)))


def _best(
    hypotheses: list[Hypothesis],
    expected: TwoView,
    prior: PairPrior,
    pyramids: tuple[Pyramid, Pyramid],
) -> _Candidate | None:
    """Find the hypothesis with the strongest evidence among the first few."""
    best: _Candidate | None = None
    for hypothesis in hypotheses[:_TRIED]:
        aligned = align(hypothesis.geometry, expected, prior, *pyramids)
        if aligned is None:
            continue
        covariance = aligned.fit.homography_covariance
        evidence = weigh(aligned, covariance, expected)
        if best is None or evidence.log10_odds > best.evidence.log10_odds:
            best = _Candidate(hypothesis, aligned, covariance, evidence)
    return best


def match_sift(
    view_i: View,
    view_j: View,
    features_i: Features,
    features_j: Features,
    options: MatchOptions,
    rng: np.random.Generator,
) -> PairMatch | Rejected:
    """Match on overhead views; parameters as in :func:`gvpipe.core.matching.match_views`."""
    matches = _matches(features_i, features_j, options.max_ratio)
    candidates = len(matches.pixels_i)
    if candidates < _MIN_MATCHES:
        return Rejected(
            f"{candidates} of {len(features_i.pixels)} keypoints have a distinct counterpart, at "
            f"least {_MIN_MATCHES} are needed",
            candidates=candidates,
        )
    expected = two_views(view_i, view_j)
    tilts = [options.tilt_sigma if v.mount.tilt_known else _UNKNOWN_SIGMA for v in (view_i, view_j)]
    prior = PairPrior(tilts[0], tilts[1], options.roll_sigma, options.height_sigma)
    pyramids = grey_pyramid(view_i.pixels), grey_pyramid(view_j.pixels)
    grid = list(product(_tilt_errors(view_i.mount), _tilt_errors(view_j.mount)))
    best: _Candidate | None = None
    trials = most = 0
    for assumed in (grid[:1], grid[1:]):
        hypotheses = find_hypotheses(
            expected, prior, matches, tuple(assumed), options.hypotheses, rng
        )
        trials += options.hypotheses * len(assumed)
        most = max([most, *(int(h.inliers.sum()) for h in hypotheses)])
        found = _best(hypotheses, expected, prior, pyramids)
        if found and (best is None or found.evidence.log10_odds > best.evidence.log10_odds):
            best = found
        if best and best.evidence.log10_odds > _CERTAIN:
            break
    if best is None:
        return Rejected(
            f"the best ground plane has {most} of {candidates} keypoint matches and no ground "
            "patches that look alike",
            candidates=candidates,
            trials=trials,
            inliers=0,
        )
    reason = objection(best.evidence, options)
    if reason is not None:
        return Rejected(reason, candidates, trials, best.evidence.inliers)
    return _accepted(best, candidates, trials)


def _accepted(best: _Candidate, candidates: int, trials: int) -> PairMatch:
    geometry, agrees = best.aligned.fit.geometry, best.aligned.agrees
    points_i, points_j = best.aligned.points_i[agrees], best.aligned.points_j[agrees]
    errors = transfer_errors(geometry.homography, points_i, points_j)
    return PairMatch(
        homography=geometry.homography,
        homography_initial=best.hypothesis.start.homography,
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
