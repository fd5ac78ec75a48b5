"""Which links agree with each other: rough placement by vote, then by least squares."""

from dataclasses import replace

import numpy as np

from gvpipe.core.kernels.growth import grow_map
from gvpipe.core.slam.fronts import Blocks, Dissection, Factor
from gvpipe.core.slam.placements import Placements, disagreements, turned, wrapped
from gvpipe.core.types import Float, Index, Mask

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

STEPS = 3
"""Gauss-Newton steps of the first round, at most."""

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
        x, y (metres) and heading (radians); the first image of each connected part lies at the
        origin.
    component : (N,) int64
        Connected part of each image.
    """
    ends = np.column_stack([links.i, links.j]).ravel()
    order = np.argsort(ends, kind="stable")
    planar, component = grow_map(
        links.i,
        links.j,
        np.ascontiguousarray(links.centre_i),
        np.ascontiguousarray(links.centre_j),
        np.ascontiguousarray(links.turn),
        np.ascontiguousarray(links.radius),
        WIDE * CUT * links.tolerance,
        links.trust,
        np.searchsorted(ends[order], np.arange(count + 1)),
        order // 2,
    )
    return np.asarray(planar), np.asarray(component)


def _planned(links: Placements, planar: Float) -> tuple[Dissection, Index]:
    """Plan the elimination of all images; block of each link (E,)."""
    count = len(planar)
    keys = np.minimum(links.i, links.j) * count + np.maximum(links.i, links.j)
    pairs, block = np.unique(keys, return_inverse=True)
    return Dissection(pairs // count, pairs % count, _seen(links, planar), size=3), block


def _settle(
    links: Placements,
    planar: Float,
    weight: Float,
    held: Mask,
    planned: tuple[Dissection, Index],
    steps: int,
) -> Float:
    """Weighted Gauss-Newton on the placements; `held` images stay."""
    plan, pair = planned
    for _ in range(steps):
        residual = disagreements(links, planar)
        at_i = _change(links.radius, planar[links.i, 2], links.centre_i)
        at_j = -_change(links.radius, planar[links.j, 2], links.centre_j)
        diagonal, right = np.zeros((len(planar), 3, 3)), np.zeros((len(planar), 3))
        for end, change in ((links.i, at_i), (links.j, at_j)):
            heavy = weight[:, None, None] * change
            np.add.at(diagonal, end, heavy.transpose(0, 2, 1) @ change)
            np.add.at(right, end, -np.einsum("eki,ek->ei", heavy, residual))
        mixed = weight[:, None, None] * at_i.transpose(0, 2, 1) @ at_j
        between = np.zeros((len(plan.i), 3, 3))
        forward = (links.i < links.j)[:, None, None]
        np.add.at(between, pair, np.where(forward, mixed, mixed.transpose(0, 2, 1)))
        # the frame is free: whatever holds the first image of a part at its place moves nothing
        diagonal[held] += np.eye(3) * (1.0 + diagonal.max(initial=0.0))
        # and an image all of whose links have been cut stays where it is
        diagonal += np.eye(3) * (1e-9 + 1e-9 * diagonal)
        blocks = Blocks(diagonal, between, np.empty((len(planar), 3, 0)), np.empty((0, 0)))
        step = Factor(plan, blocks).solve(right.ravel()).reshape(-1, 3)
        planar = planar + step
        if np.abs(step).max(initial=0.0) < SETTLED_M:
            break
    return planar


def _seen(links: Placements, planar: Float) -> Float:
    """Middle of the ground (N, 2) that each image shares with others: what is linked lies near."""
    total, count = np.zeros((len(planar), 2)), np.zeros(len(planar))
    for end, centre in ((links.i, links.centre_i), (links.j, links.centre_j)):
        np.add.at(total, end, centre)
        np.add.at(count, end, 1.0)
    return planar[:, :2] + turned(planar[:, 2], total / np.maximum(count, 1.0)[:, None])


def _change(radius: Float, heading: Float, centre: Float) -> Float:
    """Differentiate :func:`disagreements` by the pose of image i, (E, 3, 3)."""
    out = np.zeros((len(radius), 3, 3))
    out[:, 0, 0] = out[:, 1, 1] = 1.0
    out[:, :2, 2] = turned(heading + np.pi / 2, centre)
    out[:, 2, 2] = radius
    return out


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
        x, y (metres) and heading (radians) of every image in the frame of the first of its
        connected part.
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
    planned = _planned(links, planar)
    limit = WIDE
    while True:
        keep = _off(links, planar) <= limit
        weight = keep * links.trust / links.tolerance**2
        # headings are nearly right after the first round, and the rest is linear
        steps = STEPS if limit == WIDE else 1
        planar = _settle(links, planar, weight, held, planned, steps)
        if limit <= 1.0:
            return planar, _off(links, planar) <= 1.0
        limit = max(limit / TIGHTENING, 1.0)


def _off(links: Placements, planar: Float) -> Float:
    """Disagreement of each link over what is allowed, (E,)."""
    apart = np.linalg.norm(disagreements(links, planar), axis=1)
    return np.asarray(apart / (CUT * links.tolerance))
