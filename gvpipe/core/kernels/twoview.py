"""Fit of the camera pair over a common ground plane: homography, residuals, damped least squares.

The eight parameters, in order: yaw, x, y and log scale of ``ground_j_from_ground_i``, then
tilt and roll of camera i, tilt and roll of camera j. They are as many as a plane homography has,
so any homography between two views of the ground is reached, but each of them means something and
can be held near what is known of it.
"""

import numpy as np

from gvpipe.core.kernels.jit import kernel
from gvpipe.core.types import Float

PARAMETERS = 8
_STEP = 1e-6  # finite difference of the homography's entries: error 1e-10, far below pixel noise


@kernel
def pair_homography(
    theta: Float, inverse_k_i: Float, k_j: Float, height_i: float, height_j: float
) -> Float:
    """Homography (3, 3) pixel_j_from_pixel_i of the ground, scale and sign as a true projection."""
    ground_i = np.empty((3, 3))
    camera_j = np.empty((3, 3))
    for view in range(2):
        tilt, roll = theta[4 + 2 * view], theta[5 + 2 * view]
        s, c, sr, cr = np.sin(tilt), np.cos(tilt), np.sin(roll), np.cos(roll)
        m = np.empty((3, 3))  # rows: robot axes forward, left and up in camera axes
        m[0, 0], m[0, 1], m[0, 2] = -s * sr, -s * cr, c
        m[1, 0], m[1, 1], m[1, 2] = -cr, sr, 0.0
        m[2, 0], m[2, 1], m[2, 2] = -c * sr, -c * cr, -s
        for k in range(3):
            if view == 0:
                ground_i[0, k], ground_i[1, k], ground_i[2, k] = (
                    m[0, k],
                    m[1, k],
                    -m[2, k] / height_i,
                )
            else:
                camera_j[k, 0], camera_j[k, 1], camera_j[k, 2] = (
                    m[0, k],
                    m[1, k],
                    -m[2, k] * height_j,
                )
    scale = np.exp(theta[3])
    cy, sy = scale * np.cos(theta[0]), scale * np.sin(theta[0])
    between = np.zeros((3, 3))
    between[0, 0], between[0, 1], between[0, 2] = cy, -sy, theta[1]
    between[1, 0], between[1, 1], between[1, 2] = sy, cy, theta[2]
    between[2, 2] = 1.0
    return k_j @ (camera_j @ (between @ (ground_i @ inverse_k_i)))


