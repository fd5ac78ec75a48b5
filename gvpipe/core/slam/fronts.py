"""Sparse Cholesky factors of block matrices that hang together like places on the ground.

Places are split in two again and again by cutting the links between the halves (nested
dissection). What is eliminated first then touches only the cuts around it, and every step is dense
algebra on a small matrix, a front (multifrontal elimination). Walking the same tree back yields
exactly those blocks of the inverse that lie on the fronts, among them the covariance of every
place, without the rest of the inverse (Erisman and Tinney's selected inverse).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import dtrsm
from scipy.linalg.lapack import dpotrf, dpotri

from gvpipe.core.types import Float

Index = NDArray[np.int64]

LEAF = 12
"""Places that are eliminated at once instead of being split further."""

MAX_CUT = 0.4
"""Share of a set's places above which cutting it in two gains nothing."""


@dataclass(frozen=True)
class Front:
    """Places eliminated together.

    Attributes
    ----------
    own : (O,) int64
        Numbers of the unknowns eliminated here.
    bound : (B,) int64
        Numbers of the unknowns that they touch and that are eliminated later, in that order.
    children : list of int
        Fronts whose remainder is added here.
    slots : list of (B,) int64
        Where the children's `bound` lie among this front's `own` and `bound`.
    places : (P,) int64
        Own places; the rest of `own` are unknowns of the border.
    edges, at : (E,) int64, (E, 2) int64
        Blocks below the diagonal that are added here, and their places within the front.
    flipped : (E,) bool
        Whether they are added transposed.
    """

    own: Index
    bound: Index
    children: list[int]
    slots: list[Index]
    places: Index
    edges: Index
    at: Index
    flipped: NDArray[np.bool_]


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
        sets: list[tuple[Index, list[int]]] = []
        side = np.zeros(self.count, dtype=np.int64)
        _split(np.arange(self.count), i, j, where, side, sets)
        self.fronts = self._fronts(sets)

    def _fronts(self, sets: list[tuple[Index, list[int]]]) -> list[Front]:
        """Find what each front touches, children before parents."""
        turn = np.concatenate([own for own, _ in sets])
        rank = np.empty(self.count, dtype=np.int64)
        rank[turn] = np.arange(self.count)
        first = np.minimum(rank[self.i], rank[self.j])
        order = np.argsort(first, kind="stable")
        begin = np.searchsorted(first[order], np.append(0, np.cumsum([len(o) for o, _ in sets])))
        later = np.maximum(rank[self.i], rank[self.j])
        flipped = rank[self.i] > rank[self.j]
        tail = self.size * self.count + np.arange(self.border)
        bounds: list[Index] = []
        out = []
        done = 0
        for k, (own, children) in enumerate(sets):
            edges = order[begin[k] : begin[k + 1]]
            known = np.arange(done, done + len(own))
            done += len(own)
            bound = np.unique(np.concatenate([later[edges], *(bounds[c] for c in children)]))
            bound = bound[bound >= done]
            bounds.append(bound)
            last = k == len(sets) - 1
            here = np.append(known, bound)
            slots = []
            for c in children:
                slots.append(
                    np.concatenate(
                        [
                            self._unknowns(np.searchsorted(here, bounds[c])),
                            self.size * len(here) + np.arange(self.border),
                        ]
                    )
                )
            mine, rest = self._unknowns(own), self._unknowns(turn[bound])
            if last:
                mine = np.append(mine, tail)
            else:
                rest = np.append(rest, tail)
            at = np.column_stack([later[edges], first[edges]])
            out.append(
                Front(
                    own=mine,
                    bound=rest,
                    children=children,
                    slots=slots,
                    places=own,
                    edges=edges,
                    at=np.searchsorted(here, at),
                    flipped=~flipped[edges],
                )
            )
        return out

    def _unknowns(self, places: Index) -> Index:
        """Numbers of the unknowns of places."""
        return (self.size * places[:, None] + np.arange(self.size)).ravel()


