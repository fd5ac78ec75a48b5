"""Which links agree with each other: rough placement by vote, then by least squares."""

import heapq
from dataclasses import replace

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix
from scipy.sparse.linalg import splu

from gvpipe.core.slam.placements import Index, Mask, Placements, disagreements, turned, wrapped
from gvpipe.core.types import Float

CUT = 3.0
"""A link is cut where its two images place the shared ground this many tolerances apart."""

WIDE = 10.0
"""Times that limit which images may be off before drift has been spread over the loops."""

TIGHTENING = 1.5
"""Factor from round to round by which the limit shrinks from wide to final."""

DOUBT = 1.0
"""Triangles, half of them open, added to those seen: few triangles prove little."""

TRIANGLES = 8
"""Triangles looked at per link, at most."""

SETTLED_M = 1e-6
"""Gauss-Newton stops when no image moves by more than this, metres or radians."""


def supported(links: Placements) -> Float:
    """Share of the triangles around each link that close.

    Parameters
    ----------
    links : Placements
        E links.

    Returns
    -------
    support : (E,) float64
        In (0, 1); one half for a link that is part of no triangle.

    Notes
    -----
    A wrong link opens every triangle it is part of, a right one only those it shares with a wrong
    one; so this finds most wrong links before anything is placed.
    """
    count = len(links.i)
    triangles = _triangles(links)
    if not len(triangles):
        return np.full(count, 0.5)
    ab, ac, bc = triangles.T
    a = np.where(
        (links.i[ab] == links.i[ac]) | (links.i[ab] == links.j[ac]), links.i[ab], links.j[ab]
    )
    b = links.i[ab] + links.j[ab] - a
    origin = np.zeros((len(a), 3))
    apart = _between(links, bc, _carried(links, ab, a, origin), _carried(links, ac, a, origin), b)
    allowed = CUT**2 * (links.tolerance[triangles] ** 2).sum(axis=1)
    closes = (apart**2).sum(axis=1) <= allowed
    total = np.bincount(triangles.ravel(), minlength=count)
    good = np.bincount(triangles.ravel(), np.repeat(closes, 3).astype(float), minlength=count)
    return np.asarray((good + 0.5 * DOUBT) / (total + DOUBT))


def _triangles(links: Placements) -> Index:
    """Triples (T, 3) of links that form triangles, a few for each link."""
    of_pair: dict[tuple[int, int], int] = {}
    neighbours: dict[int, set[int]] = {}
    for k, (i, j) in enumerate(zip(links.i.tolist(), links.j.tolist(), strict=True)):
        of_pair.setdefault((min(i, j), max(i, j)), k)
        neighbours.setdefault(i, set()).add(j)
        neighbours.setdefault(j, set()).add(i)
    out = []
    for (i, j), k in of_pair.items():
        for c in sorted(neighbours[i] & neighbours[j])[:TRIANGLES]:
            out.append((k, of_pair[min(i, c), max(i, c)], of_pair[min(j, c), max(j, c)]))
    return np.array(out, dtype=np.int64).reshape(-1, 3)


def _carried(links: Placements, k: Index, known: Index, planar: Float) -> Float:
    """Poses (T, 3) at the other ends of links k, from those at the `known` ends."""
    forward = links.i[k] == known
    here = np.where(forward[:, None], links.centre_i[k], links.centre_j[k])
    there = np.where(forward[:, None], links.centre_j[k], links.centre_i[k])
    heading = planar[:, 2] + np.where(forward, -links.turn[k], links.turn[k])
    at = planar[:, :2] + turned(planar[:, 2], here) - turned(heading, there)
    return np.column_stack([at, wrapped(heading)])


def _between(links: Placements, k: Index, at_b: Float, at_c: Float, b: Index) -> Float:
    """Disagreements (T, 3) of links k between poses at their ends b and at their other ends."""
    forward = (links.i[k] == b)[:, None]
    both = np.concatenate([np.where(forward, at_b, at_c), np.where(forward, at_c, at_b)])
    count = len(k)
    picked = replace(links.pick(k), i=np.arange(count), j=count + np.arange(count))
    return disagreements(picked, both)


def grow(links: Placements, count: int) -> tuple[Float, Index]:
    """Place the images one by one, each where most of its links to placed images want it.

    Parameters
    ----------
    links : Placements
        E links.
    count : int
        Images N.

    Returns
    -------
    planar : (N, 3) float64
        x, y and heading; the first image of each connected part lies at the origin.
    component : (N,) int64
        Connected part of each image.
    """
    at: list[list[int]] = [[] for _ in range(count)]
    for k, (i, j) in enumerate(zip(links.i.tolist(), links.j.tolist(), strict=True)):
        at[i].append(k)
        at[j].append(k)
    planar, component = np.zeros((count, 3)), np.full(count, -1, dtype=np.int64)
    wanted: list[list[tuple[int, Float]]] = [[] for _ in range(count)]
    part = 0
    for root in range(count):
        if component[root] >= 0:
            continue
        queue: list[tuple[float, int, int]] = [(0.0, root, 0)]
        best = {root: planar[root]}
        while queue:
            _, image, votes = heapq.heappop(queue)
            if component[image] >= 0 or votes != len(wanted[image]):
                continue
            planar[image], component[image] = best[image], part
            for k in at[image]:
                other = int(links.i[k] + links.j[k]) - image
                if component[other] >= 0:
                    continue
                one = np.array([k])
                pose = _carried(links, one, np.array([image]), planar[image][None])[0]
                wanted[other].append((k, pose))
                trust, best[other] = _vote(links, planar, other, wanted[other])
                heapq.heappush(queue, (-trust, other, len(wanted[other])))
        part += 1
    return planar, component


