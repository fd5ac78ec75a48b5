"""Closing errors: how far a chain of homographies misses a place that is seen again."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gvpipe.core.geometry.homography import apply
from gvpipe.core.slam.links import Link
from gvpipe.core.slam.transfer import map_from_pixel, median_distance
from gvpipe.core.types import Camera, Float, Pose

REPORTED = 20
"""Closures reported at most, longest chains first."""

SHORTEST_CHAIN = 3
"""Links a chain must have for its closing error to say something about drift."""


@dataclass(frozen=True)
class Closure:
    """A loop walked along odometry and closed by another link.

    Attributes
    ----------
    image_i, image_j : str
        Images at the two ends, which see the same ground.
    chain_links : int
        Links of the chain between them.
    concatenated_m : float
        Median distance on the ground between the matches of j and those of i brought over by the
        product of the chain's homographies (thesis eq. 4.3.1), metres.
    adjusted_m : float
        The same with the poses of the map.
    """

    image_i: str
    image_j: str
    chain_links: int
    concatenated_m: float
    adjusted_m: float


def closures(
    links: Sequence[Link], poses: Mapping[str, Pose], cameras: Mapping[str, Camera]
) -> tuple[Closure, ...]:
    """Measure the closing error of every loop that an odometry chain closes.

    Parameters
    ----------
    links : sequence of Link
        Links the map rests on.
    poses : mapping of image id to Pose
        Camera to map, of registered images in the order they were taken: the chains run from
        each to the next.
    cameras : mapping of image id to Camera
        Intrinsics.

    Returns
    -------
    closures : tuple of Closure
        Longest chains first, at most ``REPORTED``.
    """
    images = list(poses)
    index = {image: k for k, image in enumerate(images)}
    step: dict[int, Float] = {}
    for link in links:
        i, j = index[link.image_i], index[link.image_j]
        if link.kind == "odometry" and abs(i - j) == 1:
            h = link.homography
            step[min(i, j)] = h if i < j else np.asarray(np.linalg.inv(h), dtype=np.float64)
    # links of the chain up to each image
    whole = np.cumsum([0, *(k in step for k in range(len(images) - 1))])
    out = []
    for link in links:
        i, j = sorted((index[link.image_i], index[link.image_j]))
        if link.kind != "odometry" and SHORTEST_CHAIN <= j - i == whole[j] - whole[i]:
            out.append((link, j - i))
    out.sort(key=lambda x: (-x[1], x[0].image_i, x[0].image_j))
    return tuple(
        _measured(x, n, _product(step, index[x.image_i], index[x.image_j]), poses, cameras)
        for x, n in out[:REPORTED]
    )


def _product(step: Mapping[int, Float], start: int, end: int) -> Float:
    """Homography along the chain from one image to another."""
    product = np.eye(3)
    for k in range(min(start, end), max(start, end)):
        product = step[k] @ product
        product /= np.linalg.norm(product)
    return product if start < end else np.asarray(np.linalg.inv(product), dtype=np.float64)


def _measured(
    link: Link, count: int, product: Float, poses: Mapping[str, Pose], cameras: Mapping[str, Camera]
) -> Closure:
    """Measure the closing errors of one chain on the ground."""
    i, j = link.image_i, link.image_j
    map_from_i = map_from_pixel(cameras[i], poses[i])
    map_from_j = map_from_pixel(cameras[j], poses[j])
    there = apply(map_from_j, link.points_j)
    return Closure(
        image_i=i,
        image_j=j,
        chain_links=count,
        concatenated_m=median_distance(apply(map_from_j @ product, link.points_i), there),
        adjusted_m=median_distance(apply(map_from_i, link.points_i), there),
    )