def _split(
    members: Index,
    i: Index,
    j: Index,
    where: Float,
    side: Index,
    out: list[tuple[Index, list[int]]],
) -> int:
    """Append the sets of a dissection, parts before cuts; return the number of the last."""
    children: list[int] = []
    own = members
    if len(members) > LEAF:
        axis = int(np.argmax(np.ptp(where[members], axis=0)))
        along = members[np.argsort(where[members, axis], kind="stable")]
        side[along] = np.arange(len(along)) >= len(along) // 2
        crossing = side[i] != side[j]
        low = np.unique(np.where(side[i] == 0, i, j)[crossing])
        high = np.unique(np.where(side[i] == 0, j, i)[crossing])
        cut = low if len(low) <= len(high) else high
        if len(cut) <= MAX_CUT * len(members):
            side[cut] = 2
            own = cut
            parts = [
                (members[side[members] == s], (side[i] == s) & (side[j] == s)) for s in (0, 1)
            ]
            children = [
                _split(part, i[inside], j[inside], where, side, out) for part, inside in parts
            ]
    out.append((np.sort(own), children))
    return len(out) - 1


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
        self._lower: list[tuple[Float, Float]] = []
        left: list[Float | None] = []
        for front in plan.fronts:
            matrix = _assembled(plan, front, blocks)
            for child, slot in zip(front.children, front.slots, strict=True):
                matrix[np.ix_(slot, slot)] += left[child]
                left[child] = None
            k = len(front.own)
            upper, failed = dpotrf(matrix[:k, :k], lower=1, clean=1) if k else (matrix[:0, :0], 0)
            if failed:
                raise np.linalg.LinAlgError("the matrix is not positive definite")
            below = matrix[k:, :k]
            if k and len(front.bound):
                below = dtrsm(1.0, upper, below, side=1, lower=1, trans_a=1)
            self._lower.append((upper, below))
            left.append(matrix[k:, k:] - below @ below.T)

    def solve(self, right: Float) -> Float:
        """Solve for right sides (S,) or (S, C)."""
        x = right.reshape(len(right), -1).copy()
        for front, (pivot, below) in zip(self.plan.fronts, self._lower, strict=True):
            if len(front.own):
                x[front.own] = dtrsm(1.0, pivot, x[front.own], lower=1)
                x[front.bound] -= below @ x[front.own]
        for front, (pivot, below) in zip(self.plan.fronts[::-1], self._lower[::-1], strict=True):
            if len(front.own):
                own = x[front.own] - below.T @ x[front.bound]
                x[front.own] = dtrsm(1.0, pivot, own, lower=1, trans_a=1)
        return x.reshape(right.shape)

    def marginals(self) -> Float:
        """Blocks (N, S, S) of the inverse on its diagonal."""
        plan, size = self.plan, self.plan.size
        out = np.empty((plan.count, size, size))
        inherited: dict[int, Float] = {}
        for number in range(len(plan.fronts) - 1, -1, -1):
            front, (pivot, below) = plan.fronts[number], self._lower[number]
            k = len(front.own)
            whole = np.empty((k + len(front.bound),) * 2, order="F")
            whole[k:, k:] = inherited.pop(number, np.empty((0, 0)))
            if k:
                inverse = dpotri(pivot, lower=1)[0]
                inverse = np.tril(inverse) + np.tril(inverse, -1).T
                if len(front.bound):
                    weight = dtrsm(1.0, pivot, below, side=1, lower=1)
                    whole[k:, :k] = -whole[k:, k:] @ weight
                    whole[:k, k:] = whole[k:, :k].T
                    inverse -= weight.T @ whole[k:, :k]
                whole[:k, :k] = inverse
            for child, slot in zip(front.children, front.slots, strict=True):
                inherited[child] = whole[np.ix_(slot, slot)]
            n = len(front.places)
            own = whole[: n * size, : n * size].reshape(n, size, n, size)
            out[front.places] = own[np.arange(n), :, np.arange(n)]
        return out


def _assembled(plan: Dissection, front: Front, blocks: Blocks) -> Float:
    """Lay out the matrix of a front, children aside; only its lower triangle counts."""
    size, n = plan.size, len(front.places)
    width = len(front.own) + len(front.bound)
    inner = (width - plan.border) // size
    matrix = np.zeros((width, width), order="F")
    core = matrix[: inner * size, : inner * size].reshape(inner, size, inner, size)
    own = np.arange(n)
    core[own, :, own] = blocks.diagonal[front.places]
    values = blocks.between[front.edges]
    values = np.where(front.flipped[:, None, None], values.transpose(0, 2, 1), values)
    core[front.at[:, 0], :, front.at[:, 1]] = values
    if plan.border:
        rows = blocks.border[front.places].reshape(n * size, plan.border)
        matrix[inner * size :, : n * size] = rows.T
        if not len(front.bound):
            matrix[inner * size :, inner * size :] = blocks.corner
    return matrix
