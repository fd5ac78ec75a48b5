"""Orientation of a camera over the ground: tilt, roll and yaw from and to rotation matrices."""

from collections.abc import Sequence

import numpy as np

from gvpipe.core.types import Float, Mount, Pose


def robot_from_camera(mount: Mount) -> Pose:
    """Pose of the camera in the robot frame (x forward, y left, z up, on the ground below it).

    Parameters
    ----------
    mount : Mount
        Tilt and roll in radians, height in metres.

    Returns
    -------
    robot_from_camera : Pose
        Takes camera coordinates (x right, y down, z ahead) to robot coordinates, metres.

    Notes
    -----
    The optical axis becomes ``(cos tilt, 0, -sin tilt)``. Roll turns the camera about its optical
    axis first, clockwise seen from behind: from x (right) towards y (down).
    """
    [rotation] = upright(np.array([mount.tilt]), np.array([mount.roll]))
    return Pose(rotation, np.array([0.0, 0.0, mount.height]))


def upright(tilt: Float, roll: Float) -> Float:
    """Rotations (N, 3, 3) of :func:`robot_from_camera` of tilts and rolls (N,), radians."""
    c, s, cr, sr = np.cos(tilt), np.sin(tilt), np.cos(roll), np.sin(roll)
    out = np.zeros((len(tilt), 3, 3))
    out[:, 0, 0], out[:, 0, 1], out[:, 0, 2] = -s * sr, -s * cr, c
    out[:, 1, 0], out[:, 1, 1] = -cr, sr
    out[:, 2, 0], out[:, 2, 1], out[:, 2, 2] = -c * sr, -c * cr, -s
    return out


def yaw_tilt_roll(map_from_camera: Float) -> tuple[float, float, float]:
    """Split a camera's rotation into yaw, tilt and roll.

    Parameters
    ----------
    map_from_camera : (3, 3) float64
        Rotation from camera axes to a frame whose z axis points up.

    Returns
    -------
    yaw : float
        Heading of the optical axis on the ground, radians, counter-clockwise seen from above.
        Straight down, yaw and roll coincide; roll is then reported as 0.
    tilt : float
        Radians below the horizon.
    roll : float
        Radians, clockwise seen from behind the camera.
    """
    axis = map_from_camera[:, 2]
    tilt = float(np.arctan2(-axis[2], np.hypot(axis[0], axis[1])))
    if np.hypot(axis[0], axis[1]) < 1e-9:
        # y down of the image then points backwards: (-cos yaw, -sin yaw, 0)
        return (
            float(np.arctan2(-map_from_camera[1, 1], -map_from_camera[0, 1])),
            tilt,
            0.0,
        )
    yaw = float(np.arctan2(axis[1], axis[0]))
    # row 3 of the rotation is (-cos tilt sin roll, -cos tilt cos roll, -sin tilt)
    roll = float(np.arctan2(-map_from_camera[2, 0], -map_from_camera[2, 1]))
    return yaw, tilt, roll


def about_z(angle: float) -> Float:
    """Rotation matrix (3, 3) by an angle about the z axis, radians, from x towards y."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def planar_pose(x: float, y: float, yaw: float, mount: Mount) -> Pose:
    """Pose in the map of a camera carried by a robot at (x, y) with the given heading.

    Parameters
    ----------
    x, y : float
        Position of the robot on the ground, metres.
    yaw : float
        Heading, radians, counter-clockwise seen from above.
    mount : Mount
        How the robot holds the camera.

    Returns
    -------
    map_from_camera : Pose
        Camera to map, metres.
    """
    map_from_robot = Pose(about_z(yaw), np.array([x, y, 0.0]))
    return map_from_robot @ robot_from_camera(mount)


def mount_of(map_from_camera: Pose) -> Mount:
    """Tilt, roll and height of a camera whose pose in a ground frame (z = 0, up) is known."""
    _, tilt, roll = yaw_tilt_roll(map_from_camera.rotation)
    return Mount(tilt=tilt, roll=roll, height=float(map_from_camera.translation[2]))


def rotation_vector(rotation: Float) -> Float:
    """Axis times angle, (3,) radians, of a rotation matrix."""
    from scipy.spatial.transform import Rotation  # takes long to load, and few need it

    return np.asarray(Rotation.from_matrix(rotation).as_rotvec(), dtype=np.float64)


def quaternions(poses: Sequence[Pose]) -> Float:
    """Write rotations of poses as unit quaternions (N, 4): x, y, z and w >= 0."""
    from scipy.spatial.transform import Rotation

    rotations = np.array([pose.rotation for pose in poses]).reshape(-1, 3, 3)
    return np.asarray(Rotation.from_matrix(rotations).as_quat(canonical=True), dtype=np.float64)


def rotation_matrix(rotation_vector: Float) -> Float:
    """Rotation matrices (..., 3, 3) of axes times angles (..., 3), radians."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_rotvec(rotation_vector).as_matrix(), dtype=np.float64)


def rotation_of(quaternion: Sequence[float]) -> Float:
    """Rotation matrix (3, 3) of a quaternion x, y, z, w that is not zero."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_quat(quaternion).as_matrix(), dtype=np.float64)
