"""Links: two images that see the same ground, and the evidence for it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gvpipe.core.types import Float, Index

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

    start: Index
    points_i: Float
    points_j: Float

    @property
    def count(self) -> Index:
        """Matches of each link, (E,)."""
        return np.diff(self.start)

    def sampled(self, at_most: int) -> "Matches":
        """Take of each link only every n-th match, so that it has no more than `at_most`."""
        every = np.maximum(-(-self.count // at_most), 1)
        count = -(-self.count // every)
        start = np.append(0, np.cumsum(count))
        at = np.arange(start[-1]) - np.repeat(start[:-1], count)
        at = np.repeat(self.start[:-1], count) + np.repeat(every, count) * at
        return Matches(start, self.points_i[at], self.points_j[at])


def matches_of(links: Sequence[Link]) -> Matches:
    """Gather the matches of links."""
    none = [np.empty((0, 2))]
    return Matches(
        np.cumsum([0, *(len(x.points_i) for x in links)], dtype=np.int64),
        np.concatenate([x.points_i for x in links] + none).astype(np.float64, copy=False),
        np.concatenate([x.points_j for x in links] + none).astype(np.float64, copy=False),
    )


@dataclass(frozen=True)
class LinkSet:
    """Links between numbered images, and their matches.

    Attributes
    ----------
    links : sequence of Link
        E links.
    ends : (E, 2) int64
        Numbers of their images.
    matches : Matches
        Of these links, and perhaps of others.
    number : (E,) int64
        Where each link stands among those that have the matches.
    """

    links: Sequence[Link]
    ends: Index
    matches: Matches
    number: Index

    @staticmethod
    def of(links: Sequence[Link], order: Sequence[str]) -> "LinkSet":
        """Take the numbers of the images from their places in a list of all."""
        place = {image: k for k, image in enumerate(order)}
        ends = [(place[x.image_i], place[x.image_j]) for x in links]
        return LinkSet(
            links,
            np.array(ends, dtype=np.int64).reshape(-1, 2),
            matches_of(links),
            np.arange(len(links)),
        )

    def pick(self, which: Index) -> "LinkSet":
        """Return some of the links; their matches stay where they are."""
        links = [self.links[k] for k in which.tolist()]
        return LinkSet(links, self.ends[which], self.matches, self.number[which])


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
