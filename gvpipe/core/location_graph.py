"""The location graph: images, the links between them, and the joint metric map they carry."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from gvpipe.core.adjustment import Adjusted, adjust, pose_covariances
from gvpipe.core.closure import Closure, closures
from gvpipe.core.consistency import Placements, agree
from gvpipe.core.ground import pixel_from_plane
from gvpipe.core.ground_bundle import Problem
from gvpipe.core.homography import apply, transfer_errors
from gvpipe.core.links import Link, robot_of
from gvpipe.core.placement import Placement, place, tuned_mounts
from gvpipe.core.pose import robot_from_camera, yaw_tilt_roll
from gvpipe.core.rig import Rig, centres, orientation
from gvpipe.core.tracks import Index, chain_matches
from gvpipe.core.types import Camera, Float, Mount, Pose

Mask = NDArray[np.bool_]

MIN_POINTS = 8
"""Matches below which a link is not used: four fix a homography, the rest must confirm it."""

TOLERANCE = 0.02
"""Share of the camera height by which two placements of the same ground may differ at least."""

TRUST = {"odometry": 4.0, "loop": 1.0, "overlap": 1.0}
"""Weight in the vote on contradictions: a robot's next picture nearly always shows the same
ground, while loops and overlaps are found by resemblance."""

FULL_TRUST_POINTS = 50.0
"""Matches at which a link has half the weight of one with very many."""

MAX_RELATIVE_MISFIT = 0.25
"""Misfit over extent above which matched points are not a motion over the ground."""

MAX_ERROR_PX = 3.0
"""Median transfer error of a link's matches under the map, above which the link is wrong."""

REVISIONS = 4
"""Rounds of adjusting the map and re-judging the links at most."""


@dataclass(frozen=True)
class MapOptions:
    """Priors of the adjustment.

    Attributes
    ----------
    tilt_sigma, roll_sigma : float
        Uncertainty of a robot's configured tilt and roll, radians.
    scale_sigma : float
        Relative uncertainty of a configured height, hence of the scale of the map.
    height_sigma : float or None
        Deviation of single pictures' heights from their robot's, metres; None: from the data.
    """

    tilt_sigma: float = float(np.radians(3.0))
    roll_sigma: float = float(np.radians(3.0))
    scale_sigma: float = 0.005
    height_sigma: float | None = None


@dataclass(frozen=True)
class PosedImage:
    """An image in the map.

    Attributes
    ----------
    map_from_camera : Pose
        Camera to map, metres.
    covariance : (6, 6) float64
        Of (rotation vector, translation): the true pose is ``exp(rotation vector) R`` and
        ``t + translation``, both in map axes; radians and metres.
    component : int
        Maps that are not connected have different numbers; 0 holds the reference.
    """

    map_from_camera: Pose
    covariance: Float
    component: int


@dataclass(frozen=True)
class JudgedLink:
    """What the map says about a link.

    Attributes
    ----------
    kept : bool
        Whether the map rests on it.
    residual_m : float or None
        Median distance on the ground between the two placements of its matches, metres; None
        where its images are not in one component.
    reason : str
        Why it was left out; empty if kept.
    """

    kept: bool
    residual_m: float | None
    reason: str


@dataclass(frozen=True)
class MapResult:
    """The joint map.

    Attributes
    ----------
    poses : dict of image id to PosedImage
        Registered images, in the given order.
    links : tuple of JudgedLink
        One for each link given, in the same order.
    components : tuple of tuples of image ids
        Maps that hang together; the first holds the reference.
    unregistered : tuple of (image id, reason)
        Images without a pose.
    closures : tuple of Closure
        Closing errors of the plain concatenation beside those of the map.
    """

    poses: dict[str, PosedImage]
    links: tuple[JudgedLink, ...]
    components: tuple[tuple[str, ...], ...]
    unregistered: tuple[tuple[str, str], ...]
    closures: tuple[Closure, ...]


def build_map(
    cameras: Mapping[str, Camera],
    mounts: Mapping[str, Mount],
    order: Sequence[str],
    links: Sequence[Link],
    reference: str,
    options: MapOptions,
) -> MapResult:
    """Pose all images of all robots in one metric map of the ground.

    Parameters
    ----------
    cameras, mounts : mapping of image id to Camera, Mount
        Intrinsics, and how each camera is held as far as configured.
    order : sequence of str
        All image ids, robot by robot, in the order they were taken.
    links : sequence of Link
        Matched images; some may be wrong.
    reference : str
        The map frame lies on the ground below this image's camera, x along its optical axis.
    options : MapOptions
        Priors.

    Returns
    -------
    result : MapResult

    Raises
    ------
    ValueError
        If `reference` or an image of a link is not in `order`.
    """
    graph = _Graph(cameras, mounts, order, links, reference, options)
    planar, keep = graph.first_guess()
    for _ in range(REVISIONS):
        parts = [graph.adjust_part(members, planar, keep) for members in graph.parts(keep)]
        revised = graph.judged(parts, keep)
        if (revised == keep).all():
            break
        planar, keep = graph.placed(parts, planar), revised
    return graph.result(parts, keep)


