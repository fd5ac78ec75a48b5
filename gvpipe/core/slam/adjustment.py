"""Adjustment with variances judged by the data: pixel noise, and how rigidly cameras are held."""

from dataclasses import dataclass, replace

import numpy as np

from gvpipe.core.geometry.pose import about_z, yaw_tilt_roll
from gvpipe.core.slam.control import Control, placed_by
from gvpipe.core.slam.fronts import Factor
from gvpipe.core.slam.ground_bundle import Problem
from gvpipe.core.slam.normal import marginal_covariances
from gvpipe.core.slam.rig import Rig, Spread, State, camera_from_map, pose_jacobians, rescaled
from gvpipe.core.types import Float

CAUCHY = 2.385
"""Loss scale over residual deviation: 95 % efficient when the residuals are Gaussian."""

FIRST_LOSS_PX = 10.0
"""Loss scale of the first adjustment, pixels: initial poses are off by several pixels."""

LEAST_NOISE_PX = 0.01
"""Noise below which real corners cannot be found; without it exact matches would make the priors
vanish beside the data."""

ROUNDS = 8
"""Re-estimations of the variances at most; they settle in three to five."""

STEPS = 10
"""Levenberg-Marquardt steps of an adjustment, at most."""

FIRST_GAIN, ROUND_GAIN, LAST_GAIN = 0.02, 5e-3, 1e-5
"""Shares of the cost below which a step's gain ends an adjustment: when only wrong links are to be
found, when variances are to be judged, and at last."""

SETTLED = 0.05
"""The variances have settled when none changes by more than this share."""

HELD_BY_HAND = 0.01
"""Relative height deviation above which pictures count as taken by hand, not by a robot.

A robot's suspension gives some tenths of a percent, a steady hand several percent. By hand the
configured height is that of the first picture; on a robot it is the mean."""

UNKNOWN_SCALE = 10.0
"""Relative uncertainty of heights that say nothing about the scale, because known points do."""

LOOSE_LEAN = np.radians(3.0)
LOOSE_HEIGHT = 0.1
"""Deviations within a robot that the adjustment starts from, radians and relative."""

EXPECTED = np.array([np.radians(0.3), np.radians(0.3), 0.003])
"""Deviations within a robot (two leans, radians; relative height) that `FICTITIOUS` pictures
vote for, so that two or three real pictures do not settle on zero."""

FICTITIOUS = 2.0
"""Weight of that vote, in pictures."""


@dataclass(frozen=True)
class Adjusted:
    """Cameras at the optimum.

    Attributes
    ----------
    state : State
        Unknowns.
    spread : Spread
        Priors as the data set them.
    loss_px : float
        Scale of the robust loss.
    noise_px : float
        Deviation of one pixel coordinate.
    """

    state: State
    spread: Spread
    loss_px: float
    noise_px: float


def begin(
    problem: Problem, cameras: Float, mean_sigma: Float, height_sigma: float | None
) -> Adjusted:
    """Start from cameras whose pictures fit to a pixel or so, held loosely.

    Parameters
    ----------
    problem : Problem
        Cameras and tracks.
    cameras : (N, 6) float64
        Initial unknowns, see :class:`State`.
    mean_sigma : (G, 3) float64
        Uncertainty of each robot's configured leans (radians) and relative height.
    height_sigma : float, optional
        Relative deviation of single heights within a robot; loose if None.

    Returns
    -------
    start : Adjusted
        With the noise that the residuals show.
    """
    groups = problem.groups
    within = np.tile([LOOSE_LEAN, LOOSE_LEAN, LOOSE_HEIGHT], (groups, 1))
    if height_sigma is not None:
        within[:, 2] = height_sigma
    spread = Spread(within, mean_sigma, np.full(groups, -1, dtype=np.int64))
    state = State(cameras, np.zeros((groups, 3)), problem.initial_points(cameras))
    return Adjusted(state, spread, *_noise(problem, state))


def approach(problem: Problem, start: Adjusted) -> Adjusted:
    """Bring cameras near to their places when only rough ones are known, see :func:`begin`."""
    state, _ = problem.minimise(start.state, start.spread, FIRST_LOSS_PX, 1.0, STEPS, FIRST_GAIN)
    loss_px, noise_px = _noise(problem, state)
    state, _ = problem.minimise(state, start.spread, loss_px, noise_px, STEPS, FIRST_GAIN)
    return replace(start, state=state, loss_px=loss_px, noise_px=noise_px)


