"""Loops over all links of a map: placement on the ground, fit, errors, and cells of matches.

Matches of all links lie one after the other: those of link e are ``start[e]:start[e + 1]``.
"""

import heapq

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.kernels.jit import kernel
from gvpipe.core.kernels.twoview import fit_pair, pair_homography
from gvpipe.core.types import Float

Index = NDArray[np.int64]
Mask = NDArray[np.bool_]


@kernel
def ground_from_pixel(tilt: float, roll: float, height: float, inverse_k: Float) -> Float:
    """Homography (3, 3) from pixels to the robot's ground; its third component sees the horizon."""
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
        Centroids in either frame, heading of i minus that of j, radius, misfit; all NaN if fewer
        than three matches, or than half of them, lie below both horizons.
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
    start: Index, p: Float, q: Float, ends: Index, ground: Float, height: Float, rounds: int
) -> Float:
    """Placements (E, 7) of all links, see :func:`place_pair`; `ground` (N, 3, 3) by image."""
    out = np.empty((len(ends), 7))
    for e in range(len(ends)):
        i, j = ends[e, 0], ends[e, 1]
        here = slice(start[e], start[e + 1])
        out[e] = place_pair(p[here], q[here], ground[i], ground[j], height[i], rounds)
    return out


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
) -> tuple[Float, Float]:
    """Two-view geometry of all links, from their placements on.

    Parameters
    ----------
    placement : (E, 7) float64
        Links whose placement is NaN are passed over.
    mount : (N, 3) float64
        Tilt, roll and height of each image.
    matrix, inverse : (N, 3, 3) float64
        Calibrations and their inverses.
    prior_weight : (8,) float64
        See :func:`fit_pair`.
    losses : (L,) float64
        Loss scales of the descents, one after the other, pixels.
    steps : int
        Most steps of a descent.

    Returns
    -------
    theta : (E, 8) float64
        Parameters as in :func:`fit_pair`; NaN where there are none.
    error : (E,) float64
        Median transfer error in image j, pixels.
    """
    theta, error = np.full((len(ends), 8), np.nan), np.full(len(ends), np.inf)
    limit = np.full(8, np.inf)
    for e in range(len(ends)):
        if not np.isfinite(placement[e, 0]):
            continue
        i, j = ends[e, 0], ends[e, 1]
        a, b = p[start[e] : start[e + 1]], q[start[e] : start[e + 1]]
        whiten = np.zeros((len(a), 2, 2))
        whiten[:, 0, 0], whiten[:, 1, 1] = 1.0, 1.0
        c, s = np.cos(placement[e, 4]), np.sin(placement[e, 4])
        prior = np.zeros(8)
        prior[4], prior[5], prior[6], prior[7] = (
            mount[i, 0],
            mount[i, 1],
            mount[j, 0],
            mount[j, 1],
        )
        here = prior.copy()
        here[0] = placement[e, 4]
        here[1] = placement[e, 2] - c * placement[e, 0] + s * placement[e, 1]
        here[2] = placement[e, 3] - s * placement[e, 0] - c * placement[e, 1]
        for loss in losses:
            here, _, _ = fit_pair(
                here,
                prior,
                prior_weight,
                limit,
                inverse[i],
                matrix[j],
                mount[i, 2],
                mount[j, 2],
                a,
                b,
                whiten,
                loss,
                steps,
            )
        theta[e] = here
        h = pair_homography(here, inverse[i], matrix[j], mount[i, 2], mount[j, 2])
        error[e] = median_miss(h, a, b)
    return theta, error


@kernel
def median_miss(h: Float, p: Float, q: Float) -> float:
    """Median distance between mapped points and their partners; infinite beyond the horizon."""
    miss = np.empty(len(p))
    for k in range(len(p)):
        w = h[2, 0] * p[k, 0] + h[2, 1] * p[k, 1] + h[2, 2]
        u = (h[0, 0] * p[k, 0] + h[0, 1] * p[k, 1] + h[0, 2]) / w - q[k, 0]
        v = (h[1, 0] * p[k, 0] + h[1, 1] * p[k, 1] + h[1, 2]) / w - q[k, 1]
        miss[k] = np.sqrt(u * u + v * v)
        if not np.isfinite(miss[k]):
            miss[k] = np.inf
    return float(np.median(miss))


