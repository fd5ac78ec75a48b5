"""Multifrontal Cholesky factors, solution and selected inverse on a tree of dense fronts.

Fronts are numbered children before parents; lists of lists are laid out one after the other with
the beginnings in an array that ends in ``first``. A front's matrix has its own unknowns first, then
those of its bound; its upper half counts. Remainders wait on a stack: those of a front's children
lie on top of it.
"""

from typing import NamedTuple

import numpy as np

from gvpipe.core.kernels.jit import kernel
from gvpipe.core.types import Float, Index

STRIP, PANEL = 32, 192
"""Rows that are eliminated before the rest of their panel is updated in one product, and rows of a
panel, after which the rest of the matrix is."""

ROWS = 64
"""Rows of such a product at a time: what stays in the cache, and of the lower half little."""


class Tree(NamedTuple):
    """All fronts.

    Attributes
    ----------
    own_first, own : (F + 1,) int64, (S,) int64
        Numbers of the unknowns that each front eliminates.
    bound_first, bound : (F + 1,) int64, (B,) int64
        Numbers of the unknowns that they touch and that are eliminated later, in that order.
    child_first, children : (F + 1,) int64, (F - roots,) int64
        Fronts whose remainder is added to each front.
    slot_first, slots : (F + 1,) int64, (B,) int64
        Where each front's bound lies within its parent.
    place_first, places : (F + 1,) int64, (N,) int64
        Places that each front eliminates.
    edge_first, edges : (F + 1,) int64, (E, 3) int64
        Block, and its row and column among the places of each front.
    flipped : (E,) int64
        1 where the block is added transposed.
    factor_first : (F + 1,) int64
        Beginnings of the factors.
    stack_size : int
        Numbers that remainders take at most.
    """

    own_first: Index
    own: Index
    bound_first: Index
    bound: Index
    child_first: Index
    children: Index
    slot_first: Index
    slots: Index
    place_first: Index
    places: Index
    edge_first: Index
    edges: Index
    flipped: Index
    factor_first: Index
    stack_size: int


@kernel
def _eliminate_strip(matrix: Float, begin: int, end: int) -> bool:
    """Turn a few rows into those of the factor; four at a time update the others of the strip."""
    width = len(matrix)
    for first in range(begin, end, 4):
        last = min(first + 4, end)
        for c in range(first, last):
            row = matrix[c]
            if not row[c] > 0.0:
                return False
            pivot = np.sqrt(row[c])
            for k in range(c, width):
                row[k] /= pivot
            # the last rows of a strip may be fewer than four, and then none is left to update
            for m in range(c + 1, last):
                other, value = matrix[m], row[m]
                for k in range(m, width):
                    other[k] -= value * row[k]
        for m in range(last, end):
            r0, r1, r2, r3 = matrix[first], matrix[first + 1], matrix[first + 2], matrix[first + 3]
            a, b, c, d, other = r0[m], r1[m], r2[m], r3[m], matrix[m]
            for k in range(m, width):
                other[k] -= a * r0[k] + b * r1[k] + c * r2[k] + d * r3[k]
    return True


@kernel
def _subtract(matrix: Float, begin: int, end: int, stop: int) -> None:
    """Subtract what the eliminated rows from `begin` to `end` leave in those from there on."""
    if end >= stop:
        return
    panel = matrix[begin:end, end:].T.copy()
    for r in range(end, stop, ROWS):
        last = min(r + ROWS, stop)
        matrix[r:last, r:] -= np.dot(panel[r - end : last - end], panel[r - end :].T)


@kernel
def _eliminate(matrix: Float, count: int) -> bool:
    """Eliminate the first unknowns of a dense symmetric matrix, of which the upper half counts.

    Their rows become those of the Cholesky factor, the rest the Schur complement; False if the
    matrix is not positive definite.
    """
    for begin in range(0, count, PANEL):
        end = min(begin + PANEL, count)
        for first in range(begin, end, STRIP):
            last = min(first + STRIP, end)
            if not _eliminate_strip(matrix, first, last):
                return False
            _subtract(matrix, first, last, end)
        _subtract(matrix, begin, end, len(matrix))
    return True


@kernel
def _assembled(
    tree: Tree, front: int, diagonal: Float, between: Float, bordering: Float, corner: Float
) -> Float:
    """Matrix of a front without the remainders of its children, upper half."""
    width = tree.own_first[front + 1] - tree.own_first[front]
    width += tree.bound_first[front + 1] - tree.bound_first[front]
    size = diagonal.shape[1]
    matrix = np.zeros((width, width))
    edge = width - len(corner)  # where the border begins
    for n in range(tree.place_first[front], tree.place_first[front + 1]):
        at, place = size * (n - tree.place_first[front]), tree.places[n]
        for a in range(size):
            for b in range(size):
                matrix[at + a, at + b] = diagonal[place, a, b]
            for b in range(len(corner)):
                matrix[at + a, edge + b] = bordering[place, a, b]
    if front == len(tree.own_first) - 2:
        matrix[edge:, edge:] = corner
    for e in range(tree.edge_first[front], tree.edge_first[front + 1]):
        block = between[tree.edges[e, 0]]
        row, column = size * tree.edges[e, 1], size * tree.edges[e, 2]
        for a in range(size):
            for b in range(size):
                matrix[row + a, column + b] = block[b, a] if tree.flipped[e] else block[a, b]
    return matrix


