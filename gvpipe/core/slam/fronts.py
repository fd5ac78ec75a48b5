"""Sparse Cholesky factors of block matrices that hang together like places on the ground.

Places are split in two again and again by cutting the links between the halves (nested
dissection). What is eliminated first then touches only the cuts around it, and every step is dense
algebra on a small matrix, a front (multifrontal elimination). Walking the same tree back yields
exactly those blocks of the inverse that lie on the fronts, among them the covariance of every
place, without the rest of the inverse (Erisman and Tinney's selected inverse).
"""

from dataclasses import dataclass

import numpy as np

from gvpipe.core.kernels.fronts import Tree, factor_fronts, marginal_fronts, solve_fronts
from gvpipe.core.types import Float, Index, Mask

LEAF = 6
"""Places that are eliminated at once instead of being split further."""

MAX_CUT = 0.4
"""Share of a set's places above which cutting it in two gains nothing."""


class Dissection:
    """Order of elimination of a graph of places with blocks of equal size and a narrow border.

    Parameters
    ----------
    i, j : (E,) int64
        Places that share a block, each pair once, i != j.
    where : (N, 2) float64
        Rough positions; they decide on the cuts, hence on the cost only.
    size : int
        Unknowns of a place.
    border : int
        Further unknowns that every place may touch; they are eliminated last.
    """

    def __init__(self, i: Index, j: Index, where: Float, size: int, border: int = 0) -> None:
        self.i, self.j, self.size, self.border = i, j, size, border
        self.count = len(where)
        self.tree = _laid_out(i, j, *_children_first(*_split(i, j, where)), size, border)


def _split(i: Index, j: Index, where: Float) -> tuple[Index, Index]:
    """Cut the places in two again and again, all sets of a level at once.

    Returns the set (N,) that each place is left in, and the parent (F,) of each set: the cuts are
    the parents of the parts. Parents come first; the first has the parent -1.
    """
    left_in, label_of = np.empty((2, len(where)), dtype=np.int64)
    parents = [np.array([-1])]
    members, label = np.arange(len(where)), np.zeros(len(where), dtype=np.int64)
    first, count = 0, 1
    while count:
        label_of[:] = -1
        label_of[members], left_in[members] = label, first + label
        inside = (label_of[i] == label_of[j]) & (label_of[i] >= 0)
        i, j = i[inside], j[inside]
        sizes = np.bincount(label, minlength=count)
        (far_x, cut_x, cost_x), (far_y, cut_y, cost_y) = (
            _halved(members, label_of, sizes, where[:, axis], i, j) for axis in (0, 1)
        )
        by_y = (cost_y < cost_x)[label]
        side = np.where(by_y, far_y[members], far_x[members])
        cut = np.where(by_y, cut_y[members], cut_x[members])
        deeper = (sizes > LEAF) & (np.minimum(cost_x, cost_y) <= MAX_CUT * sizes)
        down = deeper[label] & ~cut
        label = (2 * (np.cumsum(deeper) - 1)[label] + side)[down]
        members = members[down]
        parents.append(first + np.repeat(np.nonzero(deeper)[0], 2))
        first, count = first + count, 2 * int(deeper.sum())
    return left_in, np.concatenate(parents)


