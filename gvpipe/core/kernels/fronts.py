"""Multifrontal Cholesky factors, solution and selected inverse on a tree of dense fronts.

Fronts are numbered children before parents; lists of lists are laid out one after the other with
the beginnings in an array that ends in ``first``. A front's matrix has its own unknowns first, then
those of its bound. Remainders wait on a stack: those of a front's children lie on top of it.
"""

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.kernels.jit import kernel
from gvpipe.core.types import Float

Index = NDArray[np.int64]

PANEL = 32
"""Columns that are eliminated before the rest of the matrix is updated in one product."""

ROWS = 96
"""Rows of that product at a time: its upper half is not needed."""


@kernel
def eliminate(matrix: Float, count: int) -> bool:
    """Eliminate the first unknowns of a dense symmetric matrix, of which the lower half counts.

    The columns become those of the Cholesky factor, the rest the Schur complement; False if the
    matrix is not positive definite.
    """
    width = len(matrix)
    column = np.empty(PANEL)
    for begin in range(0, count, PANEL):
        end = min(begin + PANEL, count)
        for c in range(begin, end):
            if not matrix[c, c] > 0.0:
                return False
            pivot = np.sqrt(matrix[c, c])
            for r in range(c, end):
                matrix[r, c] /= pivot
                column[r - begin] = matrix[r, c]
            matrix[c, c] = pivot
            for r in range(c + 1, end):
                value = matrix[r, c]
                for m in range(c + 1, r + 1):
                    matrix[r, m] -= value * column[m - begin]
            for r in range(end, width):
                matrix[r, c] /= pivot
                value = matrix[r, c]
                for m in range(c + 1, end):
                    matrix[r, m] -= value * column[m - begin]
        if end < width:
            panel = matrix[end:, begin:end].copy()
            for r in range(0, width - end, ROWS):
                last = min(r + ROWS, width - end)
                matrix[end + r : end + last, end : end + last] -= np.dot(
                    panel[r:last], panel[:last].T
                )
    return True


@kernel
def factor_fronts(
    size: int,
    border: int,
    own_first: Index,
    bound_first: Index,
    child_first: Index,
    children: Index,
    slot_first: Index,
    slots: Index,
    place_first: Index,
    places: Index,
    edge_first: Index,
    edges: Index,
    flipped: Index,
    factor_first: Index,
    stack_size: int,
    diagonal: Float,
    between: Float,
    bordering: Float,
    corner: Float,
) -> tuple[bool, Float]:
    """Cholesky factors of all fronts, one after the other.

    Parameters
    ----------
    size, border : int
        Unknowns of a place, and of the border.
    own_first, bound_first : (F + 1,) int64
        Beginnings of the lists of unknowns of each front.
    child_first, children : (F + 1,) int64, (F - roots,) int64
        Children of each front.
    slot_first, slots : (F + 1,) int64, (S,) int64
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
    diagonal, between, bordering, corner
        See `Blocks`.

    Returns
    -------
    definite : bool
    factors : (L,) float64
        Own columns of each front, rows of all its unknowns, row by row.
    """
    factors, stack = np.empty(factor_first[-1]), np.empty(stack_size)
    top = 0
    for f in range(len(own_first) - 1):
        own = own_first[f + 1] - own_first[f]
        width = own + bound_first[f + 1] - bound_first[f]
        matrix = np.zeros((width, width))
        edge = width - border  # where the border begins
        for n in range(place_first[f], place_first[f + 1]):
            at = size * (n - place_first[f])
            matrix[at : at + size, at : at + size] = diagonal[places[n]]
            for b in range(border):
                matrix[edge + b, at : at + size] = bordering[places[n], :, b]
        if f == len(own_first) - 2:
            matrix[edge:, edge:] = corner
        for e in range(edge_first[f], edge_first[f + 1]):
            row, column = size * edges[e, 1], size * edges[e, 2]
            for a in range(size):
                for b in range(size):
                    if flipped[e]:
                        matrix[row + a, column + b] = between[edges[e, 0], b, a]
                    else:
                        matrix[row + a, column + b] = between[edges[e, 0], a, b]
        for n in range(child_first[f + 1] - 1, child_first[f] - 1, -1):
            c = children[n]
            slot = slots[slot_first[c] : slot_first[c + 1]]
            top -= len(slot) * len(slot)
            k = top
            for a in range(len(slot)):
                for b in range(a + 1):
                    matrix[slot[a], slot[b]] += stack[k + b]
                k += len(slot)
        if not eliminate(matrix, own):
            return False, factors
        k = factor_first[f]
        for a in range(width):
            factors[k : k + own] = matrix[a, :own]
            k += own
        for a in range(own, width):
            stack[top : top + width - own] = matrix[a, own:]
            top += width - own
    return True, factors


