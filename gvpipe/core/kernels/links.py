"""Two-view geometry of all links of a map: placement on the ground, then fit.

Matches of all links lie one after the other: those of link e are ``start[e]:start[e + 1]``, pixels
p (M, 2) in image i and q (M, 2) in image j; `ends` (E, 2) are the numbers of these images.
"""

import numpy as np

from gvpipe.core.kernels.jit import kernel
from gvpipe.core.kernels.transfer import median_miss
from gvpipe.core.kernels.twoview import fit_pair, pair_homography
from gvpipe.core.types import Float, Index


@kernel
def ground_from_pixel(tilt: float, roll: float, height: float, inverse_k: Float) -> Float:
    """Homography (3, 3) from pixels to the robot's ground frame, metres.

    Tilt and roll are in radians, the height in metres, `inverse_k` (3, 3) is the inverse
    calibration; the third component is positive for pixels below the horizon.
    """
    s, c, sr, cr = np.sin(tilt), np.cos(tilt), np.sin(roll), np.cos(roll)
    m = np.zeros((3, 3))
    m[0, 0], m[0, 1], m[0, 2] = -s * sr * height, -s * cr * height, c * height
    m[1, 0], m[1, 1] = -cr * height, sr * height
    m[2, 0], m[2, 1], m[2, 2] = c * sr, c * cr, s
    out = np.zeros((3, 3))
    for a in range(3):
        for b in range(3):
            for k in range(3):
                out[a, b] += m[a, k] * inverse_k[k, b]
    return out


