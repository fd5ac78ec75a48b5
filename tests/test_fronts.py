import numpy as np
import pytest

from gvpipe.core.slam.fronts import Blocks, Dissection, Factor
from gvpipe.core.types import Float


def lattice(side: int) -> tuple[Float, Float, Float]:
    """Links between neighbours of a square lattice, and its places."""
    number = np.arange(side * side).reshape(side, side)
    i = np.concatenate([number[:, :-1].ravel(), number[1:].ravel()])
    j = np.concatenate([number[:, 1:].ravel(), number[:-1].ravel()])
    where = np.column_stack(np.divmod(np.arange(side * side), side)).astype(np.float64)
    return i, j, where


def some_matrix(plan: Dissection, rng: np.random.Generator) -> tuple[Blocks, Float]:
    """A positive definite matrix on a dissection, and the same laid out."""
    s, n, t = plan.size, plan.count, plan.border
    dense = np.zeros((s * n + t, s * n + t))
    between, border = rng.normal(size=(len(plan.i), s, s)), rng.normal(size=(n, s, t))
    for k, (i, j) in enumerate(zip(plan.i, plan.j, strict=True)):
        dense[s * i : s * i + s, s * j : s * j + s] = between[k]
    dense[: s * n, s * n :] = border.reshape(s * n, t)
    dense = dense + dense.T
    dense += np.diag(np.abs(dense).sum(axis=1) + 1.0)
    diagonal = np.array([dense[s * k : s * k + s, s * k : s * k + s] for k in range(n)])
    return Blocks(diagonal, between, border, dense[s * n :, s * n :]), dense


@pytest.mark.parametrize("border", [0, 3])
@pytest.mark.parametrize("side", [1, 3, 12])
def test_fronts_solve_and_invert_like_dense_algebra(side: int, border: int) -> None:
    i, j, where = lattice(side)
    plan = Dissection(i, j, where, size=2, border=border)
    rng = np.random.default_rng(side)
    blocks, dense = some_matrix(plan, rng)
    factor = Factor(plan, blocks)
    right = rng.normal(size=(len(dense), 2))
    np.testing.assert_allclose(factor.solve(right), np.linalg.solve(dense, right), atol=1e-12)
    inverse = np.linalg.inv(dense)
    own = np.array([inverse[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] for k in range(plan.count)])
    np.testing.assert_allclose(factor.marginals(), own, atol=1e-12)


def test_apart_and_stacked_places_are_no_trouble() -> None:
    # two chains without a link between them, all in one spot
    i = np.array([*range(29), *range(30, 59)])
    plan = Dissection(i, i + 1, np.zeros((60, 2)), size=3)
    blocks, dense = some_matrix(plan, np.random.default_rng(1))
    right = np.arange(180.0)
    np.testing.assert_allclose(Factor(plan, blocks).solve(right), np.linalg.solve(dense, right))


def test_an_indefinite_matrix_is_refused() -> None:
    plan = Dissection(np.array([0]), np.array([1]), np.zeros((2, 2)), size=1)
    blocks = Blocks(np.ones((2, 1, 1)), np.full((1, 1, 1), 2.0), np.empty((2, 1, 0)), np.eye(0))
    with pytest.raises(np.linalg.LinAlgError):
        Factor(plan, blocks)
