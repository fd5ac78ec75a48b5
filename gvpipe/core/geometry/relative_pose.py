"""Camera motion from a ground homography: by singular values, and in closed form."""

from dataclasses import dataclass

import numpy as np

from gvpipe.core.geometry.pose import about_z, mount_of, robot_from_camera
from gvpipe.core.types import Camera, Float, Mount, Pose

_Y_UP = np.diag([1.0, -1.0, 1.0])
"""Takes camera axes with y down to those with y up, in which the thesis writes its formulas."""

PURE_ROTATION = 1e-9
"""Below this spread of squared singular values there is no translation and no normal."""


@dataclass(frozen=True)
class RelativePose:
    """Motion between two cameras that see the same ground.

    Attributes
    ----------
    j_from_i : Pose
        ``X_j = R X_i + t``, metres, OpenCV camera axes.
    normal : (3,) float64
        Unit normal of the ground in camera i, from the camera towards the ground.
    """

    j_from_i: Pose
    normal: Float


@dataclass(frozen=True)
class Location:
    """Where two robots stand with respect to each other, the thesis' Γ (eq. 4.2.33).

    Attributes
    ----------
    rho : float
        Distance on the ground in camera heights, mean of the two views' estimates.
    phi1, phi2 : float
        Bearing of robot i seen from j, and of j seen from i, radians in (-pi, pi]; 0 is left,
        pi/2 ahead, as the thesis counts them.
    """

    rho: float
    phi1: float
    phi2: float


def ground_motion(homography: Float, camera_i: Camera, camera_j: Camera) -> Float:
    """Reduce a homography to ``R + t n^T / d`` exactly.

    Parameters
    ----------
    homography : (3, 3) float64
        Pixels of i to pixels of j, any scale and sign.
    camera_i, camera_j : Camera
        Intrinsics.

    Returns
    -------
    motion : (3, 3) float64
        ``K_j^-1 H K_i`` scaled so that its middle singular value and the sign of its
        determinant are 1; the determinant is then the ratio of the heights, h_j / h_i.

    Raises
    ------
    ValueError
        If the homography is singular or not finite.
    """
    m = camera_j.inverse @ np.asarray(homography, np.float64) @ camera_i.matrix
    if not np.isfinite(m).all():
        raise ValueError("the homography is not finite")
    singular = np.linalg.svd(m, compute_uv=False)
    if singular[2] <= 1e-12 * singular[0]:
        raise ValueError("the homography is singular")
    return np.asarray(np.sign(np.linalg.det(m)) * m / singular[1])


def decompose(motion: Float, height: float) -> tuple[RelativePose, RelativePose]:
    """Both motions a plane homography allows, from its singular values.

    Parameters
    ----------
    motion : (3, 3) float64
        ``R + t n^T / d`` from :func:`ground_motion`.
    height : float
        Camera i above the ground, metres; scales the translation.

    Returns
    -------
    solutions : (RelativePose, RelativePose)
        Normals with a positive optical-axis component. The two coincide when the motion is
        along the normal; without translation the normal is undefined and set to the optical
        axis.

    Notes
    -----
    Thesis eq. 4.2.14 to 4.2.20 after Triggs, with the roots of eq. 4.2.19 exchanged and the
    transpose of eq. 4.2.18 restored.
    """
    _, (s1, _, s3), vt = np.linalg.svd(motion)
    v1, v3 = vt[0], vt[2]
    b1, b2 = np.sqrt(max(1.0 - s3**2, 0.0)), np.sqrt(max(s1**2 - 1.0, 0.0))
    spread = s1**2 - s3**2
    if spread < PURE_ROTATION:
        still = RelativePose(Pose(_nearest_rotation(motion), np.zeros(3)), np.array([0, 0, 1.0]))
        return still, still
    solutions = []
    for e in (1.0, -1.0):
        normal = (b2 * v1 + e * b1 * v3) / np.sqrt(spread)
        shift = (s1 - s3) * (-s3 * b2 * v1 + e * s1 * b1 * v3) / np.sqrt(spread)
        if normal[2] < 0:
            normal, shift = -normal, -shift
        rotation = _nearest_rotation(motion @ (np.eye(3) + np.outer(shift, normal) / (s1 * s3)))
        solutions.append(RelativePose(Pose(rotation, -rotation @ shift * height), normal))
    return solutions[0], solutions[1]


