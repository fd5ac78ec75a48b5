"""The floor below a found plane, which may be the top of an obstacle."""

from dataclasses import replace

import numpy as np

from gvpipe.core.geometry.ground import ground_points, pixel_from_ground
from gvpipe.core.geometry.homography import transfer_errors
from gvpipe.core.geometry.twoview import TwoView
from gvpipe.core.matching.candidate import Candidate, Pair, examine
from gvpipe.core.matching.hypotheses import INLIER_PX, Matches

_LOWER = np.linspace(0.4, 0.96, 29)
"""Heights above the found plane tried, as shares of the height above the ground: a plane higher
than 60 % of the camera fills the picture and is not the floor of anything."""
_LOWER_PX = 5.0
_LOWER_FEWEST = 8  # matches, so that chance (about 1 of 100 along a line of parallax) is ruled out
_LEAST_GROUND = 0.3  # patches of a lower plane, of those on the found one: less may be reflections


def plane_at(geometry: TwoView, share: float) -> TwoView:
    """Geometry of the parallel plane lower than the one that `geometry` calls the ground.

    Parameters
    ----------
    geometry : TwoView
        Fitted to a plane at some height, taken for the ground.
    share : float
        Height of camera j above that plane over its height above the ground, 0 to 1.

    Returns
    -------
    lower : TwoView
        The same camera motion, with the configured heights above the lower plane.
    """
    height_i, height_j = geometry.mount_i.height, geometry.mount_j.height
    above = height_j * (1.0 - share)  # of the found plane
    share_i = max(height_i - above, 1e-3 * height_i) / height_i
    return replace(
        geometry,
        x=geometry.x * share,
        y=geometry.y * share,
        log_scale=geometry.log_scale + float(np.log(share / share_i)),
    )


def lower_plane(geometry: TwoView, matches: Matches, inlier_px: float) -> TwoView | None:
    """Parallel plane below the found one that most of the other matches lie on.

    Nothing is to be seen below the ground: if matches follow the same camera motion over a lower
    plane, the found one is the top of an obstacle.

    Parameters
    ----------
    geometry : TwoView
        Of the found plane.
    matches : Matches
        Putative matches.
    inlier_px : float
        Matches nearer than this to the found plane belong to it.

    Returns
    -------
    lower : TwoView or None
        None if hardly any match lies below.
    """
    p, q = matches.pixels_i, matches.pixels_j
    other = transfer_errors(geometry.homography, p, q) > max(inlier_px, 2 * _LOWER_PX)
    if other.sum() < _LOWER_FEWEST:
        return None
    ground, _ = ground_points(p[other], geometry.camera_i, geometry.mount_i)
    from_j = pixel_from_ground(geometry.camera_j, geometry.mount_j)
    counts = []
    for share in _LOWER:
        plane = plane_at(geometry, float(share))
        errors = transfer_errors(from_j @ plane.ground_j_from_ground_i, ground, q[other])
        counts.append(int((errors < _LOWER_PX).sum()))
    best = int(np.argmax(counts))
    return plane_at(geometry, float(_LOWER[best])) if counts[best] >= _LOWER_FEWEST else None


def lowest(pair: Pair, found: Candidate) -> Candidate:
    """Return the plane below the found one, if the pictures show one.

    Parameters
    ----------
    pair : Pair
        The views.
    found : Candidate
        A plane that nothing is to be said against.

    Returns
    -------
    candidate : Candidate
        `found` itself if nothing better lies below.
    """
    below = lower_plane(found.aligned.fit.geometry, pair.matches, INLIER_PX)
    lower = examine(pair, found.start, below) if below is not None else None
    if lower is None or lower.objection is not None:
        return found
    ground, top = lower.aligned.fit.geometry, found.aligned.fit.geometry
    enough = lower.evidence.inliers > _LEAST_GROUND * found.evidence.inliers
    return lower if enough and np.hypot(ground.x, ground.y) < np.hypot(top.x, top.y) else found
