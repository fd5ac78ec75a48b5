"""Cameras held over a plane: their unknowns, orientations and priors."""

from dataclasses import dataclass

import numpy as np

from gvpipe.core.geometry.pose import rotation_matrix
from gvpipe.core.slam.fronts import Blocks
from gvpipe.core.types import Float, Index


@dataclass(frozen=True)
class Rig:
    """What is known of the cameras before the adjustment.

    Attributes
    ----------
    matrix : (N, 3, 3) float64
        Calibration matrices, pixels.
    robot_from_camera : (N, 3, 3) float64
        Orientations at the configured tilt and roll.
    height : (N,) float64
        Configured heights, metres.
    group : (N,) int64
        Robot of each camera: cameras of one robot share a mean lean and height.
    """

    matrix: Float
    robot_from_camera: Float
    height: Float
    group: Index


@dataclass(frozen=True)
class Spread:
    """Gaussian priors on lean (two angles, radians) and logarithm of height over configured.

    Attributes
    ----------
    within : (G, 3) float64
        Deviation of single pictures from their robot's mean.
    mean : (G, 3) float64
        Deviation of a robot's mean from the configuration.
    anchor : (G,) int64
        Camera whose height the configuration states, or -1 if it states the robot's mean.
    """

    within: Float
    mean: Float
    anchor: Index


@dataclass(frozen=True)
class State:
    """Unknowns of the adjustment.

    Attributes
    ----------
    cameras : (N, 6) float64
        x, y (metres), heading, lean about the left axis, lean about the forward axis (radians),
        logarithm of height over configured height. The rotation from camera to map is
        ``Rz(heading) exp(leans) robot_from_camera``.
    means : (G, 3) float64
        Mean leans and logarithmic height of each robot.
    points : (T, 2) float64
        Ground points, metres.
    """

    cameras: Float
    means: Float
    points: Float


def camera_from_map(rig: Rig, cameras: Float) -> Float:
    """Rotations (N, 3, 3) from map to camera axes, of cameras (N, 6), see :class:`State`."""
    camera_from_robot = rig.robot_from_camera.transpose(0, 2, 1)
    return np.asarray(camera_from_robot @ _unlean(cameras) @ _unturn(cameras))


def turning(rig: Rig, cameras: Float) -> Float:
    """Differentiate :func:`camera_from_map` by heading and the two leans, (N, 3, 3, 3)."""
    camera_from_robot = rig.robot_from_camera.transpose(0, 2, 1)
    unlean, unturn = _unlean(cameras), _unturn(cameras)
    turned = np.empty((len(cameras), 3, 3, 3))
    turned[:, 0] = camera_from_robot @ unlean @ (-_cross([0.0, 0.0, 1.0])) @ unturn
    # exp(w + d) = exp(w) exp(J d) with J the right Jacobian of the rotation group
    right = _right_jacobian(_lean(cameras))
    for slot, axis in ((1, 1), (2, 0)):
        turned[:, slot] = camera_from_robot @ -_cross(right[:, :, axis]) @ unlean @ unturn
    return turned


def _lean(cameras: Float) -> Float:
    """Leans (N, 3) as rotation vectors."""
    return np.column_stack([cameras[:, 4], cameras[:, 3], np.zeros(len(cameras))])


def _unlean(cameras: Float) -> Float:
    """Rotations (N, 3, 3) from leaning to upright, transposed leans."""
    return rotation_matrix(_lean(cameras)).transpose(0, 2, 1)


def _unturn(cameras: Float) -> Float:
    """Rotations (N, 3, 3) about the vertical from the map to the headings."""
    out = np.zeros((len(cameras), 3, 3))
    out[:, 0, 0] = out[:, 1, 1] = np.cos(cameras[:, 2])
    out[:, 0, 1] = np.sin(cameras[:, 2])
    out[:, 1, 0], out[:, 2, 2] = -out[:, 0, 1], 1.0
    return out


