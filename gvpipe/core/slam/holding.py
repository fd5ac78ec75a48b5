"""How each camera was held when its picture was taken, from the links of the picture."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix, diags_array
from scipy.sparse.linalg import splu

from gvpipe.core.geometry.homography import transfer_errors
from gvpipe.core.geometry.twoview import PairPrior, TwoView, fit_two_views
from gvpipe.core.slam.links import Link
from gvpipe.core.slam.placement import place
from gvpipe.core.slam.tracks import Index
from gvpipe.core.types import Camera, Float, Mount

MIN_POINTS = 8
"""Matches below which a link is not used: four fix a homography, the rest must confirm it."""

SAMPLE_POINTS = 80
SAMPLE_LINKS = 40
"""Matches of a link that are fitted, and links of a robot that the search for its tilt looks at:
spread over the picture, more of them change nothing at this stage."""

PRIOR = PairPrior(
    tilt_i=float(np.radians(4.0)),
    tilt_j=float(np.radians(4.0)),
    roll=float(np.radians(4.0)),
    log_scale=0.1,
)
"""Looser than a robot deserves: pictures taken by hand must fit too."""

MAX_FIT_PX = 3.0
"""Median error above which no motion over the ground explains a link's matches, pixels."""

MAX_DRIFT = float(np.radians(20.0))
MAX_LOG_SCALE = 0.4
"""A link that can only be explained by a camera held this far (radians) from its configuration,
or by heights in this (logarithmic) disproportion, is no motion over the ground."""

ANY_TILTS = np.radians(np.arange(5.0, 88.0, 2.5))
"""Tilts tried where none is configured, radians."""

POOR_MISFIT = 0.3
"""Relative misfit that an impossible placement counts as in that search."""

HEIGHT_SIGMA = 0.05
"""Pull of every height towards the configured one, relative: chains of ratios drift."""

RATIO_SIGMA = 0.01
"""Ratios of heights are known to about this from one link; well beyond it they lose weight."""


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
    links: Sequence[Link],
    ends: Index,
    cameras: Sequence[Camera],
    mounts: Sequence[Mount],
    group: Index,
) -> Held:
    """Estimate tilt, roll and height of every picture from the homographies of its links.

    Parameters
    ----------
    links : sequence of Link
        E links; some may be wrong.
    ends : (E, 2) int64
        Numbers of their images.
    cameras, mounts : sequence of Camera, sequence of Mount
        The N views as configured.
    group : (N,) int64
        Robot of each.

    Returns
    -------
    held : Held
    """
    mounts = _with_tilts(links, ends, cameras, mounts, group)
    reasons = [""] * len(links)
    fits: dict[int, TwoView] = {}
    for k, (i, j) in enumerate(ends.tolist()):
        verdict = _fit(links[k], (cameras[i], cameras[j]), (mounts[i], mounts[j]))
        if isinstance(verdict, str):
            reasons[k] = verdict
        else:
            fits[k] = verdict
    which = np.array(list(fits), dtype=np.int64)
    ratios = np.array([fit.log_scale for fit in fits.values()])
    log_heights = _log_heights(ends[which], ratios, len(mounts))
    angles = _angles(ends[which], list(fits.values()), mounts, group)
    return Held(
        mounts,
        [
            replace(m, tilt=float(tilt), roll=float(roll), height=m.height * float(np.exp(h)))
            for m, (tilt, roll), h in zip(mounts, angles, log_heights, strict=True)
        ],
        reasons,
    )