@kernel
def solve_fronts(
    own_first: Index,
    own: Index,
    bound_first: Index,
    bound: Index,
    factor_first: Index,
    factors: Float,
    x: Float,
) -> None:
    """Solve for right sides (S, C) in place."""
    fronts = len(own_first) - 1
    for f in range(fronts):
        here, there = (
            own[own_first[f] : own_first[f + 1]],
            bound[bound_first[f] : bound_first[f + 1]],
        )
        low = factors[factor_first[f] : factor_first[f + 1]].reshape(-1, max(len(here), 1))
        for s in range(x.shape[1]):
            for a in range(len(here)):
                value = x[here[a], s]
                for b in range(a):
                    value -= low[a, b] * x[here[b], s]
                x[here[a], s] = value / low[a, a]
            if len(here):
                for a in range(len(there)):
                    value = 0.0
                    for b in range(len(here)):
                        value += low[len(here) + a, b] * x[here[b], s]
                    x[there[a], s] -= value
    for f in range(fronts - 1, -1, -1):
        here, there = (
            own[own_first[f] : own_first[f + 1]],
            bound[bound_first[f] : bound_first[f + 1]],
        )
        if not len(here):
            continue
        low = factors[factor_first[f] : factor_first[f + 1]].reshape(-1, len(here))
        for s in range(x.shape[1]):
            for a in range(len(there)):
                value = x[there[a], s]
                for b in range(len(here)):
                    x[here[b], s] -= low[len(here) + a, b] * value
            for a in range(len(here) - 1, -1, -1):
                x[here[a], s] /= low[a, a]
                for b in range(a):
                    x[here[b], s] -= low[a, b] * x[here[a], s]


@kernel
def _inverse_lower(low: Float) -> Float:
    """Inverse of a lower triangular matrix."""
    n = len(low)
    out = np.zeros((n, n))
    for r in range(n):
        for m in range(r):
            for c in range(m + 1):
                out[r, c] -= low[r, m] * out[m, c]
        for c in range(r):
            out[r, c] /= low[r, r]
        out[r, r] = 1.0 / low[r, r]
    return out


@kernel
def marginal_fronts(
    size: int,
    own_first: Index,
    bound_first: Index,
    child_first: Index,
    children: Index,
    slot_first: Index,
    slots: Index,
    place_first: Index,
    places: Index,
    factor_first: Index,
    factors: Float,
    stack_size: int,
) -> Float:
    """Blocks (N, size, size) of the inverse on its diagonal; arguments as in `factor_fronts`.

    With the inverse known on a front's bound, that on its own unknowns follows from its factor.
    """
    out = np.empty((len(places), size, size))
    stack = np.empty(stack_size)
    top = 0
    for f in range(len(own_first) - 2, -1, -1):
        own = own_first[f + 1] - own_first[f]
        rest = bound_first[f + 1] - bound_first[f]
        whole = np.empty((own + rest, own + rest))
        top -= rest * rest
        known = stack[top : top + rest * rest].copy().reshape(rest, rest)
        whole[own:, own:] = known
        if own:
            low = factors[factor_first[f] : factor_first[f + 1]].reshape(own + rest, own)
            back = _inverse_lower(low[:own])
            inverse = np.dot(back.T, back)
            if rest:
                weight = np.dot(low[own:].copy(), back)
                across = np.dot(known, weight)
                whole[own:, :own] = -across
                whole[:own, own:] = -across.T
                inverse = inverse + np.dot(weight.T, across)
            whole[:own, :own] = inverse
        for n in range(child_first[f], child_first[f + 1]):
            c = children[n]
            slot = slots[slot_first[c] : slot_first[c + 1]]
            for a in range(len(slot)):
                for b in range(len(slot)):
                    stack[top + b] = whole[slot[a], slot[b]]
                top += len(slot)
        for n in range(place_first[f], place_first[f + 1]):
            at = size * (n - place_first[f])
            out[places[n]] = whole[at : at + size, at : at + size]
    return out
