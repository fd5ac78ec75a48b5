"""Pairs of images worth matching, found from the growing map."""

from bisect import bisect_left
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from gvpipe.core.geometry.ground import calibrations, pixels_from_plane
from gvpipe.core.kernels.footprints import shared_footprints
from gvpipe.core.slam.links import robot_of
from gvpipe.core.types import Camera, Float, Index, Pose

RANGE_HEIGHTS = 5.0
"""Ground farther away than this many camera heights is too coarse to match."""

COLUMNS, ROWS = 10, 8
"""Pixels of each image, across and down, on which overlap is counted."""


@dataclass(frozen=True)
class Candidate:
    """Two images that should show the same ground.

    Attributes
    ----------
    image_i, image_j : str
        Image ids, in map order.
    share : float
        Share of the pixels of either whose ground the other sees too, the smaller of both; 0
        where it is only guessed.
    """

    image_i: str
    image_j: str
    share: float


def loop_candidates(
    cameras: Mapping[str, Camera],
    poses: Mapping[str, Pose],
    tried: Collection[tuple[str, str]],
    *,
    min_share: float,
    max_per_image: int,
) -> list[Candidate]:
    """Image pairs whose footprints overlap in the map and which have not been tried.

    Parameters
    ----------
    cameras : mapping of image id to Camera
        Intrinsics.
    poses : mapping of image id to Pose
        Camera to map, of the images of one component.
    tried : collection of (str, str)
        Pairs that were matched or rejected, in either order.
    min_share : float
        Smallest :attr:`Candidate.share`, in [0, 1].
    max_per_image : int
        Candidates an image may be part of, best first: bounds the total to half of that times
        the number of images.

    Returns
    -------
    candidates : list of Candidate
        Best overlap first.
    """
    images = list(poses)
    number = {image: k for k, image in enumerate(images)}
    own = [cameras[image] for image in images]
    size = np.array([(c.width, c.height) for c in own], dtype=np.float64).reshape(-1, 2)
    rotation = np.array([pose.rotation for pose in poses.values()]).reshape(-1, 3, 3)
    position = np.array([pose.translation for pose in poses.values()]).reshape(-1, 3)
    projection = pixels_from_plane(calibrations(own), rotation, position)
    ground, first = _ground_seen(projection, size, position)
    known = [(number[i], number[j]) for i, j in tried if i in number and j in number]
    pairs = _near(ground, first, np.array(known, dtype=np.int64).reshape(-1, 2))
    shares = np.asarray(shared_footprints(first, ground, projection, size, pairs))
    found = [
        Candidate(images[i], images[j], share)
        for (i, j), share in zip(pairs.tolist(), shares.tolist(), strict=True)
        if share >= min_share
    ]
    found.sort(key=lambda c: (-c.share, c.image_i, c.image_j))
    return _thinned(found, max_per_image)


def _ground_seen(projection: Float, size: Float, position: Float) -> tuple[Float, Index]:
    """Ground points (S, 2) of the map under a grid of pixels of each image, near enough to match.

    Those of image n are ``first[n]:first[n + 1]``; `first` is the second array returned.
    """
    grid = np.meshgrid((np.arange(COLUMNS) + 0.5) / COLUMNS, (np.arange(ROWS) + 0.5) / ROWS)
    pixel = np.stack(grid, axis=-1).reshape(1, -1, 2) * size[:, None] - 0.5
    rays = np.concatenate([pixel, np.ones((*pixel.shape[:2], 1))], axis=-1)
    rays = rays @ np.linalg.inv(projection).transpose(0, 2, 1)
    below = rays[..., 2] > 0
    ground = rays[..., :2] / np.where(below, rays[..., 2], 1.0)[..., None]
    far = np.linalg.norm(ground - position[:, None, :2], axis=-1)
    near = below & (far <= RANGE_HEIGHTS * position[:, None, 2])
    return ground[near], np.append(0, np.cumsum(near.sum(axis=1)))


