"""One connected part of the map: its cameras adjusted in a frame of their own."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gvpipe.core.geometry.ground import calibrations, pixel_from_plane
from gvpipe.core.geometry.pose import about_z, rotation_matrix, upright, yaw_tilt_roll
from gvpipe.core.slam.adjustment import adjust, approach, begin, fixed_by, pose_covariances
from gvpipe.core.slam.control import Control
from gvpipe.core.slam.correlation import judged_links, shared_errors
from gvpipe.core.slam.ground_bundle import Problem
from gvpipe.core.slam.links import LinkSet
from gvpipe.core.slam.rig import Rig, camera_from_map, centres
from gvpipe.core.slam.tracks import Tracks, cell_tracks, chain_matches
from gvpipe.core.types import Camera, Float, Index, Mount, Pose

UNKNOWN_TILT_SIGMA = float(np.radians(30.0))
"""Uncertainty of a tilt that was not configured, radians: next to nothing is known."""

MANY_MATCHES = 200_000
"""Matches of a component above which they are summed up before it is adjusted: about a thousand
pictures. Below, every corner counts by itself, and once however many links share it."""

WELL_SEEN = 3.0
"""Camera heights to which the ground counts as the middle of the picture at most."""


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
class Views:
    """The images of a map by number.

    Attributes
    ----------
    cameras, mounts : sequence of Camera, sequence of Mount
        Intrinsics, and how each camera is expected to be held.
    held : sequence of Mount
        Starting values of how each was held.
    group : (N,) int64
        Number of the robot of each image.
    """

    cameras: Sequence[Camera]
    mounts: Sequence[Mount]
    held: Sequence[Mount]
    group: Index


@dataclass(frozen=True)
class Part:
    """An adjusted component.

    Attributes
    ----------
    members : (M,) int64
        Its images; the frame lies below the first one, x along its optical axis, or is that of
        the known ground points.
    poses : list of Pose
        Camera to that frame.
    covariances : (M, 6, 6) float64
        Of (rotation vector, translation).
    tracks : Tracks
        What the adjustment rests on; its cameras are numbers within `members`.
    points : (T, 2) float64
        Ground points of the tracks in the component's frame, metres.
    fixed : bool
        Whether known ground points fix frame and scale.
    """

    members: Index
    poses: list[Pose]
    covariances: Float
    tracks: Tracks
    points: Float
    fixed: bool = False


def adjust_part(
    views: Views,
    members: Index,
    linked: LinkSet,
    planar: Float,
    options: MapOptions,
    control: Control,
    *,
    rough: bool = False,
) -> Part:
    """Adjust the cameras of one component.

    Parameters
    ----------
    views : Views
        All images.
    members : (M,) int64
        Images of the component, the one that defines its frame first.
    linked : LinkSet
        Links between them, which connect them all.
    planar : (N, 3) float64
        Position and heading of every image, in any common frame.
    options : MapOptions
        Priors.
    control : Control
        Known ground points; its cameras are numbers of images.
    rough : bool
        Only find out where everything is, from rough positions: no variances are judged,
        covariances are zero, and known points wait. Otherwise `views` and `planar` must be what a
        rough adjustment has found.

    Returns
    -------
    part : Part
    """
    rig = _rig(views, members)
    start = _start(rig, [views.held[k] for k in members.tolist()], planar[members])
    slot = np.full(len(planar), -1)
    slot[members] = np.arange(len(members))
    tracks = _tracks(slot[linked.ends], linked)
    none = np.zeros((len(members), 6, 6))
    if not linked.links:
        return Part(members, _poses(rig, start, _turn(rig, start)), none, tracks, np.empty((0, 2)))
    problem = Problem(rig, tracks, 0, where=_looked_at(rig, start))
    mean_sigma = _mean_sigma(views, members, rig.group, options)
    height_sigma = (
        None if options.height_sigma is None else options.height_sigma / float(rig.height.mean())
    )
    adjusted = begin(problem, start, mean_sigma, height_sigma)
    if rough:
        state = approach(problem, adjusted).state
        poses = _poses(rig, state.cameras, _turn(rig, state.cameras))
        return Part(members, poses, none, tracks, state.points)
    adjusted = adjust(problem, adjusted, height_sigma)
    own = _own(control, slot)
    turn = _turn(rig, adjusted.state.cameras)
    if own.fixes_the_map:
        adjusted, problem = fixed_by(adjusted, problem, own)
        turn = np.eye(3)
    poses = _poses(rig, adjusted.state.cameras, turn)
    shared = _shared(views, members, poses, slot, linked)
    return Part(
        members,
        poses,
        pose_covariances(problem, adjusted, 0, shared),
        tracks,
        adjusted.state.points @ turn[:2, :2].T,
        own.fixes_the_map,
    )


def _rig(views: Views, members: Index) -> Rig:
    """Gather what is known of the cameras of a component."""
    _, group = np.unique(views.group[members], return_inverse=True)
    mounts = [views.mounts[k] for k in members.tolist()]
    return Rig(
        matrix=calibrations([views.cameras[k] for k in members.tolist()]),
        robot_from_camera=_upright(mounts),
        height=np.array([mount.height for mount in mounts]),
        group=group.ravel().astype(np.int64),
    )


def _shared(views: Views, members: Index, poses: list[Pose], slot: Index, linked: LinkSet) -> float:
    """How much the errors of matches have in common, from some of the links."""

    def pixel_from_map(k: int) -> Float:
        return pixel_from_plane(views.cameras[members[k]], poses[k])

    some = judged_links(len(linked.links))
    ends = slot[linked.ends[some]].tolist()
    return shared_errors(
        (pixel_from_map(j) @ np.linalg.inv(pixel_from_map(i)), link.points_i, link.points_j)
        for (i, j), link in zip(ends, linked.links[some], strict=True)
    )


def _tracks(ends: Index, linked: LinkSet) -> Tracks:
    """Chain matches to points, or sum them up if there are too many."""
    if linked.matches.count[linked.number].sum() <= MANY_MATCHES:
        pairs = [(int(i), int(j)) for i, j in ends]
        return chain_matches(pairs, [(link.points_i, link.points_j) for link in linked.links])
    homographies = np.array([link.homography for link in linked.links])
    return cell_tracks(ends, linked.matches, linked.number, homographies)


def _own(control: Control, slot: Index) -> Control:
    """Known points in images of a component, with their numbers within it."""
    which = slot[control.camera] >= 0
    return Control(slot[control.camera[which]], control.pixel[which], control.position[which])


def _upright(mounts: Sequence[Mount]) -> Float:
    """Orientations (M, 3, 3) of cameras in their robots' frames."""
    return upright(np.array([m.tilt for m in mounts]), np.array([m.roll for m in mounts]))


