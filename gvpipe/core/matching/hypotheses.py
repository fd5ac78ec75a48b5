"""Ground geometries that a set of uncertain matches proposes, best first."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.geometry.ground import ground_points, pixel_from_ground
from gvpipe.core.geometry.homography import apply, transfer_errors
from gvpipe.core.geometry.twoview import PairPrior, TwoView, fit_two_views
from gvpipe.core.kernels.hypotheses import score_pairs
from gvpipe.core.types import Float

_TOLERANCE_PX = 14.0  # of a similarity between overheads whose tilts are off by a few degrees
_MAX_TURN = np.radians(35.0)  # keypoint orientations are good to 10-15 degrees, less when sheared
_MAX_LOG_GROWTH = np.log(1.9)  # the same for their sizes
_MAX_LOG_SCALE = np.log(1.5)  # of the ground: heights misstated and distances sheared by the tilt
_REFINED = 8  # hypotheses that get a full fit
_SAME_HEIGHTS = 0.15  # similarities nearer than this many camera heights are one
_PLAIN = 0.5  # share of all matches on one plane that makes other hypotheses pointless
_SAME_PX = 20.0  # hypotheses nearer than this over the matches are one
_ANNEAL_PX = (8.0, 4.0, 2.0, 1.0)  # standard deviations of a match, in turn
INLIER_PX = 4.0
"""A match nearer to a hypothesis agrees with it."""


@dataclass(frozen=True)
class Matches:
    """Putative matches of two views.

    Attributes
    ----------
    pixels_i, pixels_j : (N, 2) float64
        Positions in the pictures.
    turn, log_growth : (N,) float64
        Orientation and log size in j minus those in i, both on the ground.
    """

    pixels_i: Float
    pixels_j: Float
    turn: Float
    log_growth: Float


@dataclass(frozen=True)
class Hypothesis:
    """A geometry and the matches that agree with it.

    Attributes
    ----------
    start, geometry : TwoView
        From two matches, and after the fit to all that agree.
    inliers : (N,) bool
    """

    start: TwoView
    geometry: TwoView
    inliers: NDArray[np.bool_]


def _propose(
    expected: TwoView, tilts: tuple[float, float], matches: Matches, draws: NDArray[np.int64]
) -> list[tuple[float, TwoView]]:
    """Scored similarities under assumed tilt errors, best first."""
    assumed = replace(
        expected,
        mount_i=replace(expected.mount_i, tilt=expected.mount_i.tilt + tilts[0]),
        mount_j=replace(expected.mount_j, tilt=expected.mount_j.tilt + tilts[1]),
    )
    ground_i, below_i = ground_points(matches.pixels_i, expected.camera_i, assumed.mount_i)
    ground_j, below_j = ground_points(matches.pixels_j, expected.camera_j, assumed.mount_j)
    use = below_i & below_j
    if use.sum() < 2:
        return []
    found = score_pairs(
        draws % int(use.sum()),
        np.ascontiguousarray(ground_i[use]),
        np.ascontiguousarray(ground_j[use]),
        np.ascontiguousarray(matches.pixels_j[use]),
        matches.turn[use],
        matches.log_growth[use],
        pixel_from_ground(expected.camera_j, assumed.mount_j),
        _MAX_LOG_SCALE,
        _MAX_TURN,
        _MAX_LOG_GROWTH,
        _TOLERANCE_PX,
        _PLAIN * len(use),
    )
    rest = assumed.parameters[4:]
    return [
        (float(row[0]), assumed.with_parameters(np.concatenate([row[1:], rest])))
        for row in _peaks(found[found[:, 0] > 0], assumed.mount_j.height)
    ]


def _peaks(found: Float, height: float) -> Float:
    """Best similarities (K, 5) that differ in where they put a point two heights away."""
    peaks: list[Float] = []
    while len(found) and len(peaks) < _REFINED:
        peak = found[found[:, 0].argmax()]
        peaks.append(peak)
        turn = np.abs((found[:, 1] - peak[1] + np.pi) % (2 * np.pi) - np.pi)
        moved = np.hypot(found[:, 2] - peak[2], found[:, 3] - peak[3])
        found = found[moved + 2 * height * turn > _SAME_HEIGHTS * height]
    return np.array(peaks).reshape(-1, 5)


def _distinct(geometries: list[TwoView], points: Float, most: int) -> list[TwoView]:
    """Drop what repeats an earlier geometry."""
    kept: list[TwoView] = []
    seen: list[Float] = []
    for geometry in geometries:
        with np.errstate(divide="ignore", invalid="ignore"):
            mapped = apply(geometry.homography, points)
        if all(np.median(np.abs(mapped - other)) > _SAME_PX for other in seen):
            kept.append(geometry)
            seen.append(mapped)
            if len(kept) == most:
                break
    return kept


def find_hypotheses(
    expected: TwoView,
    prior: PairPrior,
    matches: Matches,
    tilt_errors: tuple[tuple[float, float], ...],
    draws: int,
    rng: np.random.Generator,
) -> list[Hypothesis]:
    """Geometries from pairs of matches, fitted to all matches that follow them.

    Parameters
    ----------
    expected : TwoView
        As configured.
    prior : PairPrior
        How far the configuration may be off.
    matches : Matches
        Putative matches, most trusted first.
    tilt_errors : tuple of (float, float)
        Errors of the two configured tilts to assume in turn, radians.
    draws : int
        Pairs of matches drawn for each of them.
    rng : Generator
        Draws the pairs.

    Returns
    -------
    hypotheses : list of Hypothesis
        Most inliers first.
    """
    n = len(matches.pixels_i)
    if n < 2:
        return []
    proposals = []
    for tilts in tilt_errors:
        pairs = rng.integers(n, size=(draws, 2))
        proposals += _propose(expected, tilts, matches, pairs)
    ranked = [geometry for _, geometry in sorted(proposals, key=lambda s: -s[0])]
    found = []
    for start in _distinct(ranked, matches.pixels_i, _REFINED):
        geometry = start
        for sigma in _ANNEAL_PX:
            whiten = np.broadcast_to(np.eye(2) / sigma, (n, 2, 2))
            geometry = fit_two_views(
                geometry, expected, prior, matches.pixels_i, matches.pixels_j, whiten
            ).geometry
        errors = transfer_errors(geometry.homography, matches.pixels_i, matches.pixels_j)
        found.append(Hypothesis(start, geometry, errors < INLIER_PX))
        if found[-1].inliers.sum() > _PLAIN * n:
            break
    found.sort(key=lambda h: -int(h.inliers.sum()))
    kept = _distinct([h.geometry for h in found], matches.pixels_i, _REFINED)
    return [h for h in found if any(h.geometry is geometry for geometry in kept)]
