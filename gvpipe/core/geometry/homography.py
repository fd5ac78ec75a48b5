"""Plane homographies: application, linear fit, nonlinear refinement, covariance."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from gvpipe.core.types import Float


def normalise(homography: Float) -> Float:
    """Fix the scale: ``[2, 2] == 1``, or Frobenius norm 1 where that entry is negligible."""
    h = np.asarray(homography, dtype=np.float64)
    h = h / np.linalg.norm(h)
    return h / h[2, 2] if abs(h[2, 2]) > 1e-9 else h


def apply(homography: Float, points: Float) -> Float:
    """Map (N, 2) points by a (3, 3) homography; points on its horizon become infinite."""
    h = np.asarray(homography, dtype=np.float64)
    p = np.asarray(points, dtype=np.float64)
    q = p @ h[:, :2].T + h[:, 2]
    return q[:, :2] / q[:, 2:]


def local_jacobian(homography: Float, points: Float) -> Float:
    """Differentiate the mapped points by the points.

    Parameters
    ----------
    homography : (3, 3) float64
        Target from source.
    points : (N, 2) float64
        Source points.

    Returns
    -------
    jacobian : (N, 2, 2) float64
        ``(H[:2, :2] - y H[2, :2]) / w`` at each point, y the mapped point (thesis eq. 3.2.7,
        corrected).
    """
    h = np.asarray(homography, dtype=np.float64)
    q = points @ h[:, :2].T + h[:, 2]
    y, w = q[:, :2] / q[:, 2:], q[:, 2]
    return np.asarray((h[None, :2, :2] - y[:, :, None] * h[None, None, 2, :2]) / w[:, None, None])


def transfer_errors(homography: Float, points_i: Float, points_j: Float) -> Float:
    """Distance in image j between the mapped points of i and their partners, (N,) pixels."""
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.linalg.norm(apply(homography, points_i) - points_j, axis=1)
    return np.where(np.isfinite(error), error, np.inf)


def _conditioning(points: Float) -> Float:
    """Similarity that centres points and scales their mean distance to sqrt(2) (Hartley)."""
    centre = points.mean(axis=0)
    spread = np.linalg.norm(points - centre, axis=1).mean()
    s = np.sqrt(2.0) / spread if spread > 0 else 1.0
    return np.array([[s, 0.0, -s * centre[0]], [0.0, s, -s * centre[1]], [0.0, 0.0, 1.0]])


def fit_linear(points_i: Float, points_j: Float, weights: Float | None = None) -> Float | None:
    """Normalised direct linear transform (thesis eq. 3.4.4 with Hartley's conditioning).

    Parameters
    ----------
    points_i, points_j : (N, 2) float64
        Matched pixels, N >= 4.
    weights : (N,) float64, optional
        Factor on each match's two equations.

    Returns
    -------
    homography : (3, 3) float64 or None
        j from i, normalised; None if there are fewer than four matches or they do not fix a
        homography (for example all on a line).
    """
    if len(points_i) < 4:
        return None
    ti, tj = _conditioning(points_i), _conditioning(points_j)
    p, q = apply(ti, points_i), apply(tj, points_j)
    n = len(p)
    a = np.zeros((2 * n, 9))
    a[0::2, 0:2], a[0::2, 2] = p, 1.0
    a[0::2, 6:8], a[0::2, 8] = -q[:, :1] * p, -q[:, 0]
    a[1::2, 3:5], a[1::2, 5] = p, 1.0
    a[1::2, 6:8], a[1::2, 8] = -q[:, 1:] * p, -q[:, 1]
    if weights is not None:
        a *= np.repeat(weights, 2)[:, None]
    eigenvalues, vectors = np.linalg.eigh(a.T @ a)
    if not np.isfinite(eigenvalues).all() or eigenvalues[1] < 1e-12 * eigenvalues[-1]:
        return None
    return normalise(np.linalg.inv(tj) @ vectors[:, 0].reshape(3, 3) @ ti)


@dataclass(frozen=True)
class Refined:
    """A homography at its least-squares optimum.

    Attributes
    ----------
    homography : (3, 3) float64
        j from i, normalised.
    covariance : (9, 9) float64
        Of the row-major entries, scaled by the residual variance (rank 8).
    error_px : float
        RMS transfer error in image j, pixels.
    """

    homography: Float
    covariance: Float
    error_px: float


def refine(homography: Float, points_i: Float, points_j: Float, loss_px: float = 1.0) -> Refined:
    """Minimise the robust transfer error in image j by Levenberg-Marquardt.

    Parameters
    ----------
    homography : (3, 3) float64
        Start, j from i.
    points_i, points_j : (N, 2) float64
        Matched pixels, N >= 4.
    loss_px : float
        Residuals well above this are weighted down (soft L1), pixels.

    Returns
    -------
    refined : Refined
    """
    ti, tj = _conditioning(points_i), _conditioning(points_j)
    p, scale = apply(ti, points_i), tj[0, 0]
    q = apply(tj, points_j)
    start = tj @ homography @ np.linalg.inv(ti)
    start /= start[2, 2]

    def residuals(h8: Float) -> Float:
        h = np.append(h8, 1.0).reshape(3, 3)
        return np.asarray((apply(h, p) - q).ravel() / scale)

    def jacobian(h8: Float) -> Float:
        h = np.append(h8, 1.0).reshape(3, 3)
        m = p @ h[:, :2].T + h[:, 2]
        y, w = m[:, :2] / m[:, 2:], m[:, 2:]
        j = np.zeros((len(p), 2, 8))
        j[:, 0, 0:2], j[:, 0, 2:3] = p / w, 1.0 / w
        j[:, 1, 3:5], j[:, 1, 5:6] = p / w, 1.0 / w
        j[:, 0, 6:8] = -y[:, :1] * p / w
        j[:, 1, 6:8] = -y[:, 1:] * p / w
        return np.asarray(j.reshape(-1, 8) / scale)

    fit = least_squares(
        residuals, start.ravel()[:8], jacobian, method="trf", loss="soft_l1", f_scale=loss_px
    )
    h = np.append(fit.x, 1.0).reshape(3, 3)
    conditioned = np.linalg.inv(tj) @ h @ ti
    errors = transfer_errors(conditioned, points_i, points_j)
    degrees = max(2 * len(p) - 8, 1)
    variance = float((errors**2).sum()) / degrees
    j = jacobian(fit.x)
    cov8 = np.linalg.pinv(j.T @ j) * variance
    # d vec(normalised) / d h8, numerically exact enough for an 8-parameter chain rule
    step = 1e-6
    columns = []
    base = normalise(conditioned).ravel()
    for k in range(8):
        moved = fit.x.copy()
        moved[k] += step
        m = np.linalg.inv(tj) @ np.append(moved, 1.0).reshape(3, 3) @ ti
        columns.append((normalise(m).ravel() - base) / step)
    chain = np.column_stack(columns)
    return Refined(
        homography=normalise(conditioned),
        covariance=chain @ cov8 @ chain.T,
        error_px=float(np.sqrt((errors**2).mean())),
    )