def _near(ground: Float, first: Index, known: Index) -> Index:
    """Pairs of images (P, 2) whose ground could overlap, without the known ones."""
    image = np.repeat(np.arange(len(first) - 1), np.diff(first))
    count = np.bincount(image, minlength=len(first) - 1)
    which = np.nonzero(count)[0]
    if len(which) < 2:
        return np.empty((0, 2), dtype=np.int64)
    sums = [np.bincount(image, column, minlength=len(count)) for column in ground.T]
    centre = np.column_stack(sums) / np.maximum(count, 1)[:, None]
    reach = np.zeros(len(count))
    np.maximum.at(reach, image, np.linalg.norm(ground - centre[image], axis=1))
    pairs = cKDTree(centre[which]).query_pairs(2.0 * float(reach.max()), output_type="ndarray")
    pairs = np.sort(which[pairs], axis=1)
    apart = np.linalg.norm(centre[pairs[:, 0]] - centre[pairs[:, 1]], axis=1)
    pairs = pairs[apart < reach[pairs].sum(axis=1)]
    known = np.sort(known, axis=1)
    old = np.isin(pairs @ [len(count), 1], known @ [len(count), 1])
    return pairs[~old]


def _thinned(candidates: list[Candidate], max_per_image: int) -> list[Candidate]:
    """Keep the candidates, best first, that leave no image with more than a few."""
    used: dict[str, int] = {}
    out = []
    for c in candidates:
        if max(used.get(c.image_i, 0), used.get(c.image_j, 0)) < max_per_image:
            out.append(c)
            for image in (c.image_i, c.image_j):
                used[image] = used.get(image, 0) + 1
    return out


def without_bridges(
    images: Sequence[str], links: Collection[tuple[str, str]]
) -> list[tuple[str, ...]]:
    """Split images where one link alone holds parts together: nothing else confirms such a link.

    Parameters
    ----------
    images : sequence of str
        Image ids.
    links : collection of (str, str)
        Links between them.

    Returns
    -------
    components : list of tuples of str
        Images that still hang together whichever link is taken away.

    Notes
    -----
    A link is a bridge if no other leads back from what lies beyond it (Tarjan's low links).
    """
    beside: dict[str, list[tuple[int, str]]] = {image: [] for image in images}
    for k, (i, j) in enumerate(links):
        beside[i].append((k, j))
        beside[j].append((k, i))
    reached: dict[str, int] = {}
    back: dict[str, int] = {}  # the first image that can be reached again from here on
    parts: list[tuple[str, ...]] = []
    for root in images:
        if root in reached:
            continue
        reached[root] = back[root] = len(reached)
        way, waiting = [(root, -1, iter(beside[root]))], [root]
        while way:
            image, by, others = way[-1]
            for k, other in others:
                if other not in reached:
                    reached[other] = back[other] = len(reached)
                    way.append((other, k, iter(beside[other])))
                    waiting.append(other)
                    break
                if k != by:
                    back[image] = min(back[image], reached[other])
            else:
                way.pop()
                if way:
                    back[way[-1][0]] = min(back[way[-1][0]], back[image])
                if back[image] == reached[image]:  # nothing beyond leads back before it
                    first = bisect_left(waiting, reached[image], key=reached.__getitem__)
                    parts.append(tuple(waiting[first:]))
                    del waiting[first:]
    return parts


def gap_candidates(
    order: Sequence[str],
    components: Sequence[Sequence[str]],
    tried: Collection[tuple[str, str]],
    *,
    max_gap: int,
) -> list[Candidate]:
    """Find pairs that could bridge a gap in a robot's chain: near in time but not connected.

    Parameters
    ----------
    order : sequence of str
        All image ids, robot by robot, in the order they were taken.
    components : sequence of sequences of str
        Images that hang together; images in none of them stand alone.
    tried : collection of (str, str)
        Pairs that were matched or rejected, in either order.
    max_gap : int
        Largest difference of place in the robot's sequence.

    Returns
    -------
    candidates : list of Candidate
        Nearest in time first.
    """
    part = {image: k for k, images in enumerate(components) for image in images}
    known = {frozenset(pair) for pair in tried}
    found = []
    for gap in range(1, max_gap + 1):
        for i, j in zip(order, order[gap:], strict=False):
            separate = part.get(i, i) != part.get(j, j)
            if robot_of(i) == robot_of(j) and separate and frozenset((i, j)) not in known:
                found.append(Candidate(i, j, 0.0))
    return found
