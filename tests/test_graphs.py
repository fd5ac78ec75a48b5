"""Small loops on graphs and sets, compared with SciPy's."""

import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist
from scipy.special import bdtrc

from gvpipe.core.kernels.components import connected
from gvpipe.core.kernels.footprints import meeting_discs
from gvpipe.core.matching.chance import log10_at_least
from gvpipe.core.slam.holding import HEIGHT_SIGMA, _levelled


@pytest.mark.parametrize(("nodes", "edges"), [(1, 0), (40, 0), (40, 25), (400, 390), (50, 900)])
def test_components_are_numbered_by_their_first_node(nodes: int, edges: int) -> None:
    left, right = np.random.default_rng(edges).integers(nodes, size=(2, edges))
    graph = coo_matrix((np.ones(edges), (left, right)), (nodes, nodes))
    assert connected(nodes, left, right).tolist() == connected_components(graph, False)[1].tolist()


@pytest.mark.parametrize("count", [0, 1, 2, 100])
def test_discs_that_meet(count: int) -> None:
    rng = np.random.default_rng(count)
    centre, radius = rng.random((count, 2)), 0.2 * rng.random(count)
    centre = centre[np.argsort(centre[:, 0])]
    meet = cdist(centre, centre) < radius[:, None] + radius if count else np.empty((0, 0))
    assert meeting_discs(centre, radius).tolist() == np.argwhere(np.triu(meet, 1)).tolist()


def test_the_tail_of_the_binomial() -> None:
    for tested in (1, 8, 250):
        for least in range(0, min(tested, 150) + 1):
            true = np.log10(bdtrc(least - 1, tested, 0.02))
            assert log10_at_least(least, tested, 0.02) == pytest.approx(true, abs=1e-9)
    assert log10_at_least(1000, 1000, 0.02) == pytest.approx(1000 * np.log10(0.02))


def test_heights_along_a_long_chain_balance() -> None:
    rng = np.random.default_rng(2)
    n = 500
    ends = np.column_stack([np.arange(n - 1), np.arange(1, n)])
    ratios, weight = rng.normal(0.0, 0.02, n - 1), rng.uniform(1e2, 1e4, n - 1)
    rows = np.zeros((n - 1, n))
    rows[np.arange(n - 1), ends[:, 0]], rows[np.arange(n - 1), ends[:, 1]] = 1.0, -1.0
    normal = rows.T @ (weight[:, None] * rows) + np.eye(n) / HEIGHT_SIGMA**2
    true = np.linalg.solve(normal, rows.T @ (weight * ratios))
    found = _levelled(ends, ratios, weight, np.zeros(n))
    np.testing.assert_allclose(found, true, atol=1e-12)