def _nearest_rotation(matrix: Float) -> Float:
    """Remove the rounding error of a matrix that should be a rotation."""
    u, _, vt = np.linalg.svd(matrix)
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)


def choose(solutions: tuple[RelativePose, ...], normal_prior: Float) -> RelativePose:
    """Pick the solution whose normal is nearest to the known one (thesis 4.2.1).

    Parameters
    ----------
    solutions : tuple of RelativePose
        Of :func:`decompose`.
    normal_prior : (3,) float64
        Unit normal of the ground in camera i as configured, towards the ground.
    """
    return max(solutions, key=lambda s: float(s.normal @ normal_prior))


def closed_form(motion: Float, height: float) -> RelativePose:
    """Motion of cameras without roll, read from the entries of the motion matrix.

    Parameters
    ----------
    motion : (3, 3) float64
        From :func:`ground_motion`.
    height : float
        Camera i above the ground, metres.

    Returns
    -------
    relative_pose : RelativePose

    Notes
    -----
    Thesis eq. 4.2.2 and 4.2.7 to 4.2.13 with the quadrants kept and eq. 4.2.11 replaced by the
    least-squares optimum ``t = (M - R) n``. The tilts come from the ratio of two entries that
    vanish with the yaw, so prefer :func:`decompose` for nearly parallel views.
    """
    m = _Y_UP @ motion @ _Y_UP
    inverse = np.linalg.inv(m)
    sign_j = 1.0 if m[1, 0] + m[2, 0] >= 0 else -1.0
    sign_i = 1.0 if inverse[1, 0] + inverse[2, 0] >= 0 else -1.0
    alpha_j = np.arctan2(sign_j * m[2, 0], sign_j * m[1, 0])
    alpha_i = np.arctan2(sign_i * inverse[2, 0], sign_i * inverse[1, 0])
    theta = np.arctan2(sign_j * np.hypot(m[1, 0], m[2, 0]), m[0, 0])
    rotation = _about_x(alpha_j) @ about_z(theta) @ _about_x(alpha_i).T
    normal = np.array([0.0, -np.sin(alpha_i), np.cos(alpha_i)])
    translation = (m - rotation) @ normal * height
    return RelativePose(
        Pose(_Y_UP @ rotation @ _Y_UP, _Y_UP @ translation), np.asarray(_Y_UP @ normal)
    )


def _about_x(angle: float) -> Float:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def tilt_and_roll(normal: Float) -> tuple[float, float]:
    """Tilt and roll, radians, of a camera from the ground normal in its axes.

    Parameters
    ----------
    normal : (3,) float64
        Unit, from the camera towards the ground:
        ``(cos tilt sin roll, cos tilt cos roll, sin tilt)``.
    """
    tilt = float(np.arctan2(normal[2], np.hypot(normal[0], normal[1])))
    return tilt, float(np.arctan2(normal[0], normal[1]))


def robot_motion(relative: RelativePose, height: float) -> tuple[Pose, Mount, Mount]:
    """Express a camera motion between the robots' ground frames.

    Parameters
    ----------
    relative : RelativePose
        Motion of the cameras.
    height : float
        Camera i above the ground, metres.

    Returns
    -------
    robot_i_from_camera_j : Pose
        Camera j in the ground frame of robot i, metres.
    mount_i, mount_j : Mount
        How the cameras are held, by the motion's own normal.
    """
    tilt_i, roll_i = tilt_and_roll(relative.normal)
    mount_i = Mount(tilt=tilt_i, roll=roll_i, height=height)
    robot_i_from_camera_j = robot_from_camera(mount_i) @ relative.j_from_i.inverse()
    return robot_i_from_camera_j, mount_i, mount_of(robot_i_from_camera_j)


