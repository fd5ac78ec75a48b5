"""Least squares over cameras of one lens above one plane, wrong matches weighted out."""

from dataclasses import dataclass

import numpy as np

from gvpipe.core.calibration.plane_cameras import (
    GLOBALS,
    POSE,
    Matches,
    by_centre,
    jacobian,
    residuals,
)
from gvpipe.core.types import Float

LOSS_SIGMAS = 3.0
"""Residuals beyond this many standard deviations lose their weight."""

LENS_SIGMA = 0.3
"""Expected size of both coefficients of radial distortion: what phones and webcams have."""

FOCAL_SIGMA = 0.6
"""Prior of the logarithm of the focal length about the expected one: most cameras that are carried
about see between 35 and 90 degrees. It only speaks where the motion does not."""

CENTRE_SIGMA = 0.008
"""Standard deviation of the principal point about the middle, picture widths: 5 pixels of 640."""

ITERATIONS = 60
"""Steps at most."""


@dataclass(frozen=True)
class Descent:
    """Where a search ended.

    Attributes
    ----------
    shared, poses : (3,), (N, 6) float64
        Unknowns, see :mod:`gvpipe.core.calibration.plane_cameras`.
    cost : float
        Minus twice the logarithm of the likelihood, up to a constant of the matches.
    sigma : float
        Standard deviation of a coordinate, picture widths.
    """

    shared: Float
    poses: Float
    cost: float
    sigma: float


def descend(
    shared: Float, poses: Float, matches: Matches, reference: int, anchor: float
) -> Descent:
    """Descend by Levenberg-Marquardt with weights whose scale follows the residuals.

    Parameters
    ----------
    shared, poses : (3,), (N, 6) float64
        Start.
    matches : Matches
        What was seen, sorted by pair.
    reference : int
        Camera that fixes origin, heading and unit.
    anchor : float
        Expected logarithm of the focal length, picture widths.

    Returns
    -------
    descent : Descent
        The nearest minimum, or as far as :data:`ITERATIONS` went.
    """
    free = np.ones(GLOBALS + POSE * len(poses), bool)
    first = GLOBALS + POSE * reference
    free[first : first + 4] = False  # the map's origin, heading and unit
    damping = 1e-3
    sigma = robust_scale(residuals(shared, poses, matches))
    cost = _cost(shared, poses, matches, sigma, anchor)
    for _ in range(ITERATIONS):
        normal, gradient = normal_matrix(shared, poses, matches, sigma, anchor)
        improved = False
        for _ in range(8):
            system = normal + damping * np.diag(np.diag(normal) + 1e-9)
            step = np.zeros(len(free))
            step[free] = np.linalg.solve(system[np.ix_(free, free)], -gradient[free, 0])
            moved_shared = shared + step[:GLOBALS]
            moved_poses = poses + step[GLOBALS:].reshape(-1, POSE)
            moved_cost = _cost(moved_shared, moved_poses, matches, sigma, anchor)
            if np.isfinite(moved_cost) and moved_cost < cost:
                improved = True
                break
            damping *= 4
        if not improved:
            break
        drop = (cost - moved_cost) / cost
        shared, poses, damping = moved_shared, moved_poses, max(damping / 6, 1e-9)
        narrower = robust_scale(residuals(shared, poses, matches))
        settled = drop < 1e-6 and abs(narrower - sigma) < 1e-3 * sigma
        sigma = min(sigma, narrower) if not settled else sigma
        cost = _cost(shared, poses, matches, sigma, anchor)
        if settled:
            break
    errors = residuals(shared, poses, matches)
    # descents are compared by one measure: the likelihood at the scale each ended at
    scale = robust_scale(errors)
    measure = 2 * len(errors) * np.log(scale) + _prior(shared, anchor)
    return Descent(shared, poses, float(measure), sigma)


def robust_scale(errors: Float) -> float:
    """Estimate the standard deviation of a coordinate by the median length of the residuals."""
    return float(np.median(np.linalg.norm(errors, axis=1))) / 1.1774 + 1e-7


def _weights(errors: Float, sigma: float) -> Float:
    """Geman-McClure weights of the residuals, (N,)."""
    square = (errors**2).sum(axis=1) / (LOSS_SIGMAS * sigma) ** 2
    return np.asarray(1.0 / (1.0 + square) ** 2)


