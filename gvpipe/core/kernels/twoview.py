"""Fit of the camera pair over a common ground plane: homography, residuals, damped least squares.

The eight parameters, in order: yaw, x, y and log scale of ``ground_j_from_ground_i``, then
tilt and roll of camera i, tilt and roll of camera j. They are as many as a plane homography has,
so any homography between two views of the ground is reached, but each of them means something and
can be held near what is known of it.
"""

import numpy as np

from gvpipe.core.kernels.jit import kernel
from gvpipe.core.types import Float

_WALL = 0.01  # width of the wall at a parameter's limit, radians (or log units)
_STEP = 1e-7  # finite difference of the homography's entries: relative error 1e-7, steers only


@kernel
def _product(a: Float, b: Float) -> Float:
    """Product of two (3, 3) matrices, without a library call for 27 multiplications."""
    c = np.zeros((3, 3))
    for r in range(3):
        for k in range(3):
            for m in range(3):
                c[r, m] += a[r, k] * b[k, m]
    return c


@kernel
def _solve(a: Float, b: Float) -> Float:
    """Solve a positive definite system by Cholesky's factors; `a` is overwritten."""
    n = len(b)
    x = b.copy()
    for k in range(n):
        for m in range(k):
            a[k, k] -= a[k, m] * a[k, m]
        a[k, k] = np.sqrt(max(a[k, k], 1e-300))
        for r in range(k + 1, n):
            for m in range(k):
                a[r, k] -= a[r, m] * a[k, m]
            a[r, k] /= a[k, k]
    for k in range(n):
        for m in range(k):
            x[k] -= a[k, m] * x[m]
        x[k] /= a[k, k]
    for k in range(n - 1, -1, -1):
        for m in range(k + 1, n):
            x[k] -= a[m, k] * x[m]
        x[k] /= a[k, k]
    return x


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
    return _product(k_j, _product(camera_j, _product(between, _product(ground_i, inverse_k_i))))


@kernel
def _add_prior(
    theta: Float, prior: Float, prior_weight: Float, limit: Float, cost: float, a: Float, b: Float
) -> float:
    """Add the prior to J'J and J'r, in place, and to the cost."""
    for k in range(len(theta)):
        r = (theta[k] - prior[k]) * prior_weight[k]
        # soft L1: a hint far off loses its pull instead of bending the plane
        root = np.sqrt(1.0 + r * r)
        cost += root - 1.0
        b[k] += prior_weight[k] * r / root
        a[k, k] += prior_weight[k] * prior_weight[k] / root
        off = theta[k] - prior[k]
        excess = abs(off) - limit[k]
        if excess > 0.0:
            cost += 0.5 * (excess / _WALL) ** 2
            b[k] += np.sign(off) * excess / (_WALL * _WALL)
            a[k, k] += 1.0 / (_WALL * _WALL)
    return cost


@kernel
def _normal_equations(
    theta: Float,
    prior: Float,
    prior_weight: Float,
    limit: Float,
    inverse_k_i: Float,
    k_j: Float,
    height_i: float,
    height_j: float,
    p: Float,
    q: Float,
    whiten: Float,
    loss: float,
) -> tuple[float, Float, Float]:
    """Cost, J'J and J'r of the robustly weighted, whitened residuals."""
    size = len(theta)
    h = pair_homography(theta, inverse_k_i, k_j, height_i, height_j)
    dh = np.empty((size, 3, 3))
    for k in range(size):
        moved = theta.copy()
        moved[k] += _STEP
        forward = pair_homography(moved, inverse_k_i, k_j, height_i, height_j)
        for r in range(3):
            for c in range(3):
                dh[k, r, c] = (forward[r, c] - h[r, c]) / _STEP
    a = np.zeros((size, size))
    b = np.zeros(size)
    row = np.empty((2, size))
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
        weight = shrink * shrink
        for k in range(size):
            dw = dh[k, 2, 0] * x + dh[k, 2, 1] * y + dh[k, 2, 2]
            du = (dh[k, 0, 0] * x + dh[k, 0, 1] * y + dh[k, 0, 2] - u * dw) / w
            dv = (dh[k, 1, 0] * x + dh[k, 1, 1] * y + dh[k, 1, 2] - v * dw) / w
            row[0, k] = whiten[n, 0, 0] * du + whiten[n, 0, 1] * dv
            row[1, k] = whiten[n, 1, 0] * du + whiten[n, 1, 1] * dv
        for k in range(size):
            b[k] += weight * (row[0, k] * r0 + row[1, k] * r1)
            for m in range(k + 1):
                a[k, m] += weight * (row[0, k] * row[0, m] + row[1, k] * row[1, m])
    cost = _add_prior(theta, prior, prior_weight, limit, cost, a, b)
    for k in range(size):
        for m in range(k):
            a[m, k] = a[k, m]
    return cost, a, b


@kernel
def fit_pair(
    theta: Float, prior: Float, prior_weight: Float, limit: Float, inverse_k_i: Float, k_j: Float,
    height_i: float, height_j: float, p: Float, q: Float, whiten: Float,
    loss: float, iterations: int, gain: float,
) -> tuple[Float, float, Float]:  # fmt: skip
    """Levenberg-Marquardt over the eight parameters.

    Parameters
    ----------
    theta, prior, prior_weight : (8,) float64
        Start, expected value and one over its standard deviation (0 = unknown).
    limit : (8,) float64
        Largest departure from the expected value; a steep wall stands there.
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
    gain : float
        Share of the cost gained in a step after which the descent ends.

    Returns
    -------
    theta : (8,) float64
    cost : float
    information : (8, 8) float64
        Weighted J'J plus the prior's, at the returned point.
    """
    size = len(theta)
    trial = theta.copy()
    damping = 1e-3
    cost = np.inf
    a, b = np.eye(size), np.zeros(size)
    for _ in range(iterations + 1):
        new_cost, new_a, new_b = _normal_equations(
            trial, prior, prior_weight, limit, inverse_k_i, k_j, height_i, height_j,
            p, q, whiten, loss,
        )  # fmt: skip
        if new_cost < cost:
            settled = cost - new_cost < gain * cost
            theta, cost, a, b = trial, new_cost, new_a, new_b
            damping = max(damping * 0.2, 1e-9)
            if settled:
                break
        else:
            damping *= 8.0
            if damping > 1e6:
                break
        damped = a.copy()
        for k in range(size):
            damped[k, k] += damping * a[k, k] + 1e-12
        step = _solve(damped, b)
        trial = theta.copy()
        for k in range(size):
            trial[k] -= step[k]
    return theta, cost, a
