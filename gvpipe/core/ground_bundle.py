"""Adjustment of cameras over a plane: poses and ground points that explain the matches best."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import coo_matrix, csc_matrix
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from gvpipe.core.kernels import bundle as kernels
from gvpipe.core.tracks import Index, Tracks
from gvpipe.core.types import Float

CAUCHY = 2.385
"""Loss scale over residual deviation: 95 % efficient when the residuals are Gaussian."""

DENSE_LIMIT = 1500
"""Unknowns up to which a dense factorisation is faster than a sparse one."""

RELATIVE_GAIN = 1e-7
"""The adjustment stops when a step lowers the cost by less than this share."""


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
        logarithm of height over configured height. The orientation is
        ``Rz(heading) exp(leans) robot_from_camera``.
    means : (G, 3) float64
        Mean leans and logarithmic height of each robot.
    points : (T, 2) float64
        Ground points, metres.
    """

    cameras: Float
    means: Float
    points: Float


@dataclass(frozen=True)
class Adjusted:
    """State at the optimum.

    Attributes
    ----------
    state : State
        Unknowns.
    noise_px : float
        Deviation of one pixel coordinate, from the residuals.
    normal : Normal
        Normal matrix at the optimum, per squared `noise_px`.
    """

    state: State
    noise_px: float
    normal: "Normal"


def orientation(rig: Rig, cameras: Float) -> tuple[Float, Float]:
    """Rotations of the cameras and their derivatives.

    Parameters
    ----------
    rig : Rig
        Configured orientations.
    cameras : (N, 6) float64
        See :class:`State`.

    Returns
    -------
    camera_from_map : (N, 3, 3) float64
    turned : (N, 3, 3, 3) float64
        Derivatives by heading and the two leans.
    """
    n = len(cameras)
    lean_vector = np.column_stack([cameras[:, 4], cameras[:, 3], np.zeros(n)])
    lean = Rotation.from_rotvec(lean_vector).as_matrix()
    heading = Rotation.from_rotvec(cameras[:, 2:3] * [0.0, 0.0, 1.0]).as_matrix()
    camera_from_robot = rig.robot_from_camera.transpose(0, 2, 1)
    unlean, unturn = lean.transpose(0, 2, 1), heading.transpose(0, 2, 1)
    turned = np.empty((n, 3, 3, 3))
    turned[:, 0] = camera_from_robot @ unlean @ (-_cross([0.0, 0.0, 1.0])) @ unturn
    # exp(w + d) = exp(w) exp(J d) with J the right Jacobian of the rotation group
    right = _right_jacobian(lean_vector)
    for slot, axis in ((1, 1), (2, 0)):
        turned[:, slot] = camera_from_robot @ -_cross(right[:, :, axis]) @ unlean @ unturn
    return camera_from_robot @ unlean @ unturn, turned


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


def centres(rig: Rig, cameras: Float) -> Float:
    """Camera centres in the map, (N, 3) metres."""
    return np.column_stack([cameras[:, :2], rig.height * np.exp(cameras[:, 5])])


class Normal:
    """Sparse symmetric normal matrix of all cameras and robot means, some unknowns held fixed."""

    def __init__(self, matrix: csc_matrix, free: Index) -> None:
        self.size = matrix.shape[0]
        self.free = free
        self.matrix = csc_matrix(matrix[free][:, free])

    def factor(self, damping: float = 0.0) -> "Factor":
        """Cholesky or LU factors with the diagonal raised by the share `damping`."""
        return Factor(self, damping)


class Factor:
    """Solver of one damped normal matrix; fixed unknowns get zero steps."""

    def __init__(self, normal: Normal, damping: float) -> None:
        matrix = normal.matrix.copy()
        matrix.setdiag(matrix.diagonal() * (1.0 + damping))
        self._normal = normal
        self._dense = len(normal.free) <= DENSE_LIMIT
        if self._dense:
            self._cholesky = cho_factor(matrix.toarray(), lower=True)
        else:
            self._lu = splu(
                csc_matrix(matrix),
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )

    def solve(self, right: Float) -> Float:
        """Solve for one (S,) or several (S, C) right sides over all unknowns."""
        free = self._normal.free
        full = np.zeros_like(right)
        part = np.ascontiguousarray(right[free])
        full[free] = cho_solve(self._cholesky, part) if self._dense else self._lu.solve(part)
        return full


