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

from gvpipe.core.kernels.fronts import Tree, factor_fronts, marginal_fronts, solve_fronts
from gvpipe.core.types import Float

Index = NDArray[np.int64]

LEAF = 6
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
    edges : (E, 3) int64
        Blocks below the diagonal that are added here, and their rows and columns among its places.
    flipped : (E,) int64
        1 where they are added transposed.
    """

    own: Index
    bound: Index
    children: list[int]
    slots: list[Index]
    places: Index
    edges: Index
    flipped: Index


def _laid_out(fronts: list[Front]) -> Tree:
    """Lay the lists of the fronts out one after the other."""
    slot: list[Index] = [np.empty(0, dtype=np.int64) for _ in fronts]
    for front in fronts:
        for child, where in zip(front.children, front.slots, strict=True):
            slot[child] = where
    own, bound = [x.own for x in fronts], [x.bound for x in fronts]
    rest = np.array([len(x) for x in bound])
    sizes = [len(x) * (len(x) + r) for x, r in zip(own, rest.tolist(), strict=True)]
    waiting, most = 0, 0
    for k, front in enumerate(fronts):
        waiting += int(rest[k] ** 2)
        most = max(most, waiting)
        waiting -= int((rest[front.children] ** 2).sum())
    return Tree(
        *_joined(own),
        *_joined(bound),
        *_joined([np.array(x.children, dtype=np.int64) for x in fronts]),
        *_joined(slot),
        *_joined([x.places for x in fronts]),
        _joined([x.flipped for x in fronts])[0],
        np.concatenate([x.edges for x in fronts]),
        np.concatenate([x.flipped for x in fronts]),
        np.cumsum([0, *sizes], dtype=np.int64),
        most,
    )


def _joined(lists: list[Index]) -> tuple[Index, Index]:
    """Beginnings of lists, and the lists one after the other."""
    first = np.cumsum([0, *map(len, lists)], dtype=np.int64)
    return first, np.concatenate(lists).astype(np.int64)


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
        self.tree = _laid_out(self._fronts(sets))

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
            at = np.searchsorted(here, np.column_stack([later[edges], first[edges]]))
            out.append(
                Front(
                    own=mine,
                    bound=rest,
                    children=children,
                    slots=slots,
                    places=own,
                    edges=np.column_stack([edges, at]),
                    flipped=(~flipped[edges]).astype(np.int64),
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
        across = [_halved(members, i, j, where[:, axis], side) for axis in (0, 1)]
        cut = _halved(members, i, j, where[:, int(len(across[1]) < len(across[0]))], side)
        if len(cut) <= MAX_CUT * len(members):
            side[cut] = 2
            own = cut
            parts = [(members[side[members] == s], (side[i] == s) & (side[j] == s)) for s in (0, 1)]
            children = [
                _split(part, i[inside], j[inside], where, side, out) for part, inside in parts
            ]
    out.append((np.sort(own), children))
    return len(out) - 1


def _halved(members: Index, i: Index, j: Index, along: Float, side: Index) -> Index:
    """Put half of the members on either side; return the fewer ends of links that cross."""
    order = members[np.argsort(along[members], kind="stable")]
    side[order] = np.arange(len(order)) >= len(order) // 2
    crossing = side[i] != side[j]
    low = np.unique(np.where(side[i] == 0, i, j)[crossing])
    high = np.unique(np.where(side[i] == 0, j, i)[crossing])
    return low if len(low) <= len(high) else high


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
