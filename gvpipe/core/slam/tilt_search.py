"""Search for the tilt of cameras that have none configured.

The right one makes the matches of a robot's own pictures most nearly isometries of the ground.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gvpipe.core.slam.links import Link, matches_of
from gvpipe.core.slam.placements import place_all
from gvpipe.core.types import Camera, Float, Index, Mount

ANY_TILTS = np.radians(np.arange(5.0, 88.0, 2.5))
"""Tilts tried where none is configured, radians."""

POOR_MISFIT = 0.3
"""Relative misfit that an impossible placement counts as."""

SAMPLE_POINTS, SAMPLE_LINKS = 32, 40
"""Matches of a link, and links of a robot, that are looked at: spread over the pictures, more
change nothing at this stage."""


def with_tilts(
    links: Sequence[Link],
    ends: Index,
    cameras: Sequence[Camera],
    mounts: Sequence[Mount],
    group: Index,
) -> list[Mount]:
    """Search the tilt of every robot that has none configured.

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
    mounts : list of Mount
        The same, but for unknown tilts of robots that have links of their own: those found.
    """
    out = list(mounts)
    for robot in np.unique(group).tolist():
        members = np.nonzero(group == robot)[0].tolist()
        unknown = [k for k in members if not mounts[k].tilt_known]
        own = np.nonzero(np.isin(ends, unknown).all(axis=1))[0]
        if not unknown or not len(own):
            continue
        some = own[:: -(-len(own) // SAMPLE_LINKS)]
        images, local = np.unique(ends[some], return_inverse=True)
        sample = matches_of([links[k] for k in some.tolist()]).sampled(SAMPLE_POINTS)
        own_cameras = [cameras[k] for k in images.tolist()]
        scores = []
        for tilt in ANY_TILTS.tolist():
            held = [replace(mounts[k], tilt=tilt) for k in images.tolist()]
            scores.append(_misfit(place_all(sample, local.reshape(-1, 2), own_cameras, held)))
        best = float(ANY_TILTS[int(np.argmin(scores))])
        for k in unknown:
            out[k] = replace(mounts[k], tilt=best)
    return out


def _misfit(placed: Float) -> float:
    """Mean misfit of placements (E, 7) over the radius of their points, each bounded."""
    radius, misfit = placed[:, 5], placed[:, 6]
    sound = radius > 0.0  # not so where it is NaN
    relative = np.divide(misfit, radius, out=np.full(len(placed), POOR_MISFIT), where=sound)
    return float(np.minimum(relative, POOR_MISFIT).mean())
