"""One connected part of the map: its cameras adjusted in a frame of their own."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gvpipe.core.adjustment import adjust, pose_covariances
from gvpipe.core.ground_bundle import Problem
from gvpipe.core.links import Link
from gvpipe.core.pose import robot_from_camera, yaw_tilt_roll
from gvpipe.core.rig import Rig, centres, orientation
from gvpipe.core.tracks import Index, chain_matches
from gvpipe.core.types import Camera, Float, Mount, Pose


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
        Intrinsics, and starting values of how each camera is held.
    group : (N,) int64
        Number of the robot of each image.
    """

    cameras: Sequence[Camera]
    mounts: Sequence[Mount]
    group: Index


@dataclass(frozen=True)
class Part:
    """An adjusted component.

    Attributes
    ----------
    members : (M,) int64
        Its images; the frame lies below the first one, x along its optical axis.
    poses : list of Pose
        Camera to that frame.
    covariances : (M, 6, 6) float64
        Of (rotation vector, translation).
    """

    members: Index
    poses: list[Pose]
    covariances: Float


def adjust_part(
    views: Views,
    members: Index,
    links: Sequence[tuple[int, int, Link]],
    planar: Float,
    options: MapOptions,
) -> Part:
    """Adjust the cameras of one component.

    Parameters
    ----------
    views : Views
        All images.
    members : (M,) int64
        Images of the component, the one that defines its frame first.
    links : sequence of (image i, image j, Link)
        Links between them, which connect them all.
    planar : (N, 3) float64
        Rough position and heading of every image, in any common frame.
    options : MapOptions
        Priors.

    Returns
    -------
    part : Part
    """
    robots, group = np.unique(views.group[members], return_inverse=True)
    rig = Rig(
        matrix=np.stack([views.cameras[k].matrix for k in members.tolist()]),
        robot_from_camera=np.stack(
            [robot_from_camera(views.mounts[k]).rotation for k in members.tolist()]
        ),
        height=np.array([views.mounts[k].height for k in members.tolist()]),
        group=group.ravel().astype(np.int64),
    )
    start = np.zeros((len(members), 6))
    start[:, :3] = _seen_from(planar[members[0]], planar[members])
    if not links:
        return Part(members, _poses(rig, start), np.zeros((len(members), 6, 6)))
    slot = {int(k): n for n, k in enumerate(members)}
    tracks = chain_matches(
        [(slot[i], slot[j]) for i, j, _ in links],
        [(link.points_i, link.points_j) for _, _, link in links],
    )
    sigma = [options.tilt_sigma, options.roll_sigma, options.scale_sigma]
    adjusted = adjust(
        Problem(rig, tracks, 0),
        start,
        np.tile(sigma, (len(robots), 1)),
        None if options.height_sigma is None else options.height_sigma / float(rig.height.mean()),
    )
    return Part(members, _poses(rig, adjusted.state.cameras), pose_covariances(rig, adjusted, 0))


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
