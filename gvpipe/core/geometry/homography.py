"""Plane homographies: application, derivatives, errors and linear fit."""

import numpy as np

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
    """Distances in image j between mapped points of i and their partners.

    Parameters
    ----------
    homography : (3, 3) float64
        Pixels of i to pixels of j.
    points_i, points_j : (N, 2) float64
        Matched pixels.

    Returns
    -------
    errors : (N,) float64
        Pixels; infinite for points that the homography takes to infinity.
    """
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
