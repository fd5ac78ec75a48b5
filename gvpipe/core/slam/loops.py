"""Pairs of images worth matching, found from the growing map."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from gvpipe.core.geometry.ground import ground_points, pixel_from_plane
from gvpipe.core.geometry.homography import apply
from gvpipe.core.geometry.pose import mount_of, yaw_tilt_roll
from gvpipe.core.slam.links import robot_of
from gvpipe.core.types import Camera, Float, Pose

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
    linked: Collection[tuple[str, str]],
    *,
    min_share: float,
    max_per_image: int,
) -> list[Candidate]:
    """Image pairs whose footprints overlap in the map but which are not linked.

    Parameters
    ----------
    cameras : mapping of image id to Camera
        Intrinsics.
    poses : mapping of image id to Pose
        Camera to map, of the images of one component.
    linked : collection of (str, str)
        Pairs already matched or tried, in either order.
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
    seen = [_ground_seen(cameras[x], poses[x]) for x in images]
    centre = np.array([s.mean(axis=0) if len(s) else [np.inf, np.inf] for s in seen])
    reach = np.array(
        [np.linalg.norm(s - c, axis=1).max(initial=0.0) for s, c in zip(seen, centre, strict=True)]
    )
    finite = np.nonzero(np.isfinite(centre).all(axis=1))[0]
    if len(finite) < 2:
        return []
    near = cKDTree(centre[finite]).query_pairs(2.0 * float(reach.max()), output_type="ndarray")
    near = np.sort(finite[near], axis=1)
    apart = np.linalg.norm(centre[near[:, 0]] - centre[near[:, 1]], axis=1)
    near = near[apart < reach[near].sum(axis=1)]
    known = {frozenset(pair) for pair in linked}
    projections = [pixel_from_plane(cameras[x], poses[x]) for x in images]
    found = []
    for i, j in near[np.lexsort((near[:, 1], near[:, 0]))].tolist():
        if frozenset((images[i], images[j])) in known:
            continue
        share = min(
            _share(seen[i], cameras[images[j]], projections[j]),
            _share(seen[j], cameras[images[i]], projections[i]),
        )
        if share >= min_share:
            found.append(Candidate(images[i], images[j], share))
    found.sort(key=lambda c: (-c.share, c.image_i, c.image_j))
    return _thinned(found, max_per_image)


def _ground_seen(camera: Camera, pose: Pose) -> Float:
    """Ground points (S, 2) under a grid of pixels, as far as worth matching; map, metres."""
    u = (np.arange(COLUMNS) + 0.5) * camera.width / COLUMNS - 0.5
    v = (np.arange(ROWS) + 0.5) * camera.height / ROWS - 0.5
    pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    mount = mount_of(pose)
    ground, below = ground_points(pixels, camera, mount)
    near = below & (np.hypot(*ground.T) <= RANGE_HEIGHTS * mount.height)
    heading = yaw_tilt_roll(pose.rotation)[0]
    c, s = np.cos(heading), np.sin(heading)
    return np.asarray(ground[near] @ np.array([[c, s], [-s, c]]) + pose.translation[:2])


def _visible(ground: Float, camera: Camera, pixel_from_map: Float) -> Float:
    """Which ground points (S, 2) of the map project into an image, (S,) bool."""
    w = ground @ pixel_from_map[2, :2] + pixel_from_map[2, 2]
    pixel = apply(pixel_from_map, ground[w > 0])
    inside = w > 0
    inside[w > 0] = (
        (pixel >= -0.5) & (pixel <= np.array([camera.width, camera.height]) - 0.5)
    ).all(axis=1)
    return inside


def _share(ground: Float, camera: Camera, pixel_from_map: Float) -> float:
    """Share of ground points that an image sees."""
    return float(_visible(ground, camera, pixel_from_map).mean()) if len(ground) else 0.0


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


def gap_candidates(
    order: Sequence[str],
    components: Sequence[Sequence[str]],
    linked: Collection[tuple[str, str]],
    *,
    max_gap: int,
) -> list[Candidate]:
    """Pairs that could bridge a gap in a robot's chain: near in time but not connected.

    Parameters
    ----------
    order : sequence of str
        All image ids, robot by robot, in the order they were taken.
    components : sequence of sequences of str
        Images that hang together; images in none of them stand alone.
    linked : collection of (str, str)
        Pairs already matched or tried, in either order.
    max_gap : int
        Largest difference of place in the robot's sequence.

    Returns
    -------
    candidates : list of Candidate
        Nearest in time first.
    """
    part = {image: k for k, images in enumerate(components) for image in images}
    known = {frozenset(pair) for pair in linked}
    found = []
    for gap in range(1, max_gap + 1):
        for i, j in zip(order, order[gap:], strict=False):
            separate = part.get(i, i) != part.get(j, j)
            if robot_of(i) == robot_of(j) and separate and frozenset((i, j)) not in known:
                found.append(Candidate(i, j, 0.0))
    return found