def _sampled(link: Link) -> tuple[Float, Float]:
    """Pick a bounded number of a link's matches."""
    every = -(-len(link.points_i) // SAMPLE_POINTS)
    return link.points_i[::every], link.points_j[::every]


def _fit(link: Link, cameras: tuple[Camera, Camera], mounts: tuple[Mount, Mount]) -> TwoView | str:
    """Fit the geometry of one link, or say why that is impossible."""
    if len(link.points_i) < MIN_POINTS:
        return f"{len(link.points_i)} matches, fewer than {MIN_POINTS}"
    points_i, points_j = _sampled(link)
    placement = place(points_i, points_j, cameras, mounts)
    if placement is None:
        return "its matches do not lie on the ground before both cameras"
    c, s = np.cos(placement.turn), np.sin(placement.turn)
    shift = placement.centre_j - np.array([[c, -s], [s, c]]) @ placement.centre_i
    expected = TwoView(*cameras, *mounts)
    start = replace(expected, yaw=placement.turn, x=float(shift[0]), y=float(shift[1]))
    # the first descent is wide enough to bend a plane that is degrees off into place
    for loss_px in (20.0, 3.0):
        start = fit_two_views(start, expected, PRIOR, points_i, points_j, loss=loss_px).geometry
    error_px = float(np.median(transfer_errors(start.homography, points_i, points_j)))
    if error_px > MAX_FIT_PX:
        return f"not a motion over the ground: its matches miss by {error_px:.1f} px (median)"
    drift = start.drift(expected)
    if drift > MAX_DRIFT or abs(start.log_scale) > MAX_LOG_SCALE:
        return (
            f"not a motion over the ground: it asks for a camera {np.degrees(drift):.0f} deg off "
            f"and heights in the ratio {np.exp(start.log_scale):.2f}"
        )
    return start


def _angles(ends: Index, fits: list[TwoView], mounts: Sequence[Mount], group: Index) -> Float:
    """Median tilt and roll (N, 2) of each picture over its links.

    The median of its robot has one vote, so that one wrong link of two does not decide.
    """
    image = ends.ravel()
    seen = np.array([(m.tilt, m.roll) for fit in fits for m in (fit.mount_i, fit.mount_j)]).reshape(
        -1, 2
    )
    out = np.array([(m.tilt, m.roll) for m in mounts]).reshape(-1, 2)
    of_robot = group[image]
    order = np.argsort(image, kind="stable")
    bounds = np.searchsorted(image[order], np.arange(len(mounts) + 1))
    usual = {g: np.median(seen[of_robot == g], axis=0) for g in np.unique(of_robot).tolist()}
    for k in range(len(mounts)):
        if int(group[k]) in usual:
            own = seen[order[bounds[k] : bounds[k + 1]]]
            out[k] = np.median(np.vstack([own, usual[int(group[k])]]), axis=0)
    return out


def _log_heights(ends: Index, ratios: Float, count: int) -> Float:
    """Logarithms (N,) of heights over configured ones that explain the links' ratios best."""
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
    for _ in range(5):
        weighted = diags_array(weight) @ jacobian
        normal = csc_matrix(jacobian.T @ weighted) + diags_array(
            np.full(count, 1.0 / HEIGHT_SIGMA**2)
        )
        heights = splu(csc_matrix(normal)).solve(weighted.T @ ratios)
        off = (jacobian @ heights - ratios) / RATIO_SIGMA
        weight = 1.0 / (RATIO_SIGMA**2 * (1.0 + off**2))
    return np.asarray(heights, dtype=np.float64)


def _with_tilts(
    links: Sequence[Link],
    ends: Index,
    cameras: Sequence[Camera],
    mounts: Sequence[Mount],
    group: Index,
) -> list[Mount]:
    """Search the tilt of every robot that has none configured.

    The right one makes the matches of the robot's own pictures most nearly isometries.
    """
    out = list(mounts)
    for robot in np.unique(group).tolist():
        members = np.nonzero(group == robot)[0].tolist()
        unknown = [k for k in members if not mounts[k].tilt_known]
        own = np.nonzero(np.isin(ends, unknown).all(axis=1))[0]
        if not unknown or not len(own):
            continue
        sample = own[:: -(-len(own) // SAMPLE_LINKS)].tolist()
        scores = []
        for tilt in ANY_TILTS.tolist():
            misfits = []
            for k in sample:
                i, j = ends[k].tolist()
                held = replace(mounts[i], tilt=tilt), replace(mounts[j], tilt=tilt)
                misfits.append(_misfit(links[k], (cameras[i], cameras[j]), held))
            scores.append(np.mean(misfits))
        best = float(ANY_TILTS[int(np.argmin(scores))])
        for k in unknown:
            out[k] = replace(mounts[k], tilt=best)
    return out


def _misfit(link: Link, cameras: tuple[Camera, Camera], mounts: tuple[Mount, Mount]) -> float:
    """Misfit of a link's isometry over the radius of its points, bounded."""
    placement = place(*_sampled(link), cameras, mounts)
    if placement is None or placement.radius <= 0:
        return POOR_MISFIT
    return min(placement.misfit / placement.radius, POOR_MISFIT)