def adjust(problem: Problem, start: Adjusted, height_sigma: float | None) -> Adjusted:
    """Alternate between the adjustment and the variances it rests on.

    Parameters
    ----------
    problem : Problem
        Cameras and tracks.
    start : Adjusted
        See :func:`begin`.
    height_sigma : float, optional
        Relative deviation of single heights within a robot; estimated if None.

    Returns
    -------
    adjusted : Adjusted

    Notes
    -----
    Deviations within robots start loose and follow MacKay's evidence update: their squared sum
    over the number of them that the data determine.
    """
    state, spread = start.state, start.spread
    loss_px, noise_px = start.loss_px, start.noise_px
    factor: Factor | None = None
    for _ in range(ROUNDS):
        state, factor = problem.minimise(state, spread, loss_px, noise_px, STEPS, ROUND_GAIN)
        state = rescaled(state, spread)
        # one that foretold the last steps is near enough for variances that are about to change
        factor = factor or problem.normal(state, spread, loss_px, noise_px).factor()
        variance = _variances(problem, state, factor)
        tighter = _within(problem.rig, state, spread, variance, height_sigma)
        loss_px, new_noise_px = _noise(problem, state)
        change = np.abs(np.log(np.append(tighter.within / spread.within, new_noise_px / noise_px)))
        spread, noise_px = tighter, new_noise_px
        if change.max() < SETTLED:
            break
    state, _ = problem.minimise(state, spread, loss_px, noise_px, STEPS, LAST_GAIN, factor)
    state = rescaled(state, spread)
    return Adjusted(state, spread, loss_px, noise_px)


def fixed_by(adjusted: Adjusted, problem: Problem, control: Control) -> tuple[Adjusted, Problem]:
    """Bring an adjusted map into the site frame of known ground points and adjust it with them.

    Parameters
    ----------
    adjusted : Adjusted
        The map in a frame of its own.
    problem : Problem
        Its cameras and tracks.
    control : Control
        Two different points at least: they decide on the scale, no longer the heights.

    Returns
    -------
    adjusted, problem : Adjusted, Problem
    """
    problem = Problem(problem.rig, problem.tracks, 0, control, problem.where)
    mean = adjusted.spread.mean.copy()
    mean[:, 2] = UNKNOWN_SCALE
    spread = replace(adjusted.spread, mean=mean)
    state = placed_by(control, problem.rig, adjusted.state)
    state, _ = problem.minimise(
        state, spread, adjusted.loss_px, adjusted.noise_px, 3 * STEPS, LAST_GAIN
    )
    return replace(adjusted, state=state, spread=spread), problem


def _noise(problem: Problem, state: State) -> tuple[float, float]:
    """Loss scale, and the noise that makes the weighted normal matrix honest, pixels.

    The latter is Huber's asymptotic variance of a robust estimate: the variance of the weighted
    residuals over the squared mean curvature of the loss.
    """
    misfits = problem.misfits(state)
    seen = np.diff(problem.tracks.start)
    freedom = 2.0 * (seen - 1)
    # the misfit of a point with d degrees of freedom has about this median, in variances
    middle = freedom * (1.0 - 2.0 / (9.0 * freedom)) ** 3
    loss_sq = CAUCHY**2 * max(float(np.median(misfits / middle)), LEAST_NOISE_PX**2)
    ratio = misfits / (loss_sq * (seen - 1))
    weight = 1.0 / (1.0 + ratio)
    total = freedom.sum()
    curvature = float(freedom @ weight - 2.0 * (weight**2 * ratio).sum()) / total
    left = max(total - 6.0 * len(state.cameras), 1.0)
    variance = float((weight**2) @ misfits) / left * float(freedom @ weight) / total
    return float(np.sqrt(loss_sq)), max(float(np.sqrt(variance)) / curvature, LEAST_NOISE_PX)


def _variances(problem: Problem, state: State, factor: Factor) -> Float:
    """Variances (N, 3) of the deviations from the robots' means, given data and present priors."""
    cameras, groups = len(state.cameras), len(state.means)
    own, beside = marginal_covariances(factor, problem.held, 6 * cameras + np.arange(3 * groups))
    picked = 3 * problem.rig.group[:, None] + np.arange(3)
    mixed = beside[6 * np.arange(cameras)[:, None] + 3 + np.arange(3), picked]
    mean = np.diagonal(beside[6 * cameras :])[picked]
    return np.asarray(np.einsum("nii->ni", own)[:, 3:] - 2.0 * mixed + mean)


