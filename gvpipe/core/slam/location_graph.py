"""The location graph: images, the links between them, and the joint metric map they carry."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from gvpipe.core.geometry.ground import calibrations, pixels_from_plane
from gvpipe.core.geometry.pose import yaw_tilt_roll
from gvpipe.core.slam.control import Control
from gvpipe.core.slam.holding import MIN_POINTS, hold
from gvpipe.core.slam.links import Link, LinkSet, robot_of
from gvpipe.core.slam.map_part import MapOptions, Part, Views, adjust_part
from gvpipe.core.slam.map_result import Gathered, MapResult, SeenGround
from gvpipe.core.slam.screening import screen
from gvpipe.core.slam.transfer import median_errors
from gvpipe.core.types import Camera, Float, Index, Mount

__all__ = [
    "ControlPoint",
    "MapOptions",
    "MapResult",
    "SeenGround",
    "build_map",
]

MIN_LIMIT_PX, MAX_LIMIT_PX = 1.0, 3.0
STRAY = 5.0
"""A link is wrong if the median transfer error of its matches under the map is above this many
times that of the usual link, within these bounds in pixels."""

REVISIONS = 5
"""Rounds of adjusting the map and judging the links by it, at most; the first is a rough one."""


@dataclass(frozen=True)
class ControlPoint:
    """A ground point whose place is known.

    Attributes
    ----------
    image : str
        Image that shows it.
    pixel : (float, float)
        Where, undistorted.
    position : (float, float)
        In the site frame, metres.
    """

    image: str
    pixel: tuple[float, float]
    position: tuple[float, float]


def build_map(
    cameras: Mapping[str, Camera],
    mounts: Mapping[str, Mount],
    order: Sequence[str],
    links: Sequence[Link],
    reference: str,
    options: MapOptions,
    control: Sequence[ControlPoint] = (),
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
    control : sequence of ControlPoint
        Known ground points; a component that shows two of them lies in their frame and scale.

    Returns
    -------
    result : MapResult

    Raises
    ------
    ValueError
        If `reference`, or an image of a link or a known point, is not in `order`.
    """
    named = [x for link in links for x in (link.image_i, link.image_j)]
    index = _index(order, (reference, *named, *(point.image for point in control)))
    linked, group = LinkSet.of(links, order), _robots(order)
    ends = linked.ends
    held = hold(linked, [cameras[x] for x in order], [mounts[x] for x in order], group)
    usable = np.array([not reason for reason in held.reasons], dtype=bool)
    views = Views([cameras[x] for x in order], held.expected, held.mounts, group)
    screened = screen(linked, usable, views.cameras, views.held)
    planar, keep = screened.planar, screened.keep
    known = _numbered(control, index)
    enough = linked.matches.count >= MIN_POINTS
    parts: list[Part] = []
    for revision in range(REVISIONS):
        parts = [
            adjust_part(
                views,
                members,
                linked.pick(np.nonzero(keep & np.isin(ends, members).all(axis=1))[0]),
                planar,
                options,
                known,
                rough=revision == 0,
            )
            for members in _connected(len(order), index[reference], ends[keep])
        ]
        errors_px, distances_m = _errors(views, parts, linked)
        known_px = np.where(enough, errors_px, np.nan)
        revised = np.where(np.isnan(known_px), keep, known_px <= _limit_px(known_px[keep]))
        if ((revised == keep).all() and revision > 0) or revision == REVISIONS - 1:
            break  # what is reported is what the map rests on, though it may not have settled
        views, planar = _started(parts, views, planar)
        keep = revised
    judged = Gathered(order, views, parts, ends, links, keep, known_px, distances_m)
    return judged.result(held.reasons)


def _index(order: Sequence[str], named: Sequence[str]) -> dict[str, int]:
    """Return the number of each image; the named ones must be among them."""
    index = {image: k for k, image in enumerate(order)}
    for image in named:
        if image not in index:
            raise ValueError(f"{image} is not among the images to map")
    return index


def _numbered(control: Sequence[ControlPoint], index: Mapping[str, int]) -> Control:
    """Lay known points out as arrays."""
    return Control(
        camera=np.array([index[p.image] for p in control], dtype=np.int64),
        pixel=np.array([p.pixel for p in control], dtype=np.float64).reshape(-1, 2),
        position=np.array([p.position for p in control], dtype=np.float64).reshape(-1, 2),
    )


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


def _errors(views: Views, parts: list[Part], linked: LinkSet) -> tuple[Float, Float]:
    """Median error of each link under the map, pixels and metres; NaN where it cannot tell."""
    ends, matches = linked.ends, linked.matches
    part_of = np.full(len(views.group), -1, dtype=np.int64)
    plane = np.tile(np.eye(3), (len(views.group), 1, 1))
    matrix = calibrations(views.cameras)
    for number, part in enumerate(parts):
        part_of[part.members] = number
        rotation = np.array([p.rotation for p in part.poses])
        translation = np.array([p.translation for p in part.poses])
        plane[part.members] = pixels_from_plane(matrix[part.members], rotation, translation)
    together = (part_of[ends[:, 0]] == part_of[ends[:, 1]]) & (part_of[ends[:, 0]] >= 0)
    which = np.nonzero(together & (matches.count > 0))[0]
    ground = np.asarray(np.linalg.inv(plane), dtype=np.float64)
    errors_px, distances_m = np.full(len(ends), np.nan), np.full(len(ends), np.nan)
    errors_px[which], distances_m[which] = median_errors(matches, ends, ground, which)
    return errors_px, distances_m


def _limit_px(errors_px: Float) -> float:
    """Median transfer error above which a link is wrong, from those of the kept links."""
    known = errors_px[np.isfinite(errors_px)]
    usual = float(np.median(known)) if len(known) else MAX_LIMIT_PX
    return float(np.clip(STRAY * usual, MIN_LIMIT_PX, MAX_LIMIT_PX))


def _started(parts: list[Part], views: Views, planar: Float) -> tuple[Views, Float]:
    """Take what was adjusted as the start of the next adjustment; each part in its own frame."""
    out, held = planar.copy(), list(views.held)
    for part in parts:
        for k, p in zip(part.members.tolist(), part.poses, strict=True):
            yaw, tilt, roll = yaw_tilt_roll(p.rotation)
            out[k] = [p.translation[0], p.translation[1], yaw]
            held[k] = replace(held[k], tilt=tilt, roll=roll, height=float(p.translation[2]))
    return replace(views, held=held), out