def location(relative: RelativePose, height: float, alpha_1: float, alpha_2: float) -> Location:
    """Project a camera motion to the ground as the thesis does (eq. 4.2.27 to 4.2.33).

    Parameters
    ----------
    relative : RelativePose
        Motion of the cameras.
    height : float
        Unit of length, metres.
    alpha_1, alpha_2 : float
        Tilts of camera j and of camera i from the nadir, radians: 90° minus the tilt below the
        horizon.

    Returns
    -------
    location : Location

    Notes
    -----
    ``x = -t_x`` and ``y = t_y cos(alpha) + t_z sin(alpha)`` with y up: the printed
    ``sqrt(t_y^2 + t_z^2) sin(alpha + beta)`` without its lost sign.
    """
    j_from_i = relative.j_from_i
    t1 = _Y_UP @ j_from_i.translation / height
    t2 = _Y_UP @ j_from_i.inverse().translation / height
    x1, y1 = -t1[0], t1[1] * np.cos(alpha_1) + t1[2] * np.sin(alpha_1)
    x2, y2 = -t2[0], t2[1] * np.cos(alpha_2) + t2[2] * np.sin(alpha_2)
    return Location(
        rho=float((np.hypot(x1, y1) + np.hypot(x2, y2)) / 2),
        phi1=float(np.arctan2(y1, x1)),
        phi2=float(np.arctan2(y2, x2)),
    )


def motion_covariance(
    relative: RelativePose,
    height: float,
    camera_i: Camera,
    camera_j: Camera,
    points_i: Float,
    points_j: Float,
) -> Float:
    """Covariance of a motion from the scatter of the matches it explains.

    Parameters
    ----------
    relative : RelativePose
        The motion.
    height : float
        Camera i above the ground, metres; taken as exact.
    camera_i, camera_j : Camera
        Intrinsics.
    points_i, points_j : (N, 2) float64
        Matched ground pixels, N >= 5.

    Returns
    -------
    covariance : (6, 6) float64
        Of (rotation vector in axes of camera j, translation), radians and metres.

    Notes
    -----
    Eight parameters (three of rotation, three of translation, two of the normal) are those of a
    homography, so the inverse normal matrix scaled by the residual variance is the
    least-squares covariance to first order.
    """
    side = np.linalg.svd(relative.normal[None])[2][1:]
    rotation, translation = relative.j_from_i.rotation, relative.j_from_i.translation
    ray = np.column_stack([points_i, np.ones(len(points_i))]) @ camera_i.inverse.T
    turned = ray @ rotation.T
    below = ray @ relative.normal / height
    # changes of the rays in camera j by each parameter, (8, N, 3)
    x, y, z = turned.T
    none = np.zeros(len(turned))
    by_turn = np.array([[none, -z, y], [z, none, -x], [-y, x, none]]).transpose(0, 2, 1)
    by_shift = np.eye(3)[:, None] * below[:, None]
    by_normal = (ray @ side.T / height).T[:, :, None] * translation
    change = np.concatenate([by_turn, by_shift, by_normal]) @ camera_j.matrix.T
    image = (turned + below[:, None] * translation) @ camera_j.matrix.T
    pixel = image[:, :2] / image[:, 2:]
    moved = (change[:, :, :2] - pixel * change[:, :, 2:]) / image[:, 2:]
    jacobian = moved.reshape(8, -1).T
    residuals = (pixel - points_j).ravel()
    variance = float(residuals @ residuals) / max(residuals.size - 8, 1)
    scale = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-12)
    scaled = np.linalg.pinv((jacobian / scale).T @ (jacobian / scale))
    return np.asarray((scaled / np.outer(scale, scale) * variance)[:6, :6])