def _cost(shared: Float, poses: Float, matches: Matches, sigma: float, anchor: float) -> float:
    """Minus twice the log likelihood (Geman-McClure) and prior, up to a constant."""
    square = (residuals(shared, poses, matches) ** 2).sum(axis=1) / sigma**2
    robust = square / (1.0 + square / LOSS_SIGMAS**2)
    return float(robust.sum()) + _prior(shared, anchor)


def _prior(shared: Float, anchor: float) -> float:
    """Squares of how unlikely the shared unknowns are."""
    lens = float(((shared[1:] / LENS_SIGMA) ** 2).sum())
    return float(((shared[0] - anchor) / FOCAL_SIGMA) ** 2) + lens


def normal_matrix(
    shared: Float,
    poses: Float,
    matches: Matches,
    sigma: float,
    anchor: float,
    target: Float | None = None,
) -> tuple[Float, Float]:
    """Accumulate the weighted normal matrix and the gradient over shared unknowns and poses.

    Parameters
    ----------
    shared, poses : (3,), (N, 6) float64
        Where the residuals are linearised.
    matches : Matches
        What was seen, sorted by pair.
    sigma : float
        Standard deviation of a coordinate, picture widths.
    anchor : float
        Expected logarithm of the focal length, picture widths.
    target : (M, 2, k) float64, optional
        In the place of the residuals; then the gradient holds no prior.

    Returns
    -------
    normal : (3 + 6 N, 3 + 6 N) float64
    gradient : (3 + 6 N, 1 or k) float64
    """
    error, by_shared, by_i, by_j = jacobian(shared, poses, matches)
    weight = _weights(error, sigma)[:, None, None] / sigma**2
    rows = np.concatenate([by_shared, by_i, by_j], axis=2)
    wanted = error[..., None] if target is None else target
    size = GLOBALS + POSE * len(poses)
    normal, gradient = np.zeros((size, size)), np.zeros((size, wanted.shape[2]))
    ends = np.column_stack([matches.camera_i, matches.camera_j])
    starts = np.flatnonzero(np.r_[True, (np.diff(ends, axis=0) != 0).any(axis=1)])
    for start, stop in zip(starts, [*starts[1:], len(ends)], strict=True):
        own = slice(int(start), int(stop))
        i, j = ends[start]
        at = np.concatenate(
            [
                np.arange(GLOBALS),
                GLOBALS + POSE * i + np.arange(POSE),
                GLOBALS + POSE * j + np.arange(POSE),
            ]
        )
        jac = rows[own].reshape(-1, len(at))
        weighted = (rows[own] * weight[own]).reshape(-1, len(at))
        normal[np.ix_(at, at)] += weighted.T @ jac
        gradient[at] += weighted.T @ wanted[own].reshape(len(jac), -1)
    prior = np.array([FOCAL_SIGMA, LENS_SIGMA, LENS_SIGMA]) ** -2.0
    normal[np.arange(GLOBALS), np.arange(GLOBALS)] += prior
    if target is None:
        gradient[:GLOBALS, 0] += prior * (shared - np.array([anchor, 0.0, 0.0]))
    return normal, gradient


def covariance(state: Descent, matches: Matches, reference: int, repeats: float) -> Float:
    """Covariance of the shared unknowns and all poses, zero where the reference is fixed.

    Parameters
    ----------
    state : Descent
        At its minimum.
    matches : Matches
        What was seen.
    reference : int
        Camera that fixes origin, heading and unit.
    repeats : float
        How often the same point is among the matches.

    Returns
    -------
    covariance : (3 + 6 N, 3 + 6 N) float64
        In the order of the unknowns.

    Notes
    -----
    The principal point is not estimated, but considered: what its standard deviation
    :data:`CENTRE_SIGMA` moves is added.
    """
    shared, poses = state.shared, state.poses
    by = by_centre(shared, poses, matches)
    normal, cross = normal_matrix(shared, poses, matches, state.sigma, float(shared[0]), by)
    free = np.ones(len(normal), bool)
    first = GLOBALS + POSE * reference
    free[first : first + 4] = False
    inverse = np.linalg.pinv(normal[np.ix_(free, free)])
    moved = inverse @ cross[free] * CENTRE_SIGMA
    spread = np.zeros_like(normal)
    spread[np.ix_(free, free)] = repeats * inverse + moved @ moved.T
    return spread
