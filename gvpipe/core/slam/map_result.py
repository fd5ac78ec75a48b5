"""What the joint map says of every image and every link."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gvpipe.core.slam.closure import Closure, closures
from gvpipe.core.slam.links import Link
from gvpipe.core.slam.map_part import Part, Views
from gvpipe.core.slam.tracks import Tracks
from gvpipe.core.types import Float, Index, Mask, Pose


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
    fixed : bool
        Whether known ground points fix the component's frame and scale.
    """

    images: tuple[str, ...]
    tracks: Tracks
    points: Float
    fixed: bool


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

    def confirmed_by(self, more: "MapResult") -> bool:
        """Whether a map with more links after these keeps the same ones, and joins nothing else."""
        same = all(a.kept == b.kept for a, b in zip(self.links, more.links, strict=False))
        return same and self.components == more.components


@dataclass(frozen=True)
class Gathered:
    """Everything known when the map stands, to be told by image and by link.

    Attributes
    ----------
    order : sequence of str
        Image ids by number.
    views : Views
        The images.
    parts : list of Part
        Components, that of the reference first.
    ends : (E, 2) int64
        Numbers of the images of each link.
    links : sequence of Link
        All links, used or not.
    keep : (E,) bool
        Those that the map rests on.
    errors_px, distances_m : (E,) float64
        Median error of each link's matches under the map, in image j and on the ground; NaN
        where the map cannot tell.
    """

    order: Sequence[str]
    views: Views
    parts: list[Part]
    ends: Index
    links: Sequence[Link]
    keep: Mask
    errors_px: Float
    distances_m: Float

    def result(self, reasons: list[str]) -> MapResult:
        """Gather poses, judged links and what could not be registered."""
        posed = {
            int(k): PosedImage(pose, covariance, number)
            for number, part in enumerate(self.parts)
            for k, pose, covariance in zip(part.members, part.poses, part.covariances, strict=True)
        }
        poses = {image: posed[k] for k, image in enumerate(self.order) if k in posed}
        return MapResult(
            poses=poses,
            links=tuple(self._judged(k, reasons[k]) for k in range(len(self.links))),
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
                    tuple(self.order[k] for k in part.members.tolist()),
                    part.tracks,
                    part.points,
                    part.fixed,
                )
                for part in self.parts
            ),
        )

    def _judged(self, k: int, reason: str) -> JudgedLink:
        """Say what the map makes of link k."""
        error_px, distance_m = float(self.errors_px[k]), float(self.distances_m[k])
        residual = None if np.isnan(distance_m) else distance_m
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
