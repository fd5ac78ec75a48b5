"""First look at the links: where they place the images, and which of them agree."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gvpipe.core.slam.consistency import agree
from gvpipe.core.slam.links import Link, LinkSet
from gvpipe.core.slam.placements import Placements, place_all
from gvpipe.core.types import Camera, Float, Index, Mask, Mount

TOLERANCE = 0.02
"""Share of the camera height by which two placements of the same ground may differ at least."""

TRUST = {"odometry": 4.0, "loop": 1.0, "overlap": 1.0}
"""Weight in the vote on contradictions: a robot's next picture nearly always shows the same
ground, while loops and overlaps are found by resemblance."""

SAMPLE_POINTS = 80
"""Matches of a link that are looked at: spread over the picture, more hardly move it."""

HALF_TRUST_POINTS = 50.0
"""Matches at which a link has half the weight of one with very many."""


@dataclass(frozen=True)
class Screened:
    """Rough positions, and the links that carry them.

    Attributes
    ----------
    planar : (N, 3) float64
        x, y (metres) and heading (radians) of every robot; a frame for each connected part.
    keep : (E,) bool
        Links that agree with each other.
    """

    planar: Float
    keep: Mask


def screen(
    linked: LinkSet,
    usable: Mask,
    cameras: Sequence[Camera],
    mounts: Sequence[Mount],
) -> Screened:
    """Place all images roughly on the ground and find the links that contradict each other.

    Parameters
    ----------
    linked : LinkSet
        E links.
    usable : (E,) bool
        Links that could be motions over the ground.
    cameras, mounts : sequence of Camera, sequence of Mount
        The N views, held as each picture shows.

    Returns
    -------
    screened : Screened
    """
    links, ends = linked.links, linked.ends
    placed = place_all(linked.matches.sampled(SAMPLE_POINTS), ends, cameras, mounts)
    used = np.nonzero(usable & (placed[:, 5] > 0))[0]
    heights = np.array([mount.height for mount in mounts])
    planar, agrees = agree(_placements(links, placed[used], used, ends, heights), len(mounts))
    keep = np.zeros(len(links), dtype=bool)
    keep[used] = agrees
    return Screened(planar, keep)


def _placements(
    links: Sequence[Link], placed: Float, used: Index, ends: Index, heights: Float
) -> Placements:
    """Lay the placements of the used links out as arrays."""
    count = np.array([len(links[k].points_i) for k in used.tolist()], dtype=np.float64)
    kind = np.array([TRUST[links[k].kind] for k in used.tolist()])
    return Placements(
        i=ends[used, 0],
        j=ends[used, 1],
        centre_i=placed[:, :2],
        centre_j=placed[:, 2:4],
        turn=placed[:, 4],
        radius=placed[:, 5],
        tolerance=np.hypot(TOLERANCE * heights[ends[used, 0]], placed[:, 6]),
        trust=kind * count / (count + HALF_TRUST_POINTS),
    )