class Problem:
    """One connected set of cameras with their tracks."""

    def __init__(self, rig: Rig, tracks: Tracks, reference: int) -> None:
        self.rig = rig
        self.tracks = tracks
        self.groups = int(rig.group.max()) + 1
        n = len(rig.height)
        lengths = np.diff(tracks.start)
        first, second = _observation_pairs(tracks.start, lengths)
        keys = tracks.camera[first] * n + tracks.camera[second]
        block_keys, block = np.unique(keys, return_inverse=True)
        self._pair_block = block.ravel().astype(np.int64)
        self._row, self._column = block_keys // n, block_keys % n
        self.free = np.setdiff1d(
            np.arange(6 * n + 3 * self.groups), 6 * reference + np.arange(3)
        ).astype(np.int64)

    def initial_points(self, cameras: Float) -> Float:
        """Mean of where the observations of each track meet the ground, (T, 2) metres."""
        rotation, _ = orientation(self.rig, cameras)
        centre = centres(self.rig, cameras)
        back = np.linalg.inv(self.rig.matrix @ rotation)
        seen = np.column_stack([self.tracks.pixel, np.ones(len(self.tracks.pixel))])
        ray = np.einsum("kij,kj->ki", back[self.tracks.camera], seen)
        c = centre[self.tracks.camera]
        down = np.maximum(-ray[:, 2], 1e-3 * np.linalg.norm(ray, axis=1))
        ground = c[:, :2] + ray[:, :2] * (c[:, 2] / down)[:, None]
        # a foreshortened view says little about where the point lies
        weight = (down / np.linalg.norm(ray, axis=1)) ** 2 / c[:, 2]
        total = np.add.reduceat(weight, self.tracks.start[:-1])
        return np.add.reduceat(ground * weight[:, None], self.tracks.start[:-1]) / total[:, None]

    def residuals_sq(self, state: State) -> Float:
        """Squared reprojection errors, (M,) squared pixels; infinite behind a camera."""
        out = np.empty(len(self.tracks.camera))
        self._robust_cost(state, 1.0, out)
        return out

    def _robust_cost(self, state: State, loss_px: float, out: Float) -> float:
        rotation, _ = orientation(self.rig, state.cameras)
        return kernels.evaluate(
            self.rig.matrix @ rotation,
            centres(self.rig, state.cameras),
            self.tracks.camera,
            self.tracks.pixel,
            self.tracks.start,
            state.points,
            loss_px,
            out,
        )

    def cost(self, state: State, spread: Spread, loss_px: float, noise_px: float) -> float:
        """Robust data cost over the noise variance, plus the priors."""
        out = np.empty(len(self.tracks.camera))
        data = self._robust_cost(state, loss_px, out) / noise_px**2
        return float(data + _prior_cost(self.rig, state, spread))

    def minimise(
        self, state: State, spread: Spread, loss_px: float, noise_px: float, steps: int
    ) -> tuple[State, Normal]:
        """Levenberg-Marquardt from `state`; also the normal matrix of the last linearisation."""
        damping = 1e-4
        cost = self.cost(state, spread, loss_px, noise_px)
        for _ in range(steps):
            normal, gradient, elimination = self._linearise(state, spread, loss_px, noise_px)
            gained = 0.0
            while damping < 1e8:
                step = normal.factor(damping).solve(-gradient)
                trial = self._moved(state, step, elimination)
                trial_cost = self.cost(trial, spread, loss_px, noise_px)
                if trial_cost <= cost:
                    gained = cost - trial_cost
                    state, cost = trial, trial_cost
                    damping = max(damping / 10.0, 1e-12)
                    break
                damping *= 10.0
            if gained <= RELATIVE_GAIN * cost:
                break
        return state, self._linearise(state, spread, loss_px, noise_px)[0]

    def _moved(self, state: State, step: Float, elimination: tuple[Float, Float, Float]) -> State:
        n = len(state.cameras)
        cameras = step[: 6 * n].reshape(n, 6)
        points = kernels.move_points(
            self.tracks.camera, self.tracks.start, state.points, cameras, *elimination
        )
        return State(state.cameras + cameras, state.means + step[6 * n :].reshape(-1, 3), points)

    def _linearise(
        self, state: State, spread: Spread, loss_px: float, noise_px: float
    ) -> tuple[Normal, Float, tuple[Float, Float, Float]]:
        n, m, t = len(state.cameras), len(self.tracks.camera), len(state.points)
        rotation, turned = orientation(self.rig, state.cameras)
        blocks, gradient = np.zeros((len(self._row), 6, 6)), np.zeros((n, 6))
        coupling, inverse = np.empty((m, 6, 2)), np.empty((t, 2, 2))
        point_gradient = np.empty((t, 2))
        kernels.linearise(
            self.rig.matrix @ rotation,
            self.rig.matrix[:, None] @ turned,
            centres(self.rig, state.cameras),
            self.tracks.camera,
            self.tracks.pixel,
            self.tracks.start,
            state.points,
            loss_px,
            self._pair_block,
            blocks,
            gradient,
            coupling,
            inverse,
            point_gradient,
        )
        prior_matrix, prior_gradient = _prior_normal(self.rig, state, spread)
        total = np.concatenate([gradient.ravel() / noise_px**2, np.zeros(3 * self.groups)])
        matrix = self._assemble(blocks / noise_px**2) + prior_matrix
        return (
            Normal(csc_matrix(matrix), self.free),
            total + prior_gradient,
            (coupling, inverse, point_gradient),
        )

    def _assemble(self, blocks: Float) -> csc_matrix:
        """Lay the upper blocks and their transposes out as one sparse matrix."""
        n, size = len(self.rig.height), 6 * len(self.rig.height) + 3 * self.groups
        upper = self._row != self._column
        row = np.concatenate([self._row, self._column[upper], np.arange(n)])
        column = np.concatenate([self._column, self._row[upper], np.arange(n)])
        value = np.concatenate([blocks, blocks[upper].transpose(0, 2, 1), np.zeros((n, 6, 6))])
        six = np.arange(6)
        rows = np.broadcast_to(row[:, None, None] * 6 + six[None, :, None], value.shape)
        columns = np.broadcast_to(column[:, None, None] * 6 + six[None, None, :], value.shape)
        return csc_matrix(
            coo_matrix((value.ravel(), (rows.ravel(), columns.ravel())), (size, size))
        )