@kernel
def median_misses(start: Index, p: Float, q: Float, h: Float, which: Index) -> Float:
    """:func:`median_miss` of some links, (W,), under homographies (W, 3, 3)."""
    out = np.empty(len(which))
    for n in range(len(which)):
        here = slice(start[which[n]], start[which[n] + 1])
        out[n] = median_miss(h[n], p[here], q[here])
    return out


@kernel
def median_gaps(
    start: Index, p: Float, q: Float, map_from_i: Float, map_from_j: Float, which: Index
) -> Float:
    """Median distances (W,) between the ground points of both pixels of each match, metres."""
    out = np.empty(len(which))
    for n in range(len(which)):
        first, last = start[which[n]], start[which[n] + 1]
        gap = np.empty(last - first)
        a, b = map_from_i[n], map_from_j[n]
        for k in range(first, last):
            w = a[2, 0] * p[k, 0] + a[2, 1] * p[k, 1] + a[2, 2]
            v = b[2, 0] * q[k, 0] + b[2, 1] * q[k, 1] + b[2, 2]
            square = 0.0
            for r in range(2):
                here = (a[r, 0] * p[k, 0] + a[r, 1] * p[k, 1] + a[r, 2]) / w
                there = (b[r, 0] * q[k, 0] + b[r, 1] * q[k, 1] + b[r, 2]) / v
                square += (here - there) ** 2
            gap[k - first] = np.sqrt(square) if np.isfinite(square) else np.inf
        out[n] = np.median(gap)
    return out


@kernel
def gathered_cells(
    start: Index, p: Float, q: Float, h: Float, cells: int, stray: float
) -> tuple[Index, Float, Float, Float]:
    """Sum the matches of each link up in cells of image i.

    A cell becomes one match: the mean pixel in i, and in j where the homography takes that, moved
    by the mean of the matches' departures from the homography.

    Parameters
    ----------
    h : (E, 3, 3) float64
        Pixels of i to pixels of j, near enough to be affine within a cell.
    cells : int
        Cells each way over the box that a link's matches fill.
    stray : float
        Departures of more than this many medians are wrong matches and left out.

    Returns
    -------
    link : (C,) int64
        Link of each cell.
    points_i, points_j : (C, 2) float64
        Pixels.
    weight : (C,) float64
        Matches in it.
    """
    links = len(start) - 1
    link = np.empty(links * cells * cells, dtype=np.int64)
    points_i, points_j = np.empty((len(link), 2)), np.empty((len(link), 2))
    weight = np.empty(len(link))
    total = np.empty((cells * cells, 5))
    count = 0
    for e in range(links):
        n = start[e + 1] - start[e]
        off, miss = np.empty((n, 2)), np.empty(n)
        a, b, g = p[start[e] : start[e + 1]], q[start[e] : start[e + 1]], h[e]
        low, high = np.full(2, np.inf), np.full(2, -np.inf)
        for k in range(n):
            w = g[2, 0] * a[k, 0] + g[2, 1] * a[k, 1] + g[2, 2]
            for r in range(2):
                off[k, r] = b[k, r] - (g[r, 0] * a[k, 0] + g[r, 1] * a[k, 1] + g[r, 2]) / w
                low[r], high[r] = min(low[r], a[k, r]), max(high[r], a[k, r])
            miss[k] = np.sqrt(off[k, 0] ** 2 + off[k, 1] ** 2)
        bound = stray * np.median(miss) if n else 0.0
        total[:] = 0.0
        for k in range(n):
            if not miss[k] <= bound:
                continue
            x = int(cells * (a[k, 0] - low[0]) / (high[0] - low[0] + 1e-9))
            y = int(cells * (a[k, 1] - low[1]) / (high[1] - low[1] + 1e-9))
            row = total[min(y, cells - 1) * cells + min(x, cells - 1)]
            row[0], row[1] = row[0] + a[k, 0], row[1] + a[k, 1]
            row[2], row[3] = row[2] + off[k, 0], row[3] + off[k, 1]
            row[4] += 1.0
        for row in total:
            if row[4] > 0.0:
                x, y = row[0] / row[4], row[1] / row[4]
                w = g[2, 0] * x + g[2, 1] * y + g[2, 2]
                link[count], weight[count] = e, row[4]
                points_i[count, 0], points_i[count, 1] = x, y
                for r in range(2):
                    mapped = (g[r, 0] * x + g[r, 1] * y + g[r, 2]) / w
                    points_j[count, r] = mapped + row[2 + r] / row[4]
                count += 1
    return link[:count], points_i[:count], points_j[:count], weight[:count]


