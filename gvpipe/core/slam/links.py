"""Links: two images that see the same ground, and the evidence for it."""

from collections.abc import Sequence
from dataclasses import dataclass

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


def robot_of(image_id: str) -> str:
    """Robot that took an image: what stands before the first slash of its id."""
    return image_id.split("/", 1)[0]


def link_kind(order: Sequence[str], image_i: str, image_j: str) -> str:
    """Kind of a link: ``overlap`` of two robots, ``odometry`` or ``loop`` of one.

    Parameters
    ----------
    order : sequence of str
        Image ids of all robots, each robot's in the order they were taken.
    image_i, image_j : str
        Two of them.
    """
    if robot_of(image_i) != robot_of(image_j):
        return "overlap"
    own = [image for image in order if robot_of(image) == robot_of(image_i)]
    return "odometry" if abs(own.index(image_i) - own.index(image_j)) <= NEIGHBOURS else "loop"
