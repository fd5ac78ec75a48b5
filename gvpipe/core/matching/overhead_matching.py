"""The default matcher: SIFT on overhead views, then patches of ground aligned in the pictures."""

from itertools import product

import numpy as np

from gvpipe.core.geometry.homography import transfer_errors
from gvpipe.core.matching.candidate import Candidate, Pair, examine, prepare
from gvpipe.core.matching.features import Features, MatchOptions
from gvpipe.core.matching.hypotheses import Matches, find_hypotheses
from gvpipe.core.matching.lower_plane import lowest
from gvpipe.core.matching.patches import COARSENESS
from gvpipe.core.matching.rivals import ambiguity
from gvpipe.core.matching.sift import candidate_matches
from gvpipe.core.types import Mount, PairMatch, Rejected, View

_MAX_MATCHES = 500  # the most distinct ones: a right geometry never needs more
_MIN_MATCHES = 4
_TRIED = 3  # hypotheses whose patches are compared, for each set of assumed tilts
_WELL_KNOWN = 40  # keypoint matches that place patches to a pixel or two
_CERTAIN = 15.0  # decimal exponent of the odds at which looking further is a waste

_WIDER = np.radians(6.0)  # next tilts to try where the configured ones lead nowhere
_UNKNOWN = np.radians([-20.0, -10.0, 10.0, 20.0])  # the same for a tilt that is not known


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
        best = lowest(pair, best)
        reason = ambiguity(pair, best, view_i)
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