@kernel
def _carry(pose: Float, centre_here: Float, centre_there: Float, turn: float) -> Float:
    """Pose at the other end of a link, whose heading differs by `turn`."""
    heading = pose[2] + turn
    c, s, d, t = np.cos(pose[2]), np.sin(pose[2]), np.cos(heading), np.sin(heading)
    out = np.empty(3)
    out[0] = pose[0] + c * centre_here[0] - s * centre_here[1]
    out[0] -= d * centre_there[0] - t * centre_there[1]
    out[1] = pose[1] + s * centre_here[0] + c * centre_here[1]
    out[1] -= t * centre_there[0] + d * centre_there[1]
    out[2] = (heading + np.pi) % (2.0 * np.pi) - np.pi
    return out


@kernel
def _apart(
    a: Float, b: Float, centre_i: Float, centre_j: Float, turn: float, radius: float
) -> float:
    """Squared disagreement of a link between poses a of image i and b of image j."""
    c, s, d, t = np.cos(a[2]), np.sin(a[2]), np.cos(b[2]), np.sin(b[2])
    x = a[0] + c * centre_i[0] - s * centre_i[1] - b[0] - d * centre_j[0] + t * centre_j[1]
    y = a[1] + s * centre_i[0] + c * centre_i[1] - b[1] - t * centre_j[0] - d * centre_j[1]
    w = ((a[2] - b[2] - turn + np.pi) % (2.0 * np.pi) - np.pi) * radius
    return float(x * x + y * y + w * w)


@kernel
def grow_map(
    i: Index,
    j: Index,
    centre_i: Float,
    centre_j: Float,
    turn: Float,
    radius: Float,
    allowed: Float,
    trust: Float,
    first: Index,
    touching: Index,
) -> tuple[Float, Index]:
    """Place the images one by one, each where most of its links to placed images want it.

    Parameters
    ----------
    i, j, centre_i, centre_j, turn, radius, trust
        Links, as in `Placements`.
    allowed : (E,) float64
        Disagreement up to which a link supports a pose, metres.
    first, touching : (N + 1,) int64, (2 E,) int64
        Links ``touching[first[n]:first[n + 1]]`` of image n.

    Returns
    -------
    planar : (N, 3) float64
    component : (N,) int64
    """
    count = len(first) - 1
    planar, component = np.zeros((count, 3)), np.full(count, -1, dtype=np.int64)
    carried, best = np.zeros((len(i), 3)), np.zeros((count, 3))
    wanted, votes = np.empty(len(touching), dtype=np.int64), np.zeros(count, dtype=np.int64)
    part = 0
    for root in range(count):
        if component[root] >= 0:
            continue
        queue = [(0.0, root, 0)]
        while len(queue):
            _, image, seen = heapq.heappop(queue)
            if component[image] >= 0 or seen != votes[image]:
                continue
            planar[image], component[image] = best[image], part
            for k in touching[first[image] : first[image + 1]]:
                forward = i[k] == image
                other = j[k] if forward else i[k]
                if component[other] >= 0:
                    continue
                if forward:
                    carried[k] = _carry(planar[image], centre_i[k], centre_j[k], -turn[k])
                else:
                    carried[k] = _carry(planar[image], centre_j[k], centre_i[k], turn[k])
                wanted[first[other] + votes[other]] = k
                votes[other] += 1
                top = -1.0
                for n in wanted[first[other] : first[other] + votes[other]]:
                    support = 0.0
                    for m in wanted[first[other] : first[other] + votes[other]]:
                        if i[m] == other:
                            a, b = carried[n], planar[j[m]]
                        else:
                            a, b = planar[i[m]], carried[n]
                        apart = _apart(a, b, centre_i[m], centre_j[m], turn[m], radius[m])
                        if apart <= allowed[m] ** 2:
                            support += trust[m]
                    if support > top:
                        top = support
                        best[other] = carried[n]
                heapq.heappush(queue, (-top, other, votes[other]))
        part += 1
    return planar, component