def _halved(
    members: Index, label_of: Index, sizes: Index, along: Float, i: Index, j: Index
) -> tuple[Mask, Mask, Index]:
    """Put half of each set on either side.

    Returns the far side (N,), the fewer ends of each set's links that cross (N,), and how many
    those are (C,).
    """
    order = members[np.lexsort((along[members], label_of[members]))]
    label = label_of[order]
    far, cut = np.zeros((2, len(along)), dtype=bool)
    far[order] = np.arange(len(order)) - (np.cumsum(sizes) - sizes)[label] >= (sizes // 2)[label]
    crossing = far[i] != far[j]
    a, b = i[crossing], j[crossing]
    ends, costs = [], []
    for end in (np.where(far[a], b, a), np.where(far[a], a, b)):
        touched = np.zeros(len(along), dtype=bool)
        touched[end] = True
        ends.append(np.nonzero(touched)[0])
        costs.append(np.bincount(label_of[ends[-1]], minlength=len(sizes)))
    nearer = costs[0] <= costs[1]
    for end, taken in zip(ends, (nearer, ~nearer), strict=True):
        cut[end[taken[label_of[end]]]] = True
    return far, cut, np.minimum(*costs)


def _children_first(left_in: Index, parent: Index) -> tuple[Index, Index]:
    """Give sets new numbers, such that each one's descendants come right before it."""
    sizes = np.ones(len(parent), dtype=np.int64)
    for f in range(len(parent) - 1, 0, -1):
        sizes[parent[f]] += sizes[f]
    number = np.empty(len(parent), dtype=np.int64)
    number[0] = len(parent) - 1
    for f in range(1, len(parent), 2):  # sets come in pairs, the two halves
        number[f + 1] = number[parent[f]] - 1
        number[f] = number[f + 1] - sizes[f + 1]
    renumbered = np.full(len(parent), -1)
    renumbered[number[1:]] = number[parent[1:]]
    return number[left_in], renumbered


def _laid_out(i: Index, j: Index, front: Index, parent: Index, size: int, border: int) -> Tree:
    """Lay out what each front eliminates and touches, with the border after everything else."""
    count, fronts = len(front), len(parent)
    turn = np.argsort(front, kind="stable")
    rank = np.empty(count, dtype=np.int64)
    rank[turn] = np.arange(count)
    place_first = np.append(0, np.cumsum(np.bincount(front, minlength=fronts)))
    early, late = np.minimum(rank[i], rank[j]), np.maximum(rank[i], rank[j])
    order = np.argsort(early, kind="stable")
    early, late, at = early[order], late[order], front[turn[early[order]]]
    bound = _touched(at * count + late, parent, place_first, count)
    of, touched = np.divmod(bound, count)
    bound_first = np.searchsorted(of, np.arange(fronts + 1))

    def within(f: Index, ranks: Index) -> Index:
        """Where places lie in fronts: among the own ones, or after them among the bound ones."""
        after = np.searchsorted(bound, f * count + ranks) - bound_first[f]
        own = ranks - place_first[f]
        return np.where(ranks < place_first[f + 1], own, after + np.diff(place_first)[f])

    last = np.arange(fronts) == fronts - 1
    tail = np.full(fronts, border)
    end = size * count  # number of the first unknown of the border
    own_first, own = _unknowns(place_first, turn, size, np.where(last, tail, 0), end)
    rest = np.where(last, 0, tail)
    width = size * (np.diff(place_first) + np.diff(bound_first))
    within_parent = within(parent[of], touched)
    bound_unknowns_first, bound_unknowns = _unknowns(bound_first, turn[touched], size, rest, end)
    ends = np.append(width[parent[:-1]], 0)
    slot_first, slots = _unknowns(bound_first, within_parent, size, rest, ends)
    owns, rests = np.diff(own_first), np.diff(bound_unknowns_first)
    consumed = np.bincount(parent[:-1], rests[:-1].astype(np.float64) ** 2, minlength=fronts)
    waiting = np.cumsum(rests**2) - np.cumsum(consumed) + consumed
    return Tree(
        own_first=own_first,
        own=own,
        bound_first=bound_unknowns_first,
        bound=bound_unknowns,
        child_first=np.append(0, np.cumsum(np.bincount(parent[:-1], minlength=fronts))),
        children=np.argsort(parent[:-1], kind="stable"),
        slot_first=slot_first,
        slots=slots,
        place_first=place_first,
        places=turn,
        edge_first=np.searchsorted(at, np.arange(fronts + 1)),
        edges=np.column_stack([order, within(at, early), within(at, late)]),
        flipped=(rank[i] > rank[j])[order].astype(np.int64),
        factor_first=np.append(0, np.cumsum(owns * (owns + rests))),
        stack_size=int(waiting.max(initial=0)),
    )


def _touched(links: Index, parent: Index, place_first: Index, count: int) -> Index:
    """Places that each front touches and that are eliminated after it, as front * count + rank.

    A front touches what its own links reach and what its children leave to it.
    """
    depth = np.zeros(len(parent), dtype=np.int64)
    for f in range(len(parent) - 2, -1, -1):
        depth[f] = depth[parent[f]] + 1
    found = []
    passed = np.empty(0, dtype=np.int64)
    for level in range(int(depth.max()), -1, -1):
        own = links[depth[links // count] == level]
        front, rank = np.divmod(np.unique(np.concatenate([own, passed])), count)
        later = rank >= place_first[front + 1]
        front, rank = front[later], rank[later]
        found.append(front * count + rank)
        passed = parent[front] * count + rank
    return np.sort(np.concatenate(found))


def _unknowns(
    first: Index, places: Index, size: int, tail: Index, end: int | Index
) -> tuple[Index, Index]:
    """List the unknowns of lists of places, with as many of the border, from `end` on, after."""
    lengths = np.diff(first)
    start = np.append(0, np.cumsum(size * lengths + tail))
    out = np.empty(start[-1], dtype=np.int64)
    number = np.repeat(np.arange(len(lengths)), lengths)
    at = start[number] + size * (np.arange(len(places)) - first[number])
    for k in range(size):
        out[at + k] = size * places + k
    for k in range(int(tail.max(initial=0))):
        has = tail > k
        out[(start[1:] - tail)[has] + k] = np.broadcast_to(end, has.shape)[has] + k
    return start, out


@dataclass(frozen=True)
class Blocks:
    """A symmetric matrix on a :class:`Dissection`.

    Attributes
    ----------
    diagonal : (N, S, S) float64
        Blocks of the places.
    between : (E, S, S) float64
        Rows of place i, columns of place j.
    border : (N, S, T) float64
        Rows of places, columns of the border; T may be 0.
    corner : (T, T) float64
        The border with itself.
    """

    diagonal: Float
    between: Float
    border: Float
    corner: Float


class Factor:
    """Cholesky factors.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the matrix is not positive definite.
    """

    def __init__(self, plan: Dissection, blocks: Blocks) -> None:
        self.plan = plan
        definite, self._factors = factor_fronts(
            plan.tree,
            np.ascontiguousarray(blocks.diagonal),
            np.ascontiguousarray(blocks.between),
            np.ascontiguousarray(blocks.border),
            np.ascontiguousarray(blocks.corner),
        )
        if not definite:
            raise np.linalg.LinAlgError("the matrix is not positive definite")

    def solve(self, right: Float) -> Float:
        """Solve for right sides (S,) or (S, C)."""
        x = right.reshape(len(right), -1).astype(np.float64)
        solve_fronts(self.plan.tree, self._factors, x)
        return x.reshape(right.shape)

    def marginals(self) -> Float:
        """Blocks (N, S, S) of the inverse on its diagonal."""
        return np.asarray(marginal_fronts(self.plan.size, self.plan.tree, self._factors))
