"""The location graph: images, the links between them, and the joint metric map they carry."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from gvpipe.core.closure import Closure, closures
from gvpipe.core.consistency import Mask
from gvpipe.core.holding import MIN_POINTS, hold
from gvpipe.core.links import Link, robot_of
from gvpipe.core.map_part import MapOptions, Part, Views, adjust_part
from gvpipe.core.pose import yaw_tilt_roll
from gvpipe.core.screening import screen
from gvpipe.core.tracks import Index, Tracks
from gvpipe.core.transfer import median_error_px, residual_m
from gvpipe.core.types import Camera, Float, Mount, Pose

__all__ = ["JudgedLink", "Link", "MapOptions", "MapResult", "PosedImage", "SeenGround", "build_map"]

MIN_LIMIT_PX, MAX_LIMIT_PX = 1.0, 3.0
STRAY = 5.0
"""A link is wrong if the median transfer error of its matches under the map is above this many
times that of the usual link, within these bounds in pixels."""

REVISIONS = 4
"""Rounds of adjusting the map and judging the links by it, at most."""


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
class SeenGround:
    """Ground points of one component, and where they were seen.

    Attributes
    ----------
    images : tuple of image ids
        What the cameras of the tracks stand for.
    tracks : Tracks
        Observed pixels.
    points : (T, 2) float64
        In the map, metres.
    """

    images: tuple[str, ...]
    tracks: Tracks
    points: Float


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
        Maps that hang together; the first holds the reference if that is linked to anything.
    unregistered : tuple of (image id, reason)
        Images without a pose.
    closures : tuple of Closure
        Closing errors of the plain concatenation beside those of the map.
    ground : tuple of SeenGround
        What each component rests on.
    """

    poses: dict[str, PosedImage]
    links: tuple[JudgedLink, ...]
    components: tuple[tuple[str, ...], ...]
    unregistered: tuple[tuple[str, str], ...]
    closures: tuple[Closure, ...]
    ground: tuple[SeenGround, ...]


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
    index = {image: k for k, image in enumerate(order)}
    for image in (reference, *(x for link in links for x in (link.image_i, link.image_j))):
        if image not in index:
            raise ValueError(f"{image} is not among the images to map")
    ends = np.array([(index[x.image_i], index[x.image_j]) for x in links], dtype=np.int64)
    ends = ends.reshape(-1, 2)
    group = _robots(order)
    held = hold(links, ends, [cameras[x] for x in order], [mounts[x] for x in order], group)
    usable = np.array([not reason for reason in held.reasons], dtype=bool)
    views = Views([cameras[x] for x in order], held.expected, held.mounts, group)
    screened = screen(links, ends, usable, views.cameras, views.held)
    planar, keep = screened.planar, screened.keep
    parts: list[Part] = []
    for _ in range(REVISIONS):
        parts = [
            adjust_part(views, members, _inside(members, ends, links, keep), planar, options)
            for members in _connected(len(order), index[reference], ends[keep])
        ]
        errors_px = _errors_px(views, parts, ends, links)
        revised = np.where(np.isnan(errors_px), keep, errors_px <= _limit_px(errors_px[keep]))
        if (revised == keep).all():
            break
        planar, keep = _planar(parts, planar), revised
    return _Gathered(order, views, parts, ends, links, keep).result(held.reasons, errors_px)


def _robots(order: Sequence[str]) -> Index:
    """Return the number of the robot of each image, (N,)."""
    names: dict[str, int] = {}
    return np.array([names.setdefault(robot_of(x), len(names)) for x in order], dtype=np.int64)


def _connected(count: int, reference: int, ends: Index) -> list[Index]:
    """Components of two images or more, the reference's first and the reference first in it."""
    i, j = ends.T
    graph = coo_matrix((np.ones(len(i)), (i, j)), (count, count))
    _, label = connected_components(graph, directed=False)
    home = int(label[reference])
    others = [x for x in dict.fromkeys(label.tolist()) if x != home]
    parts = [np.nonzero(label == x)[0].astype(np.int64) for x in (home, *others)]
    parts[0] = np.append(reference, parts[0][parts[0] != reference])
    return [part for part in parts if len(part) > 1 or count == 1]


