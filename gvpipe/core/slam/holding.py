"""How each camera was held when its picture was taken, from the links of the picture."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix, diags_array
from scipy.sparse.linalg import splu

from gvpipe.core.geometry.ground import calibrations
from gvpipe.core.geometry.twoview import PairPrior
from gvpipe.core.kernels.links import fit_links
from gvpipe.core.slam.links import Link, LinkSet, Matches
from gvpipe.core.slam.placements import place_all
from gvpipe.core.slam.tilt_search import with_tilts
from gvpipe.core.types import Camera, Float, Index, Mount

MIN_POINTS = 8
"""Matches below which a link is not used: four fix a homography, the rest must confirm it."""

SAMPLE_POINTS = 32
"""Matches of a link that are fitted: spread over the picture, more change nothing at this stage."""

PRIOR = PairPrior(
    tilt_i=float(np.radians(4.0)),
    tilt_j=float(np.radians(4.0)),
    roll=float(np.radians(4.0)),
    log_scale=0.1,
)
"""Looser than a robot deserves: pictures taken by hand must fit too."""

LOSSES_PX = 20.0, 3.0
"""Loss scales of the descents, pixels: the first is wide enough to bend a plane that is degrees
off into place."""

MAX_STEPS, SETTLED = 30, 1e-4
"""Steps of each, at most, and the share of the cost gained in a step after which it ends."""

MAX_FIT_PX = 3.0
"""Median error above which no motion over the ground explains a link's matches, pixels."""

MAX_DRIFT = float(np.radians(20.0))
MAX_LOG_SCALE = 0.4
"""A link that can only be explained by a camera held this far (radians) from its configuration,
or by heights in this (logarithmic) disproportion, is no motion over the ground."""

HEIGHT_SIGMA = 0.05
"""Pull of every height towards the configured one, relative: chains of ratios drift."""

RATIO_SIGMA = 0.01
"""Ratios of heights are known to about this from one link; well beyond it they lose weight."""

HEIGHT_ROUNDS = 5
"""Rounds of that reweighting; the last moves no height by a tenth of that uncertainty."""


@dataclass(frozen=True)
class Held:
    """Starting values for the adjustment.

    Attributes
    ----------
    expected : list of Mount
        As configured, with the tilts found that were not.
    mounts : list of Mount
        How each camera was held.
    reasons : list of str
        Why a link cannot be used; empty for those that can.
    """

    expected: list[Mount]
    mounts: list[Mount]
    reasons: list[str]


def hold(
    linked: LinkSet,
    cameras: Sequence[Camera],
    mounts: Sequence[Mount],
    group: Index,
) -> Held:
    """Estimate tilt, roll and height of every picture from the homographies of its links.

    Parameters
    ----------
    linked : LinkSet
        E links; some may be wrong.
    cameras, mounts : sequence of Camera, sequence of Mount
        The N views as configured.
    group : (N,) int64
        Robot of each.

    Returns
    -------
    held : Held
    """
    links, ends = linked.links, linked.ends
    mounts = with_tilts(links, ends, cameras, mounts, group)
    sample = linked.matches.sampled(SAMPLE_POINTS)
    placed = place_all(sample, ends, cameras, mounts)
    fits, error_px = _fitted(sample, ends, placed, cameras, mounts)
    reasons = _verdicts(links, ends, placed, fits, error_px, mounts)
    which = np.nonzero([not reason for reason in reasons])[0]
    log_heights = _log_heights(ends[which], fits[which, 3], len(mounts))
    angles = _angles(ends[which], fits[which], mounts, group)
    return Held(
        mounts,
        [
            replace(m, tilt=float(tilt), roll=float(roll), height=m.height * float(np.exp(h)))
            for m, (tilt, roll), h in zip(mounts, angles, log_heights, strict=True)
        ],
        reasons,
    )


def _fitted(
    sample: Matches,
    ends: Index,
    placed: Float,
    cameras: Sequence[Camera],
    mounts: Sequence[Mount],
) -> tuple[Float, Float]:
    """Fit the geometry of each link: parameters (E, 8) as of `TwoView`, median errors (E,)."""
    matrix = calibrations(cameras)
    theta, error = fit_links(
        sample.start,
        sample.points_i,
        sample.points_j,
        ends,
        placed,
        np.array([(m.tilt, m.roll, m.height) for m in mounts]),
        matrix,
        np.asarray(np.linalg.inv(matrix), dtype=np.float64),
        PRIOR.weights,
        np.array(LOSSES_PX),
        MAX_STEPS,
        SETTLED,
    )
    return np.asarray(theta), np.asarray(error)