@kernel
def place_pair(
    p: Float, q: Float, ground_i: Float, ground_j: Float, height: float, rounds: int
) -> Float:
    """Isometry between two robots' ground frames from matched pixels (thesis 3.3.4).

    Parameters
    ----------
    p, q : (N, 2) float64
        Matched pixels.
    ground_i, ground_j : (3, 3) float64
        See :func:`ground_from_pixel`.
    height : float
        Of camera i, metres: far points count less.
    rounds : int
        Reweightings.

    Returns
    -------
    placement : (7,) float64
        Centroids in either frame (metres), heading of i minus that of j (radians), radius, misfit
        (metres); all NaN if fewer than three matches, or than half of them, lie below both
        horizons.
    """
    a, b = np.empty((len(p), 2)), np.empty((len(p), 2))
    n = 0
    for k in range(len(p)):
        w = ground_i[2, 0] * p[k, 0] + ground_i[2, 1] * p[k, 1] + ground_i[2, 2]
        v = ground_j[2, 0] * q[k, 0] + ground_j[2, 1] * q[k, 1] + ground_j[2, 2]
        if w > 1e-12 and v > 1e-12:
            for r in range(2):
                a[n, r] = (ground_i[r, 0] * p[k, 0] + ground_i[r, 1] * p[k, 1] + ground_i[r, 2]) / w
                b[n, r] = (ground_j[r, 0] * q[k, 0] + ground_j[r, 1] * q[k, 1] + ground_j[r, 2]) / v
            n += 1
    out = np.full(7, np.nan)
    if n < max(3, len(p) // 2):
        return out
    base, weight, miss = np.empty(n), np.empty(n), np.empty(n)
    for k in range(n):
        base[k] = 1.0 / (1.0 + (a[k, 0] ** 2 + a[k, 1] ** 2) / height**2)
        weight[k] = base[k]
    for _ in range(rounds + 1):
        total = weight.sum()
        ax, ay, bx, by = 0.0, 0.0, 0.0, 0.0
        for k in range(n):
            share = weight[k] / total
            ax, ay = ax + share * a[k, 0], ay + share * a[k, 1]
            bx, by = bx + share * b[k, 0], by + share * b[k, 1]
        cross, dot, radius = 0.0, 0.0, 0.0
        for k in range(n):
            share = weight[k] / total
            dx, dy, ex, ey = a[k, 0] - ax, a[k, 1] - ay, b[k, 0] - bx, b[k, 1] - by
            cross += share * (dx * ey - dy * ex)
            dot += share * (dx * ex + dy * ey)
            radius += share * (dx * dx + dy * dy)
        turn = np.arctan2(cross, dot)
        c, s = np.cos(turn), np.sin(turn)
        misfit = 0.0
        for k in range(n):
            dx, dy, ex, ey = a[k, 0] - ax, a[k, 1] - ay, b[k, 0] - bx, b[k, 1] - by
            miss[k] = (dx - c * ex - s * ey) ** 2 + (dy + s * ex - c * ey) ** 2
            misfit += weight[k] / total * miss[k]
        scale = 4.0 * np.median(miss) + 1e-12
        for k in range(n):
            weight[k] = base[k] / (1.0 + miss[k] / scale)
        out[:] = np.array([ax, ay, bx, by, turn, np.sqrt(radius), np.sqrt(misfit)])
    return out


@kernel
def place_links(
    start: Index, p: Float, q: Float, ends: Index, mount: Float, inverse: Float, rounds: int
) -> Float:
    """Placements (E, 7) of all links, see :func:`place_pair`.

    Tilt, roll (radians) and height (metres) `mount` (N, 3) and inverse calibrations (N, 3, 3) are
    by image.
    """
    out, ground = np.empty((len(ends), 7)), np.empty((len(mount), 3, 3))
    for k in range(len(mount)):
        ground[k] = ground_from_pixel(mount[k, 0], mount[k, 1], mount[k, 2], inverse[k])
    for e in range(len(ends)):
        i, j = ends[e, 0], ends[e, 1]
        here = slice(start[e], start[e + 1])
        out[e] = place_pair(p[here], q[here], ground[i], ground[j], mount[i, 2], rounds)
    return out


@kernel
def _fit_link(
    p: Float,
    q: Float,
    placement: Float,
    mount_i: Float,
    mount_j: Float,
    inverse_i: Float,
    matrix_j: Float,
    prior_weight: Float,
    losses: Float,
    steps: int,
    gain: float,
) -> Float:
    """Parameters (8,) of one link, see :func:`fit_links`."""
    whiten, limit = np.zeros((len(p), 2, 2)), np.full(8, np.inf)
    whiten[:, 0, 0], whiten[:, 1, 1] = 1.0, 1.0
    c, s = np.cos(placement[4]), np.sin(placement[4])
    prior = np.zeros(8)
    prior[4], prior[5], prior[6], prior[7] = mount_i[0], mount_i[1], mount_j[0], mount_j[1]
    theta = prior.copy()
    theta[0] = placement[4]
    theta[1] = placement[2] - c * placement[0] + s * placement[1]
    theta[2] = placement[3] - s * placement[0] - c * placement[1]
    for loss in losses:
        theta, _, _ = fit_pair(
            theta,
            prior,
            prior_weight,
            limit,
            inverse_i,
            matrix_j,
            mount_i[2],
            mount_j[2],
            p,
            q,
            whiten,
            loss,
            steps,
            gain,
        )
    return theta


@kernel
def fit_links(
    start: Index,
    p: Float,
    q: Float,
    ends: Index,
    placement: Float,
    mount: Float,
    matrix: Float,
    inverse: Float,
    prior_weight: Float,
    losses: Float,
    steps: int,
    gain: float,
) -> tuple[Float, Float]:
    """Two-view geometry of all links, from their placements on.

    Parameters
    ----------
    placement : (E, 7) float64
        Links whose placement is NaN are passed over.
    mount : (N, 3) float64
        Tilt, roll (radians) and height (metres) of each image.
    matrix, inverse : (N, 3, 3) float64
        Calibrations and their inverses.
    prior_weight : (8,) float64
        See :func:`fit_pair`.
    losses : (L,) float64
        Loss scales of the descents, one after the other, pixels.
    steps : int
        Most steps of a descent.
    gain : float
        Share of the cost gained in a step after which a descent ends.

    Returns
    -------
    theta : (E, 8) float64
        Parameters as in :func:`fit_pair`; NaN where there are none.
    error : (E,) float64
        Median transfer error in image j, pixels.
    """
    theta, error = np.full((len(ends), 8), np.nan), np.full(len(ends), np.inf)
    for e in range(len(ends)):
        if not np.isfinite(placement[e, 0]):
            continue
        i, j = ends[e, 0], ends[e, 1]
        a, b = p[start[e] : start[e + 1]], q[start[e] : start[e + 1]]
        theta[e] = _fit_link(
            a,
            b,
            placement[e],
            mount[i],
            mount[j],
            inverse[i],
            matrix[j],
            prior_weight,
            losses,
            steps,
            gain,
        )
        h = pair_homography(theta[e], inverse[i], matrix[j], mount[i, 2], mount[j, 2])
        error[e] = median_miss(h, a, b)
    return theta, error