def _within(
    rig: Rig, state: State, spread: Spread, variance: Float, height_sigma: float | None
) -> Spread:
    """Deviations within each robot, re-estimated, and what the configured height means."""
    deviation = state.cameras[:, 3:] - state.means[rig.group]
    within, anchor = spread.within.copy(), spread.anchor.copy()
    for g in range(len(within)):
        own = rig.group == g
        determined = np.clip(1.0 - variance[own] / spread.within[g] ** 2, 0.0, 1.0).sum(axis=0)
        sums = (deviation[own] ** 2).sum(axis=0) + FICTITIOUS * EXPECTED**2
        within[g] = np.sqrt(sums / (determined + FICTITIOUS))
        by_hand = within[g, 2] > HELD_BY_HAND
        anchor[g] = int(np.argmax(own)) if by_hand else -1
        if height_sigma is not None:
            within[g, 2] = height_sigma
    return replace(spread, within=within, anchor=anchor)


def pose_covariances(
    problem: Problem, adjusted: Adjusted, reference: int, shared: float = 1.0
) -> Float:
    """Covariances of the poses in the map.

    The map's frame is that of the known ground points, or lies below the reference camera, x along
    its optical axis.

    Parameters
    ----------
    problem : Problem
        The cameras; position and heading of the reference are held fixed in it.
    adjusted : Adjusted
        Their adjustment.
    reference : int
        Camera that defines the frame.
    shared : float
        Factor by which errors that matches share raise the variance of what they determine.

    Returns
    -------
    covariance : (N, 6, 6) float64
        Of (rotation vector, translation) in that frame, radians and metres.

    Notes
    -----
    The frame turns with the reference camera's optical axis, whose heading moves a little when
    its lean does; that is why the covariance with the reference's leans enters.
    """
    rig, cameras = problem.rig, adjusted.state.cameras
    noise_px = adjusted.noise_px * float(np.sqrt(shared))
    normal = problem.normal(adjusted.state, adjusted.spread, adjusted.loss_px, noise_px)
    count = len(cameras)
    lean = (6 * reference + np.array([3, 4])).astype(np.int64)
    own, beside = marginal_covariances(normal.factor(), problem.held, lean)
    jacobian = pose_jacobians(rig, cameras)
    if problem.control:
        return np.asarray(jacobian @ own @ jacobian.transpose(0, 2, 1))
    map_from_camera = camera_from_map(rig, cameras)[reference].T
    by_lean = _heading_by_leans(map_from_camera, jacobian[reference])
    turn = about_z(-yaw_tilt_roll(map_from_camera)[0])
    position = cameras[:, :2] @ turn[:2, :2].T
    twist = np.zeros((count, 6))
    twist[:, 2], twist[:, 3], twist[:, 4] = -1.0, position[:, 1], -position[:, 0]
    both = np.zeros((6, 6))
    both[:3, :3] = both[3:, 3:] = turn
    a = both @ jacobian
    b = twist[:, :, None] * by_lean[None, None, :]
    cross = beside[: 6 * count].reshape(count, 6, 2)
    lean_block = own[reference][3:5, 3:5]
    mixed = a @ cross @ b.transpose(0, 2, 1)
    return np.asarray(
        a @ own @ a.transpose(0, 2, 1)
        + mixed
        + mixed.transpose(0, 2, 1)
        + b @ lean_block @ b.transpose(0, 2, 1)
    )


def _heading_by_leans(map_from_camera: Float, jacobian: Float) -> Float:
    """Differentiate the heading of a camera's optical axis by its two leans, (2,).

    Parameters
    ----------
    map_from_camera : (3, 3) float64
        Rotation.
    jacobian : (6, 6) float64
        Of its pose by its unknowns.
    """
    axis = map_from_camera[:, 2]
    if np.hypot(*axis[:2]) <= 1e-9:  # straight down, the upper edge of the picture heads the way
        axis = -map_from_camera[:, 1]
    moved = np.cross(jacobian[:3, 3:5].T, axis)
    return np.asarray((axis[0] * moved[:, 1] - axis[1] * moved[:, 0]) / (axis[:2] ** 2).sum())