@kernel
def factor_fronts(
    tree: Tree, diagonal: Float, between: Float, bordering: Float, corner: Float
) -> tuple[bool, Float]:
    """Cholesky factors of all fronts, one after the other.

    Parameters
    ----------
    tree : Tree
        The fronts.
    diagonal, between, bordering, corner
        See `Blocks`.

    Returns
    -------
    definite : bool
    factors : (L,) float64
        Own rows of each front over all its unknowns, row by row.
    """
    factors, stack = np.empty(tree.factor_first[-1]), np.empty(tree.stack_size)
    top = 0
    for f in range(len(tree.own_first) - 1):
        own = tree.own_first[f + 1] - tree.own_first[f]
        matrix = _assembled(tree, f, diagonal, between, bordering, corner)
        for n in range(tree.child_first[f + 1] - 1, tree.child_first[f] - 1, -1):
            c = tree.children[n]
            slot = tree.slots[tree.slot_first[c] : tree.slot_first[c + 1]]
            top -= len(slot) * len(slot)
            k = top
            for a in range(len(slot)):
                row = matrix[slot[a]]
                for b in range(a, len(slot)):
                    row[slot[b]] += stack[k + b]
                k += len(slot)
        if not _eliminate(matrix, own):
            return False, factors
        factors[tree.factor_first[f] : tree.factor_first[f + 1]] = matrix[:own].ravel()
        for a in range(own, len(matrix)):
            stack[top : top + len(matrix) - own] = matrix[a, own:]
            top += len(matrix) - own
    return True, factors


@kernel
def solve_fronts(tree: Tree, factors: Float, x: Float) -> None:
    """Solve for right sides (S, C) in place."""
    fronts = len(tree.own_first) - 1
    for f in range(fronts):
        here = tree.own[tree.own_first[f] : tree.own_first[f + 1]]
        there = tree.bound[tree.bound_first[f] : tree.bound_first[f + 1]]
        width = len(here) + len(there)
        rows = factors[tree.factor_first[f] : tree.factor_first[f + 1]].reshape(-1, max(width, 1))
        for s in range(x.shape[1]):
            y = np.zeros(width)
            for a in range(len(here)):
                y[a] += x[here[a], s]
                y[a] /= rows[a, a]
                x[here[a], s] = y[a]
                for b in range(a + 1, width):
                    y[b] -= y[a] * rows[a, b]
            for b in range(len(there)):
                x[there[b], s] += y[len(here) + b]
    for f in range(fronts - 1, -1, -1):
        here = tree.own[tree.own_first[f] : tree.own_first[f + 1]]
        there = tree.bound[tree.bound_first[f] : tree.bound_first[f + 1]]
        width = len(here) + len(there)
        rows = factors[tree.factor_first[f] : tree.factor_first[f + 1]].reshape(-1, max(width, 1))
        for s in range(x.shape[1]):
            y = np.empty(width)
            for b in range(len(there)):
                y[len(here) + b] = x[there[b], s]
            for a in range(len(here) - 1, -1, -1):
                value = x[here[a], s]
                for b in range(a + 1, width):
                    value -= rows[a, b] * y[b]
                y[a] = value / rows[a, a]
                x[here[a], s] = y[a]


@kernel
def _inverse_upper(rows: Float) -> Float:
    """Inverse of the upper triangle at the beginning of some rows."""
    n = len(rows)
    out = np.zeros((n, n))
    for r in range(n - 1, -1, -1):
        for m in range(r + 1, n):
            for c in range(m, n):
                out[r, c] -= rows[r, m] * out[m, c]
        for c in range(r + 1, n):
            out[r, c] /= rows[r, r]
        out[r, r] = 1.0 / rows[r, r]
    return out


@kernel
def marginal_fronts(size: int, tree: Tree, factors: Float) -> Float:
    """Blocks (N, size, size) of the inverse on its diagonal; `factors` as of `factor_fronts`.

    With the inverse known on a front's bound, that on its own unknowns follows from its factor.
    """
    out = np.empty((len(tree.places), size, size))
    stack = np.empty(2 * tree.stack_size)
    top = 0
    for f in range(len(tree.own_first) - 2, -1, -1):
        own = tree.own_first[f + 1] - tree.own_first[f]
        rest = tree.bound_first[f + 1] - tree.bound_first[f]
        whole = np.empty((own + rest, own + rest))
        top -= rest * rest
        known = stack[top : top + rest * rest].copy().reshape(rest, rest)
        whole[own:, own:] = known
        if own:
            rows = factors[tree.factor_first[f] : tree.factor_first[f + 1]].reshape(own, own + rest)
            back = _inverse_upper(rows)
            inverse = np.dot(back, back.T)
            if rest:
                weight = np.dot(back, rows[:, own:].copy())
                across = np.dot(weight, known)
                whole[:own, own:] = -across
                whole[own:, :own] = -across.T
                inverse = inverse + np.dot(across, weight.T)
            whole[:own, :own] = inverse
        for n in range(tree.child_first[f], tree.child_first[f + 1]):
            c = tree.children[n]
            slot = tree.slots[tree.slot_first[c] : tree.slot_first[c + 1]]
            for a in range(len(slot)):
                row = whole[slot[a]]
                for b in range(len(slot)):
                    stack[top + b] = row[slot[b]]
                top += len(slot)
        for n in range(tree.place_first[f], tree.place_first[f + 1]):
            at = size * (n - tree.place_first[f])
            out[tree.places[n]] = whole[at : at + size, at : at + size]
    return out
