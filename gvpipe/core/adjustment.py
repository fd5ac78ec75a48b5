"""Adjustment with variances judged by the data: pixel noise, and how rigidly cameras are held."""

from dataclasses import dataclass, replace

import numpy as np

from gvpipe.core.ground_bundle import (
    CAUCHY,
    Normal,
    Problem,
    Rig,
    Spread,
    State,
    rescaled,
)
from gvpipe.core.types import Float

ROUNDS = 8
"""Re-estimations of the variances at most; they settle in three to five."""

SETTLED = 0.02
"""The variances have settled when none changes by more than this share."""

HELD_BY_HAND = 0.01
"""Relative height deviation above which pictures count as taken by hand, not by a robot.

A robot's suspension gives some tenths of a percent, a steady hand several percent. By hand the
configured height is that of the first picture; on a robot it is the mean."""

EXPECTED_LEAN = np.radians(0.3)
EXPECTED_HEIGHT = 0.003
"""Deviations within a robot, radians and relative, that two fictitious pictures vote for."""

FICTITIOUS = 2.0
"""Weight of that vote in pictures, so that two or three pictures do not settle on zero."""


@dataclass(frozen=True)
class Adjusted:
    """Cameras at the optimum.

    Attributes
    ----------
    state : State
        Unknowns.
    spread : Spread
        Priors as the data set them.
    noise_px : float
        Deviation of one pixel coordinate.
    loss_px : float
        Residual scale of the robust loss.
    normal : Normal
        Normal matrix at the optimum.
    """

    state: State
    spread: Spread
    noise_px: float
    loss_px: float
    normal: Normal


def adjust(
    problem: Problem, cameras: Float, spread: Spread, *, held_by_hand: bool | None
) -> Adjusted:
    """Alternate between the adjustment and the variances it rests on.

    Parameters
    ----------
    problem : Problem
        Cameras and tracks.
    cameras : (N, 6) float64
        Initial unknowns, see :class:`State`.
    spread : Spread
        Loose priors to begin with; those within robots are then estimated.

    Returns
    -------
    adjusted : Adjusted

    Notes
    -----
    Deviations within robots follow MacKay's evidence update: their squared sum over the number
    of them that the data determine.
    """
    groups = problem.groups
    state = State(cameras, np.zeros((groups, 3)), problem.initial_points(cameras))
    noise_px, loss_px = 1.0, 10.0
    state, _ = problem.minimise(state, spread, loss_px, noise_px, steps=10)
    state = rescaled(problem.rig, state, spread)
    loss_px, noise_px = _noise(problem, state)
    for _ in range(ROUNDS):
        state, normal = problem.minimise(state, spread, loss_px, noise_px, steps=10)
        state = rescaled(problem.rig, state, spread)
        new_loss_px, new_noise_px = _noise(problem, state)
        tighter = _within(problem.rig, state, spread, normal)
        change = max(
            float(np.abs(np.log(tighter.within / spread.within)).max()),
            abs(np.log(new_noise_px / noise_px)),
        )
        spread, loss_px, noise_px = tighter, new_loss_px, new_noise_px
        if change < SETTLED:
            break
    state = rescaled(problem.rig, state, spread)
    state, normal = problem.minimise(state, spread, loss_px, noise_px, steps=10)
    return Adjusted(state, spread, noise_px, loss_px, normal)


def _noise(problem: Problem, state: State) -> tuple[float, float]:
    """Loss scale and the noise variance that makes the weighted normal matrix honest, pixels."""
    residual_sq = problem.residuals_sq(state)
    residual_sq = residual_sq[np.isfinite(residual_sq)]
    spread_sq = float(np.median(residual_sq)) / (2.0 * np.log(2.0))
    loss_sq = max(CAUCHY**2 * spread_sq, 1e-12)
    ratio = residual_sq / loss_sq
    weight = 1.0 / (1.0 + ratio)
    # mean of the loss' curvature along and across the residual
    curvature = float((weight * (1.0 + (1.0 - ratio) * weight)).mean()) / 2.0
    equations = 2 * len(residual_sq)
    freedom = equations - 2 * (len(problem.tracks.start) - 1) - 6 * len(state.cameras)
    variance = float((weight**2 * residual_sq).sum()) / max(freedom, 1)
    return float(np.sqrt(loss_sq)), float(np.sqrt(variance * weight.mean()) / curvature)


def _within(rig: Rig, state: State, spread: Spread, normal: Normal) -> Spread:
    """Deviations within each robot, re-estimated."""
    variance = marginal_variances(normal, len(state.cameras))[:, 3:]
    deviation = state.cameras[:, 3:] - state.means[rig.group]
    within = spread.within.copy()
    anchor = spread.anchor.copy()
    expected = np.array([EXPECTED_LEAN, EXPECTED_LEAN, EXPECTED_HEIGHT])
    for g in range(len(within)):
        own = rig.group == g
        determined = np.clip(1.0 - variance[own] / spread.within[g] ** 2, 0.0, 1.0).sum(axis=0)
        sums = (deviation[own] ** 2).sum(axis=0) + FICTITIOUS * expected**2
        within[g] = np.sqrt(sums / (determined + FICTITIOUS))
        by_hand = within[g, 2] > HELD_BY_HAND
        anchor[g] = int(np.nonzero(own)[0][0]) if by_hand else -1
    return replace(spread, within=within, anchor=anchor)


def marginal_variances(normal: Normal, cameras: int) -> Float:
    """Variances of the camera unknowns, (N, 6); zero where they are held fixed."""
    return np.einsum("nii->ni", marginal_covariances(normal, cameras))


def marginal_covariances(normal: Normal, cameras: int) -> Float:
    """Covariances (N, 6, 6) of each camera's unknowns."""
    factor = normal.factor()
    out = np.empty((cameras, 6, 6))
    batch = 50
    for begin in range(0, cameras, batch):
        end = min(begin + batch, cameras)
        right = np.zeros((normal.size, 6 * (end - begin)))
        right[np.arange(6 * begin, 6 * end), np.arange(6 * (end - begin))] = 1.0
        solved = factor.solve(right)
        for k in range(begin, end):
            out[k] = solved[6 * k : 6 * k + 6, 6 * (k - begin) : 6 * (k - begin) + 6]
    return out
