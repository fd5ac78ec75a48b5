"""Links: two images that see the same ground, and the evidence for it."""

from dataclasses import dataclass

from gvpipe.core.types import Float


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
