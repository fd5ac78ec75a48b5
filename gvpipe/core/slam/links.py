"""Links: two images that see the same ground, and the evidence for it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.types import Float

NEIGHBOURS = 5
"""Pictures of one robot up to this many places apart show the same ground because it has not
gone far; a link between them is odometry and closes no loop."""


@dataclass(frozen=True)
class Link:
    """Two images that see the same ground.

    Attributes
    ----------
    image_i, image_j : str
        Image ids.
    kind : str
        ``odometry``, ``loop`` or ``overlap``.
    homography : (3, 3) float64
        Pixels of i to pixels of j for points of the ground.
    points_i, points_j : (N, 2) float64
        Inlier pixels.
    """

    image_i: str
    image_j: str
    kind: str
    homography: Float
    points_i: Float
    points_j: Float


@dataclass(frozen=True)
class Matches:
    """Matches of many links, one link's after the other's.

    Attributes
    ----------
    start : (E + 1,) int64
        Matches ``start[e]:start[e + 1]`` belong to link e.
    points_i, points_j : (M, 2) float64
        Pixels.
    """

    start: NDArray[np.int64]
    points_i: Float
    points_j: Float


def matches_of(links: Sequence[Link], at_most: int | None = None) -> Matches:
    """Gather the matches of links; of each only every n-th if it has more than `at_most`."""
    every = [1 if at_most is None else -(-max(len(x.points_i), 1) // at_most) for x in links]
    points_i = [x.points_i[::n] for x, n in zip(links, every, strict=True)]
    points_j = [x.points_j[::n] for x, n in zip(links, every, strict=True)]
    none = [np.empty((0, 2))]
    return Matches(
        np.cumsum([0, *map(len, points_i)], dtype=np.int64),
        np.concatenate(points_i + none).astype(np.float64, copy=False),
        np.concatenate(points_j + none).astype(np.float64, copy=False),
    )


def robot_of(image_id: str) -> str:
    """Robot that took an image: what stands before the first slash of its id."""
    return image_id.split("/", 1)[0]


def link_kind(place: Mapping[str, int], image_i: str, image_j: str) -> str:
    """Kind of a link: ``overlap`` of two robots, ``odometry`` or ``loop`` of one.

    Parameters
    ----------
    place : mapping of image id to int
        Places of the images, robot by robot, each robot's in the order they were taken.
    image_i, image_j : str
        Two of them.
    """
    if robot_of(image_i) != robot_of(image_j):
        return "overlap"
    return "odometry" if abs(place[image_i] - place[image_j]) <= NEIGHBOURS else "loop"