def _verdicts(
    links: Sequence[Link],
    ends: Index,
    placed: Float,
    fits: Float,
    error_px: Float,
    mounts: Sequence[Mount],
) -> list[str]:
    """Say of each link why it is no motion over the ground; empty if it could be one."""
    expected = np.array([(m.tilt, m.roll) for m in mounts])[ends].reshape(-1, 4)
    known = np.array([(m.tilt_known, True) for m in mounts])[ends].reshape(-1, 4)
    drift = np.where(known, np.abs(fits[:, 4:] - expected), 0.0).max(axis=1, initial=0.0)
    reasons = []
    for k, link in enumerate(links):
        why = ""
        if len(link.points_i) < MIN_POINTS:
            why = f"{len(link.points_i)} matches, fewer than {MIN_POINTS}"
        elif not np.isfinite(placed[k, 0]):
            why = "its matches do not lie on the ground before both cameras"
        elif not error_px[k] <= MAX_FIT_PX:
            why = f"not a motion over the ground: its matches miss by {error_px[k]:.1f} px (median)"
        elif drift[k] > MAX_DRIFT or abs(fits[k, 3]) > MAX_LOG_SCALE:
            why = (
                "not a motion over the ground: it asks for a camera "
                f"{np.degrees(drift[k]):.0f} deg off and heights in the ratio "
                f"{np.exp(fits[k, 3]):.2f}"
            )
        reasons.append(why)
    return reasons


def _angles(ends: Index, fits: Float, mounts: Sequence[Mount], group: Index) -> Float:
    """Median tilt and roll (N, 2) of each picture over its links.

    The median of its robot has one vote, so that one wrong link of two does not decide.
    """
    image = ends.ravel()
    seen = fits[:, 4:].reshape(-1, 2)
    out = np.array([(m.tilt, m.roll) for m in mounts]).reshape(-1, 2)
    usual = _medians(group[image], seen, int(group.max(initial=0)) + 1)[group]
    known = np.nonzero(np.isfinite(usual[:, 0]))[0]
    votes = np.append(image, known), np.concatenate([seen, usual[known]])
    out[known] = _medians(*votes, len(mounts))[known]
    return out


def _medians(group: Index, values: Float, count: int) -> Float:
    """Medians (count, C) of values (N, C) by group; NaN for those without any."""
    sizes = np.bincount(group, minlength=count)
    first = np.cumsum(sizes) - sizes
    out = np.full((count, values.shape[1]), np.nan)
    some = sizes > 0
    low, high = ((first + (sizes - k) // 2)[some] for k in (1, 0))
    for column in range(values.shape[1]):
        ordered = values[np.lexsort((values[:, column], group)), column]
        out[some, column] = 0.5 * (ordered[low] + ordered[high])
    return out


def _log_heights(ends: Index, ratios: Float, count: int) -> Float:
    """Logarithms (N,) of heights over configured ones that explain the links' (E,) ratios best."""
    heights = np.zeros(count)
    if not len(ratios):
        return heights
    edges = np.arange(len(ratios))
    jacobian = csc_matrix(
        coo_matrix(
            (
                np.concatenate([np.ones(len(ratios)), -np.ones(len(ratios))]),
                (np.concatenate([edges, edges]), ends.T.ravel()),
            ),
            (len(ratios), count),
        )
    )
    weight = np.full(len(ratios), 1.0 / RATIO_SIGMA**2)
    for _ in range(HEIGHT_ROUNDS):
        weighted = diags_array(weight) @ jacobian
        normal = csc_matrix(jacobian.T @ weighted) + diags_array(
            np.full(count, 1.0 / HEIGHT_SIGMA**2)
        )
        heights = splu(csc_matrix(normal)).solve(weighted.T @ ratios)
        off = (jacobian @ heights - ratios) / RATIO_SIGMA
        weight = 1.0 / (RATIO_SIGMA**2 * (1.0 + off**2))
    return np.asarray(heights, dtype=np.float64)