def _vote(
    links: Placements, planar: Float, image: int, wanted: list[tuple[int, Float]]
) -> tuple[float, Float]:
    """Pose that the most trusted of an image's links agree on, and that trust."""
    k = np.array([link for link, _ in wanted])
    poses = np.array([pose for _, pose in wanted])
    others = links.i[k] + links.j[k] - image
    best_trust, best = -1.0, poses[0]
    for pose in poses:
        here = np.broadcast_to(pose, poses.shape)
        apart = _between(links, k, here, planar[others], np.full(len(k), image))
        agrees = (apart**2).sum(axis=1) <= (WIDE * CUT * links.tolerance[k]) ** 2
        trust = float(links.trust[k[agrees]].sum())
        if trust > best_trust:
            best_trust, best = trust, pose
    return best_trust, best


def _settle(links: Placements, planar: Float, weight: Float, held: Mask, steps: int) -> Float:
    """Weighted Gauss-Newton on the placements; `held` images stay."""
    n, e = len(planar), len(links.i)
    free = np.nonzero(~np.repeat(held, 3))[0]
    if not len(free):
        return planar
    row = 3 * np.arange(e)
    root = np.sqrt(weight)[:, None]
    for _ in range(steps):
        residual = disagreements(links, planar) * root
        lever_i = turned(planar[links.i, 2] + np.pi / 2, links.centre_i)
        lever_j = turned(planar[links.j, 2] + np.pi / 2, links.centre_j)
        one = np.ones(e)
        entries = [
            (row, 3 * links.i, one),
            (row + 1, 3 * links.i + 1, one),
            (row, 3 * links.i + 2, lever_i[:, 0]),
            (row + 1, 3 * links.i + 2, lever_i[:, 1]),
            (row + 2, 3 * links.i + 2, links.radius),
            (row, 3 * links.j, -one),
            (row + 1, 3 * links.j + 1, -one),
            (row, 3 * links.j + 2, -lever_j[:, 0]),
            (row + 1, 3 * links.j + 2, -lever_j[:, 1]),
            (row + 2, 3 * links.j + 2, -links.radius),
        ]
        jacobian = csc_matrix(
            coo_matrix(
                (
                    np.concatenate([v * root[:, 0] for _, _, v in entries]),
                    (
                        np.concatenate([r for r, _, _ in entries]),
                        np.concatenate([c for _, c, _ in entries]),
                    ),
                ),
                (3 * e, 3 * n),
            )
        )[:, free]
        normal = (jacobian.T @ jacobian).tocsc()
        normal.setdiag(normal.diagonal() * (1.0 + 1e-9) + 1e-9)
        step = np.zeros(3 * n)
        step[free] = splu(normal, permc_spec="MMD_AT_PLUS_A").solve(-jacobian.T @ residual.ravel())
        planar = planar + step.reshape(n, 3)
        if np.abs(step).max() < SETTLED_M:
            break
    return planar


def agree(links: Placements, count: int) -> tuple[Float, Mask]:
    """Place all images and cut the links that contradict the others.

    Parameters
    ----------
    links : Placements
        E links.
    count : int
        Images N.

    Returns
    -------
    planar : (N, 3) float64
        x, y and heading of every image in the frame of the first of its connected part.
    keep : (E,) bool
        False for links that were cut.

    Notes
    -----
    The images are first placed by vote, then settled by least squares with the links that are
    not too far off, while the limit tightens: the drift of long chains has to spread out before
    the links that close their loops can be judged.
    """
    links = replace(links, trust=links.trust * supported(links))
    planar, component = grow(links, count)
    held = np.zeros(count, dtype=bool)
    held[np.unique(component, return_index=True)[1]] = True
    limit = WIDE
    while True:
        keep = _off(links, planar) <= limit
        planar = _settle(links, planar, keep * links.trust / links.tolerance**2, held, steps=5)
        if limit <= 1.0:
            return planar, _off(links, planar) <= 1.0
        limit = max(limit / TIGHTENING, 1.0)


def _off(links: Placements, planar: Float) -> Float:
    """Disagreement of each link over what is allowed, (E,)."""
    apart = np.linalg.norm(disagreements(links, planar), axis=1)
    return np.asarray(apart / (CUT * links.tolerance))