def rescaled(rig: Rig, state: State, spread: Spread) -> State:
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


def _observation_pairs(start: Index, lengths: Index) -> tuple[Index, Index]:
    """All pairs (a <= b) of observations of a track, track by track, a slow and b fast."""
    # observation k of its track pairs with itself and everything after it
    after = np.repeat(start[1:], lengths) - np.arange(start[-1])
    first = np.repeat(np.arange(start[-1]), after)
    offset = np.arange(len(first)) - np.repeat(np.cumsum(after) - after, after)
    return first.astype(np.int64), (first + offset).astype(np.int64)


def _deviations(rig: Rig, state: State) -> Float:
    """Leans and logarithmic height of each camera against its robot's mean, (N, 3)."""
    return state.cameras[:, 3:] - state.means[rig.group]


def _prior_cost(rig: Rig, state: State, spread: Spread) -> float:
    anchored = spread.anchor >= 0
    heights = state.cameras[spread.anchor[anchored], 5] / spread.mean[anchored, 2]
    free_mean = state.means / spread.mean
    free_mean[anchored, 2] = 0.0
    return float(
        ((_deviations(rig, state) / spread.within[rig.group]) ** 2).sum()
        + (free_mean**2).sum()
        + (heights**2).sum()
    )


def _prior_normal(rig: Rig, state: State, spread: Spread) -> tuple[csc_matrix, Float]:
    """Normal matrix and gradient of the priors."""
    n, groups = len(state.cameras), len(state.means)
    size = 6 * n + 3 * groups
    weight = 1.0 / spread.within[rig.group] ** 2
    pull = weight * _deviations(rig, state)
    own = (6 * np.arange(n)[:, None] + [3, 4, 5]).ravel()
    mean = (6 * n + 3 * rig.group[:, None] + [0, 1, 2]).ravel()
    mean_weight = 1.0 / spread.mean**2
    anchored = spread.anchor >= 0
    mean_weight[anchored, 2] = 0.0
    anchor = 6 * spread.anchor[anchored] + 5
    anchor_weight = 1.0 / spread.mean[anchored, 2] ** 2
    w, last = weight.ravel(), np.arange(6 * n, size)
    rows = np.concatenate([own, mean, own, mean, last, anchor])
    columns = np.concatenate([own, mean, mean, own, last, anchor])
    values = np.concatenate([w, w, -w, -w, mean_weight.ravel(), anchor_weight])
    gradient = np.zeros(size)
    gradient[own] = pull.ravel()
    np.add.at(gradient, mean, -pull.ravel())
    gradient[last] += (mean_weight * state.means).ravel()
    gradient[anchor] += anchor_weight * state.cameras[spread.anchor[anchored], 5]
    return csc_matrix(coo_matrix((values, (rows, columns)), (size, size))), gradient
