"""Which links agree with each other: rough placement of all images by graduated robust fitting."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csc_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.sparse.linalg import splu

from gvpipe.core.types import Float

Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

CUT = 3.0
"""A link is cut where its two images place the shared ground this many tolerances apart."""

RELAXATION = 1.4
"""Factor of the non-convexity parameter from round to round (Yang et al. 2020)."""

SETTLED_M = 1e-6
"""Gauss-Newton stops when no image moves by more than this, metres or radians."""


@dataclass(frozen=True)
class Placements:
    """What each link says about where its two robots stand on the ground.

    Attributes
    ----------
    i, j : (E,) int64
        Images of each link.
    centre_i, centre_j : (E, 2) float64
        Centroid of the shared ground points in the robot frames of i and of j, metres.
    turn : (E,) float64
        Heading of i minus heading of j, radians.
    radius : (E,) float64
        RMS distance of the shared points from their centroid, metres: turns a difference of
        heading into one of position.
    tolerance : (E,) float64
        How far apart the two placements may be on average, metres.
    trust : (E,) float64
        Weight in the vote on which links to cut.
    """

    i: Index
    j: Index
    centre_i: Float
    centre_j: Float
    turn: Float
    radius: Float
    tolerance: Float
    trust: Float

    def pick(self, keep: Mask) -> "Placements":
        """Return the links under a mask."""
        return Placements(*(getattr(self, name)[keep] for name in self.__dataclass_fields__))


def _turned(heading: Float, points: Float) -> Float:
    """Points (E, 2) turned counter-clockwise by headings (E,)."""
    c, s = np.cos(heading), np.sin(heading)
    return np.column_stack(
        [c * points[:, 0] - s * points[:, 1], s * points[:, 0] + c * points[:, 1]]
    )


def _wrapped(angle: Float) -> Float:
    return np.asarray((angle + np.pi) % (2.0 * np.pi) - np.pi)


def disagreements(links: Placements, planar: Float) -> Float:
    """Tell how far apart the two images of each link place their shared ground.

    Parameters
    ----------
    links : Placements
        E links.
    planar : (N, 3) float64
        x, y (metres) and heading (radians) of every robot.

    Returns
    -------
    residuals : (E, 3) float64
        Difference of the centroids (two components) and of heading times radius, metres. The
        norm of a row is the RMS distance between the two placements of the points.
    """
    a, b = planar[links.i], planar[links.j]
    apart = (
        a[:, :2] + _turned(a[:, 2], links.centre_i) - b[:, :2] - _turned(b[:, 2], links.centre_j)
    )
    turn = _wrapped(a[:, 2] - b[:, 2] - links.turn) * links.radius
    return np.column_stack([apart, turn])


def spread_along_tree(links: Placements, count: int) -> tuple[Float, Index]:
    """Place every image along the tree of the most trusted links, breadth first.

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
    cost = 1.0 / links.trust
    # parallel links: keep the most trusted one (a sparse matrix would add them up)
    order = np.lexsort((cost, links.j, links.i))
    ends = np.column_stack([links.i, links.j])[order]
    fresh = np.any(np.diff(ends, axis=0, prepend=-1) != 0, axis=1)
    chosen = order[fresh]
    graph = coo_matrix((cost[chosen], (links.i[chosen], links.j[chosen])), (count, count))
    tree = minimum_spanning_tree(graph.tocsr())
    of_pair = {(int(links.i[k]), int(links.j[k])): int(k) for k in chosen}
    parts, component = connected_components(tree, directed=False)
    planar = np.zeros((count, 3))
    for part in range(parts):
        root = int(np.argmax(component == part))
        sequence, parent = breadth_first_order(tree, root, directed=False)
        for child in sequence[1:]:
            planar[child] = _placed(links, of_pair, planar, int(parent[child]), int(child))
    return planar, component.astype(np.int64)


def _placed(
    links: Placements, of_pair: dict[tuple[int, int], int], planar: Float, parent: int, child: int
) -> Float:
    """Pose (3,) of a child from its parent's."""
    forward = (parent, child) in of_pair
    k = of_pair[parent, child] if forward else of_pair[child, parent]
    here, there = (
        (links.centre_i[k], links.centre_j[k])
        if forward
        else (links.centre_j[k], links.centre_i[k])
    )
    heading = planar[parent, 2] + (-links.turn[k] if forward else links.turn[k])
    at = planar[parent, :2] + _turned(planar[parent, 2:], here[None])[0]
    return np.append(at - _turned(np.array([heading]), there[None])[0], _wrapped(heading))


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
        lever_i = _turned(planar[links.i, 2] + np.pi / 2, links.centre_i)
        lever_j = _turned(planar[links.j, 2] + np.pi / 2, links.centre_j)
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
    Graduated non-convexity with the truncated least squares loss (Yang, Antonante, Tzoumas and
    Carlone, 2020): from plain least squares the loss is bent step by step until every link counts
    either fully or not at all.
    """
    planar, component = spread_along_tree(links, count)
    held = np.zeros(count, dtype=bool)
    held[np.unique(component, return_index=True)[1]] = True
    precision = links.trust / links.tolerance**2
    planar = _settle(links, planar, precision, held, steps=20)
    ratio = (disagreements(links, planar) ** 2).sum(axis=1) / (CUT * links.tolerance) ** 2
    weight = np.ones(len(ratio))
    worst = float(ratio.max(initial=0.0))
    bend = 1.0 / (2.0 * worst - 1.0) if worst > 1.0 else np.inf
    while bend < np.inf:
        weight = np.clip(np.sqrt(bend * (bend + 1.0) / np.maximum(ratio, 1e-12)) - bend, 0.0, 1.0)
        planar = _settle(links, planar, precision * weight, held, steps=3)
        ratio = (disagreements(links, planar) ** 2).sum(axis=1) / (CUT * links.tolerance) ** 2
        if ((weight < 1e-6) | (weight > 1.0 - 1e-6)).all() or bend > 1e4:
            break
        bend *= RELAXATION
    return planar, ratio <= 1.0