@dataclass(frozen=True)
class _Part:
    """An adjusted component: its images (the first one defines its frame) and their poses."""

    members: Index
    poses: list[Pose]
    covariances: Float
    adjusted: Adjusted | None


class _Graph:
    """The working state of :func:`build_map`, images and links by number."""

    def __init__(
        self,
        cameras: Mapping[str, Camera],
        mounts: Mapping[str, Mount],
        order: Sequence[str],
        links: Sequence[Link],
        reference: str,
        options: MapOptions,
    ) -> None:
        self.order, self.links, self.options = order, links, options
        index = {image: k for k, image in enumerate(order)}
        for image in (reference, *(x for link in links for x in (link.image_i, link.image_j))):
            if image not in index:
                raise ValueError(f"{image} is not among the images to map")
        self.reference = index[reference]
        self.ends = np.array(
            [(index[x.image_i], index[x.image_j]) for x in links], dtype=np.int64
        ).reshape(-1, 2)
        self.cameras = [cameras[image] for image in order]
        robots = {image: robot_of(image) for image in order}
        tuned = tuned_mounts(
            cameras,
            mounts,
            robots,
            [(x.image_i, x.image_j, x.points_i, x.points_j) for x in links],
        )
        self.mounts = [tuned[image] for image in order]
        names = list(dict.fromkeys(robots.values()))
        self.group = np.array([names.index(robots[image]) for image in order], dtype=np.int64)
        self.reasons = [""] * len(links)

    def first_guess(self) -> tuple[Float, Mask]:
        """Rough positions of all images, and the links that agree with them."""
        placed: list[Placement] = []
        usable = []
        for k, (i, j) in enumerate(self.ends):
            link = self.links[k]
            if len(link.points_i) < MIN_POINTS:
                self.reasons[k] = f"{len(link.points_i)} matches, fewer than {MIN_POINTS}"
                continue
            placement = place(
                link.points_i,
                link.points_j,
                (self.cameras[i], self.cameras[j]),
                (self.mounts[i], self.mounts[j]),
            )
            if placement is None or placement.radius <= 0:
                self.reasons[k] = "the matches do not lie on the ground before both cameras"
            elif placement.misfit > MAX_RELATIVE_MISFIT * placement.radius:
                self.reasons[k] = (
                    f"not a motion over the ground: matches miss by {placement.misfit:.3f} m "
                    f"over an extent of {placement.radius:.3f} m"
                )
            else:
                placed.append(placement)
                usable.append(k)
        used = np.array(usable, dtype=np.int64)
        planar, agrees = agree(self._placements(placed, used), len(self.order))
        keep = np.zeros(len(self.links), dtype=bool)
        keep[used] = agrees
        return planar, keep

    def _placements(self, placed: list[Placement], used: Index) -> Placements:
        i, j = self.ends[used].T
        floor = TOLERANCE * np.array([self.mounts[k].height for k in i])
        count = np.array([len(self.links[k].points_i) for k in used], dtype=np.float64)
        kind = np.array([TRUST[self.links[k].kind] for k in used])
        return Placements(
            i=i,
            j=j,
            centre_i=np.array([p.centre_i for p in placed]).reshape(-1, 2),
            centre_j=np.array([p.centre_j for p in placed]).reshape(-1, 2),
            turn=np.array([p.turn for p in placed]),
            radius=np.array([p.radius for p in placed]),
            tolerance=np.hypot(floor, [p.misfit for p in placed]),
            trust=kind * count / (count + FULL_TRUST_POINTS),
        )

    def parts(self, keep: Mask) -> list[Index]:
        """Connected components with at least two images, that of the reference first."""
        n = len(self.order)
        i, j = self.ends[keep].T
        _, label = connected_components(coo_matrix((np.ones(len(i)), (i, j)), (n, n)), False)
        home = label[self.reference]
        labels = [home, *(x for x in dict.fromkeys(label.tolist()) if x != home)]
        parts = [np.nonzero(label == x)[0] for x in labels]
        first = parts[0]
        parts[0] = np.append(self.reference, first[first != self.reference])
        return [p for k, p in enumerate(parts) if len(p) > 1 or (k == 0 and n == 1)]

    def adjust_part(self, members: Index, planar: Float, keep: Mask) -> _Part:
        """Adjust one component; its frame is that of its first member."""
        slot = np.full(len(self.order), -1, dtype=np.int64)
        slot[members] = np.arange(len(members))
        inside = np.nonzero(keep & (slot[self.ends] >= 0).all(axis=1))[0]
        robots, group = np.unique(self.group[members], return_inverse=True)
        rig = Rig(
            matrix=np.stack([self.cameras[k].matrix for k in members]),
            robot_from_camera=np.stack(
                [robot_from_camera(self.mounts[k]).rotation for k in members]
            ),
            height=np.array([self.mounts[k].height for k in members]),
            group=group.ravel().astype(np.int64),
        )
        start = np.zeros((len(members), 6))
        start[:, :3] = planar[members]
        start[:, :3] = _seen_from(start[0, :3], start[:, :3])
        if not len(inside):
            pose = _poses(rig, start)
            return _Part(members, pose, np.zeros((len(members), 6, 6)), None)
        tracks = chain_matches(
            [(int(slot[i]), int(slot[j])) for i, j in self.ends[inside]],
            [(self.links[k].points_i, self.links[k].points_j) for k in inside],
        )
        problem = Problem(rig, tracks, 0)
        o = self.options
        sigma = np.tile([o.tilt_sigma, o.roll_sigma, o.scale_sigma], (len(robots), 1))
        height_sigma = None if o.height_sigma is None else o.height_sigma / float(rig.height.mean())
        adjusted = adjust(problem, start, sigma, height_sigma)
        return _Part(
            members,
            _poses(rig, adjusted.state.cameras),
            pose_covariances(rig, adjusted, 0),
            adjusted,
        )

    def judged(self, parts: list[_Part], keep: Mask) -> Mask:
        """Links whose matches the adjusted map explains, whether it rests on them or not."""
        revised = keep.copy()
        pose = {
            int(k): (p, n) for n, part in enumerate(parts) for k, p in zip(part.members, part.poses)
        }
        for k, (i, j) in enumerate(self.ends):
            link = self.links[k]
            if len(link.points_i) < MIN_POINTS or int(i) not in pose or int(j) not in pose:
                continue
            (pose_i, part_i), (pose_j, part_j) = pose[int(i)], pose[int(j)]
            if part_i != part_j:
                continue
            homography = pixel_from_plane(self.cameras[j], pose_j) @ np.linalg.inv(
                pixel_from_plane(self.cameras[i], pose_i)
            )
            error = float(np.median(transfer_errors(homography, link.points_i, link.points_j)))
            revised[k] = error <= MAX_ERROR_PX
            self.reasons[k] = (
                "" if revised[k] else f"contradicts the map by {error:.1f} px (median)"
            )
        return revised

    def placed(self, parts: list[_Part], planar: Float) -> Float:
        """Positions and headings on the ground of the adjusted images, for another round."""
        out = planar.copy()
        for part in parts:
            for k, p in zip(part.members, part.poses, strict=True):
                # the frame the component had before stays its frame
                out[k] = [p.translation[0], p.translation[1], yaw_tilt_roll(p.rotation)[0]]
        return out

    def result(self, parts: list[_Part], keep: Mask) -> MapResult:
        """Gather poses, judged links and what could not be registered."""
        posed = {
            int(k): PosedImage(pose, covariance, number)
            for number, part in enumerate(parts)
            for k, pose, covariance in zip(part.members, part.poses, part.covariances, strict=True)
        }
        poses = {image: posed[k] for k, image in enumerate(self.order) if k in posed}
        links = tuple(
            JudgedLink(
                kept=bool(keep[k]),
                residual_m=self._residual_m(k, posed),
                reason="" if keep[k] else self.reasons[k] or "contradicts the other links",
            )
            for k in range(len(self.links))
        )
        touched = set(self.ends.ravel().tolist())
        unregistered = tuple(
            (
                image,
                "all its links contradict the others"
                if k in touched
                else "no link to another image",
            )
            for k, image in enumerate(self.order)
            if k not in posed
        )
        return MapResult(
            poses=poses,
            links=links,
            components=tuple(tuple(self.order[k] for k in sorted(p.members)) for p in parts),
            unregistered=unregistered,
            closures=closures(
                [link for link, good in zip(self.links, keep, strict=True) if good],
                {image: p.map_from_camera for image, p in poses.items()},
                dict(zip(self.order, self.cameras, strict=True)),
            ),
        )

    def _residual_m(self, k: int, posed: Mapping[int, PosedImage]) -> float | None:
        """Median distance between the two placements of a link's matches on the ground."""
        i, j = (int(x) for x in self.ends[k])
        link = self.links[k]
        if not (i in posed and j in posed and posed[i].component == posed[j].component):
            return None
        if not len(link.points_i):
            return None
        here, there = (
            apply(np.linalg.inv(pixel_from_plane(self.cameras[x], posed[x].map_from_camera)), p)
            for x, p in ((i, link.points_i), (j, link.points_j))
        )
        return float(np.median(np.linalg.norm(here - there, axis=1)))


def _seen_from(origin: Float, planar: Float) -> Float:
    """Positions and headings (N, 3) in the frame of one of them, (3,)."""
    c, s = np.cos(origin[2]), np.sin(origin[2])
    moved = (planar[:, :2] - origin[:2]) @ np.array([[c, -s], [s, c]])
    return np.column_stack([moved, planar[:, 2] - origin[2]])


def _poses(rig: Rig, cameras: Float) -> list[Pose]:
    """Poses in the frame below camera 0, x along its optical axis."""
    rotation = orientation(rig, cameras)[0].transpose(0, 2, 1)
    angle = -yaw_tilt_roll(rotation[0])[0]
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return [Pose(turn @ r, turn @ t) for r, t in zip(rotation, centres(rig, cameras), strict=True)]