def _mean_sigma(views: Views, members: Index, group: Index, options: MapOptions) -> Float:
    """Uncertainty (G, 3) of each robot's configured leans and height."""
    robots = int(group.max()) + 1
    sigma = np.tile([options.tilt_sigma, options.roll_sigma, options.scale_sigma], (robots, 1))
    for k, g in zip(members.tolist(), group.tolist(), strict=True):
        if not views.mounts[k].tilt_known:
            sigma[g, 0] = UNKNOWN_TILT_SIGMA
    return sigma


def _start(rig: Rig, held: Sequence[Mount], planar: Float) -> Float:
    """Set up the unknowns (M, 6) of the adjustment, in the frame of the first robot."""
    start = np.zeros((len(held), 6))
    start[:, :3] = _seen_from(planar[0], planar)
    # as a turn about a level axis, then a heading: what lies upright tells the axis
    turned = _upright(held) @ rig.robot_from_camera.transpose(0, 2, 1)
    up = turned[:, 2]
    sine = np.hypot(up[:, 0], up[:, 1])
    angle = np.arctan2(sine, up[:, 2]) / np.maximum(sine, 1e-12)
    level = np.column_stack([up[:, 1], -up[:, 0], np.zeros(len(up))]) * angle[:, None]
    heading = turned @ rotation_matrix(-level)
    start[:, 2] += np.arctan2(heading[:, 1, 0], heading[:, 0, 0])
    start[:, 3:5] = level[:, 1::-1]
    start[:, 5] = np.log([m.height for m in held] / rig.height)
    # the first camera's heading is held at zero
    start[:, :3] = _seen_from(start[0, :3], start[:, :3])
    return start


def _seen_from(origin: Float, planar: Float) -> Float:
    """Positions and headings (N, 3) in the frame of one of them, (3,)."""
    c, s = np.cos(origin[2]), np.sin(origin[2])
    moved = (planar[:, :2] - origin[:2]) @ np.array([[c, -s], [s, c]])
    return np.column_stack([moved, planar[:, 2] - origin[2]])


def _looked_at(rig: Rig, cameras: Float) -> Float:
    """Ground (N, 2) in the middle of what each camera sees well: what is linked lies near."""
    axis = camera_from_map(rig, cameras)[:, 2]
    reach = np.minimum(-1.0 / np.minimum(axis[:, 2], -1e-9), WELL_SEEN)
    return np.asarray(cameras[:, :2] + axis[:, :2] * (reach * rig.height)[:, None])


def _turn(rig: Rig, cameras: Float) -> Float:
    """Rotation (3, 3) about the vertical that brings the axis of camera 0 to x."""
    return about_z(-yaw_tilt_roll(camera_from_map(rig, cameras)[0].T)[0])


def _poses(rig: Rig, cameras: Float, turn: Float) -> list[Pose]:
    """Poses in a frame turned about the vertical."""
    map_from_camera = camera_from_map(rig, cameras).transpose(0, 2, 1)
    return [
        Pose(turn @ rotation, turn @ centre)
        for rotation, centre in zip(map_from_camera, centres(rig, cameras), strict=True)
    ]