@kernel
def _normal_equations(
    theta: Float,
    prior: Float,
    prior_weight: Float,
    inverse_k_i: Float,
    k_j: Float,
    height_i: float,
    height_j: float,
    p: Float,
    q: Float,
    whiten: Float,
    loss: float,
    gradient: bool,
) -> tuple[float, Float, Float]:
    """Cost; with `gradient` also J'J and J'r of the robustly weighted, whitened residuals."""
    h = pair_homography(theta, inverse_k_i, k_j, height_i, height_j)
    dh = np.empty((PARAMETERS, 3, 3))
    if gradient:
        for k in range(PARAMETERS):
            moved = theta.copy()
            moved[k] += _STEP
            up = pair_homography(moved, inverse_k_i, k_j, height_i, height_j)
            moved[k] -= 2 * _STEP
            down = pair_homography(moved, inverse_k_i, k_j, height_i, height_j)
            dh[k] = (up - down) / (2 * _STEP)
    a = np.zeros((PARAMETERS, PARAMETERS))
    b = np.zeros(PARAMETERS)
    row = np.empty((2, PARAMETERS))
    cost = 0.0
    square_loss = loss * loss
    for n in range(len(p)):
        x, y = p[n, 0], p[n, 1]
        w = h[2, 0] * x + h[2, 1] * y + h[2, 2]
        if w <= 1e-12:  # behind camera j: as bad as the loss gets
            cost += 0.5 * square_loss
            continue
        u = (h[0, 0] * x + h[0, 1] * y + h[0, 2]) / w
        v = (h[1, 0] * x + h[1, 1] * y + h[1, 2]) / w
        eu, ev = u - q[n, 0], v - q[n, 1]
        r0 = whiten[n, 0, 0] * eu + whiten[n, 0, 1] * ev
        r1 = whiten[n, 1, 0] * eu + whiten[n, 1, 1] * ev
        square = r0 * r0 + r1 * r1
        shrink = 1.0 / (1.0 + square / square_loss)  # Geman-McClure
        cost += 0.5 * square * shrink
        if not gradient:
            continue
        weight = shrink * shrink
        for k in range(PARAMETERS):
            dw = dh[k, 2, 0] * x + dh[k, 2, 1] * y + dh[k, 2, 2]
            du = (dh[k, 0, 0] * x + dh[k, 0, 1] * y + dh[k, 0, 2] - u * dw) / w
            dv = (dh[k, 1, 0] * x + dh[k, 1, 1] * y + dh[k, 1, 2] - v * dw) / w
            row[0, k] = whiten[n, 0, 0] * du + whiten[n, 0, 1] * dv
            row[1, k] = whiten[n, 1, 0] * du + whiten[n, 1, 1] * dv
        for k in range(PARAMETERS):
            b[k] += weight * (row[0, k] * r0 + row[1, k] * r1)
            for m in range(k + 1):
                a[k, m] += weight * (row[0, k] * row[0, m] + row[1, k] * row[1, m])
    for k in range(PARAMETERS):
        r = (theta[k] - prior[k]) * prior_weight[k]
        # soft L1: a hint far off loses its pull instead of bending the plane
        root = np.sqrt(1.0 + r * r)
        cost += root - 1.0
        b[k] += prior_weight[k] * r / root
        a[k, k] += prior_weight[k] * prior_weight[k] / root
        for m in range(k):
            a[m, k] = a[k, m]
    return cost, a, b


@kernel
def fit_pair(
    theta: Float,
    prior: Float,
    prior_weight: Float,
    inverse_k_i: Float,
    k_j: Float,
    height_i: float,
    height_j: float,
    p: Float,
    q: Float,
    whiten: Float,
    loss: float,
    iterations: int,
) -> tuple[Float, float, Float]:
    """Levenberg-Marquardt over the eight parameters.

    Parameters
    ----------
    theta, prior, prior_weight : (8,) float64
        Start, expected value and one over its standard deviation (0 = unknown).
    inverse_k_i, k_j : (3, 3) float64
        Inverse calibration of i, calibration of j.
    height_i, height_j : float
        Configured heights, metres.
    p, q : (N, 2) float64
        Matched pixels.
    whiten : (N, 2, 2) float64
        Takes a residual in image j to unit standard deviation.
    loss : float
        Geman-McClure scale in standard deviations.
    iterations : int
        Most steps, accepted or not.

    Returns
    -------
    theta : (8,) float64
    cost : float
    information : (8, 8) float64
        Weighted J'J plus the prior's, at the returned point.
    """
    theta = theta.copy()
    damping = 1e-3
    cost, a, b = _normal_equations(
        theta, prior, prior_weight, inverse_k_i, k_j, height_i, height_j, p, q, whiten, loss, True
    )
    for _ in range(iterations):
        damped = a.copy()
        for k in range(PARAMETERS):
            damped[k, k] += damping * a[k, k] + 1e-12
        step = np.linalg.solve(damped, b)
        trial = theta - step
        new_cost, _, _ = _normal_equations(
            trial,
            prior,
            prior_weight,
            inverse_k_i,
            k_j,
            height_i,
            height_j,
            p,
            q,
            whiten,
            loss,
            False,
        )
        if new_cost < cost:
            gain = (cost - new_cost) / max(cost, 1e-30)
            theta = trial
            damping = max(damping * 0.2, 1e-9)
            cost, a, b = _normal_equations(
                theta,
                prior,
                prior_weight,
                inverse_k_i,
                k_j,
                height_i,
                height_j,
                p,
                q,
                whiten,
                loss,
                True,
            )
            if gain < 1e-7:
                break
        else:
            damping *= 8.0
            if damping > 1e6:
                break
    return theta, cost, a