def _cross(vectors: Float | list[float]) -> Float:
    """Matrices (..., 3, 3) of the cross product with vectors (..., 3)."""
    v = np.asarray(vectors, dtype=np.float64)
    m = np.zeros((*v.shape[:-1], 3, 3))
    m[..., 0, 1], m[..., 0, 2], m[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    m[..., 1, 0], m[..., 2, 0], m[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return m


def _right_jacobian(vectors: Float) -> Float:
    """Right Jacobians (N, 3, 3) of rotation vectors (N, 3)."""
    angle = np.linalg.norm(vectors, axis=1)[:, None, None]
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    first = np.where(small, 0.5, (1 - np.cos(safe)) / safe**2)
    second = np.where(small, 1.0 / 6.0, (safe - np.sin(safe)) / safe**3)
    cross = _cross(vectors)
    return np.asarray(np.eye(3) - first * cross + second * cross @ cross)


def pose_jacobians(rig: Rig, cameras: Float) -> Float:
    """Differentiate each pose by its unknowns, (N, 6, 6).

    Rows are the rotation vector (applied on the left, in map axes) and the translation.
    """
    n = len(cameras)
    # exp(w + d) = exp(J d) exp(w) with J the left Jacobian, the transpose of the right one
    turned = (_right_jacobian(_lean(cameras)) @ _unturn(cameras)).transpose(0, 2, 1)
    out = np.zeros((n, 6, 6))
    out[:, 2, 2] = 1.0
    out[:, :3, 3], out[:, :3, 4] = turned[:, :, 1], turned[:, :, 0]
    out[:, 3, 0] = out[:, 4, 1] = 1.0
    out[:, 5, 5] = rig.height * np.exp(cameras[:, 5])
    return out


def centres(rig: Rig, cameras: Float) -> Float:
    """Camera centres in the map, (N, 3) metres."""
    return np.column_stack([cameras[:, :2], rig.height * np.exp(cameras[:, 5])])


def rescaled(state: State, spread: Spread) -> State:
    """Scale the whole map to the optimum of the height priors.

    Matches leave the scale open, so this changes no residual; the damped steps of the
    adjustment would take long to get there.
    """
    anchored = spread.anchor >= 0
    stated = np.where(anchored, state.cameras[spread.anchor, 5], state.means[:, 2])
    weight = 1.0 / spread.mean[:, 2] ** 2
    shift = -float((weight * stated).sum() / weight.sum())
    cameras, means = state.cameras.copy(), state.means.copy()
    cameras[:, :2] *= np.exp(shift)
    cameras[:, 5] += shift
    means[:, 2] += shift
    return State(cameras, means, state.points * np.exp(shift))


def deviations(rig: Rig, state: State) -> Float:
    """Leans and logarithmic height of each camera against its robot's mean, (N, 3)."""
    return state.cameras[:, 3:] - state.means[rig.group]


def prior_cost(rig: Rig, state: State, spread: Spread) -> float:
    """Sum the squared deviations from the priors, in units of their variances."""
    anchored = spread.anchor >= 0
    heights = state.cameras[spread.anchor[anchored], 5] / spread.mean[anchored, 2]
    free_mean = state.means / spread.mean
    free_mean[anchored, 2] = 0.0
    return float(
        ((deviations(rig, state) / spread.within[rig.group]) ** 2).sum()
        + (free_mean**2).sum()
        + (heights**2).sum()
    )


def prior_normal(rig: Rig, state: State, spread: Spread) -> tuple[Blocks, Float]:
    """Return normal matrix and gradient (of half the cost) of the priors.

    Parameters
    ----------
    rig, state, spread : Rig, State, Spread
        N cameras of G robots, where they are, and the priors.

    Returns
    -------
    normal : Blocks
        Cameras are the places, the means of the robots the border; no cameras share a block.
    gradient : (6 N + 3 G,) float64
        Cameras first.
    """
    n, groups = len(state.cameras), len(state.means)
    weight = 1.0 / spread.within[rig.group] ** 2
    pull = weight * deviations(rig, state)
    mean_weight = 1.0 / spread.mean**2
    anchored = spread.anchor >= 0
    mean_weight[anchored, 2] = 0.0
    anchor, anchor_weight = spread.anchor[anchored], 1.0 / spread.mean[anchored, 2] ** 2
    diagonal, border = np.zeros((n, 6, 6)), np.zeros((n, 6, 3 * groups))
    of_group = np.zeros((groups, 3))
    np.add.at(of_group, rig.group, weight)
    lean = np.zeros((groups, 3))
    np.add.at(lean, rig.group, pull)
    gradient = np.zeros((n, 6))
    gradient[:, 3:] = pull
    gradient[anchor, 5] += anchor_weight * state.cameras[anchor, 5]
    for k in range(3):
        diagonal[:, 3 + k, 3 + k] = weight[:, k]
        border[np.arange(n), 3 + k, 3 * rig.group + k] = -weight[:, k]
    diagonal[anchor, 5, 5] += anchor_weight  # each robot has its own anchor
    corner = np.diag((of_group + mean_weight).ravel())
    total = np.concatenate([gradient.ravel(), (mean_weight * state.means - lean).ravel()])
    return Blocks(diagonal, np.empty((0, 6, 6)), border, corner), total