def _inside(
    members: Index, ends: Index, links: Sequence[Link], keep: Mask
) -> list[tuple[int, int, Link]]:
    """Kept links between images of a component, with their images' numbers."""
    which = np.nonzero(keep & np.isin(ends, members).all(axis=1))[0]
    return [(int(ends[k, 0]), int(ends[k, 1]), links[k]) for k in which.tolist()]


def _errors_px(views: Views, parts: list[Part], ends: Index, links: Sequence[Link]) -> Float:
    """Median transfer error of each link under the map; NaN where the map cannot tell."""
    pose = {
        int(k): (number, p)
        for number, part in enumerate(parts)
        for k, p in zip(part.members, part.poses, strict=True)
    }
    errors = np.full(len(links), np.nan)
    for k, (i, j) in enumerate(ends.tolist()):
        if len(links[k].points_i) >= MIN_POINTS and i in pose and j in pose:
            (part_i, pose_i), (part_j, pose_j) = pose[i], pose[j]
            if part_i == part_j:
                cameras = views.cameras[i], views.cameras[j]
                errors[k] = median_error_px(links[k], cameras, (pose_i, pose_j))
    return errors


def _limit_px(errors_px: Float) -> float:
    """Median transfer error above which a link is wrong, from those of the kept links."""
    known = errors_px[np.isfinite(errors_px)]
    usual = float(np.median(known)) if len(known) else MAX_LIMIT_PX
    return float(np.clip(STRAY * usual, MIN_LIMIT_PX, MAX_LIMIT_PX))


def _planar(parts: list[Part], planar: Float) -> Float:
    """Positions and headings of the adjusted images, each component in its own frame."""
    out = planar.copy()
    for part in parts:
        for k, p in zip(part.members, part.poses, strict=True):
            out[k] = [p.translation[0], p.translation[1], yaw_tilt_roll(p.rotation)[0]]
    return out


@dataclass(frozen=True)
class _Gathered:
    """Everything :func:`build_map` knows at its end, to be told by image and by link."""

    order: Sequence[str]
    views: Views
    parts: list[Part]
    ends: Index
    links: Sequence[Link]
    keep: Mask

    def result(self, reasons: list[str], errors_px: Float) -> MapResult:
        """Gather poses, judged links and what could not be registered."""
        posed = {
            int(k): PosedImage(pose, covariance, number)
            for number, part in enumerate(self.parts)
            for k, pose, covariance in zip(part.members, part.poses, part.covariances, strict=True)
        }
        poses = {image: posed[k] for k, image in enumerate(self.order) if k in posed}
        return MapResult(
            poses=poses,
            links=tuple(
                self._judged(k, posed, reasons[k], float(errors_px[k]))
                for k in range(len(self.links))
            ),
            components=tuple(
                tuple(self.order[k] for k in np.sort(part.members).tolist()) for part in self.parts
            ),
            unregistered=self._unregistered(posed),
            closures=closures(
                [link for link, kept in zip(self.links, self.keep, strict=True) if kept],
                {image: p.map_from_camera for image, p in poses.items()},
                dict(zip(self.order, self.views.cameras, strict=True)),
            ),
            ground=tuple(
                SeenGround(
                    tuple(self.order[k] for k in part.members.tolist()), part.tracks, part.points
                )
                for part in self.parts
            ),
        )

    def _judged(
        self, k: int, posed: Mapping[int, PosedImage], reason: str, error_px: float
    ) -> JudgedLink:
        """Say what the map makes of link k."""
        i, j = self.ends[k].tolist()
        together = i in posed and j in posed and posed[i].component == posed[j].component
        residual = None
        if together and len(self.links[k].points_i):
            residual = residual_m(
                self.links[k],
                (self.views.cameras[i], self.views.cameras[j]),
                (posed[i].map_from_camera, posed[j].map_from_camera),
            )
        if self.keep[k]:
            return JudgedLink(True, residual, "")
        if not reason and np.isfinite(error_px):
            reason = f"contradicts the map: its matches miss by {error_px:.1f} px (median)"
        return JudgedLink(False, residual, reason or "contradicts the other links")

    def _unregistered(self, posed: Mapping[int, PosedImage]) -> tuple[tuple[str, str], ...]:
        """Images without a pose, and why."""
        touched = set(self.ends.ravel().tolist())
        why = {True: "none of its links can be used", False: "no link to another image"}
        return tuple(
            (image, why[k in touched]) for k, image in enumerate(self.order) if k not in posed
        )
