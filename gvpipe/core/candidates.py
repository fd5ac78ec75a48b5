"""Which images of two robots may show the same ground, best first."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.types import Float


@dataclass(frozen=True)
class Candidate:
    """Two images that may overlap.

    Attributes
    ----------
    i, j : int
        Rows of the first and second robot's images.
    distance : float
        Between their histograms; smaller is more alike.
    expected : float
        Share of common ground their spots let expect, 0 if they say nothing.
    """

    i: int
    j: int
    distance: float
    expected: float = 0.0


def candidate_pairs(
    distances: NDArray[np.floating], threshold: float, expected: Float | None = None
) -> list[Candidate]:
    """Pairs worth a homography, the most promising first.

    Parameters
    ----------
    distances : (n, m) float
        Between the histograms of two robots' images.
    threshold : float
        Pairs at this distance or above are left out, unless their spots agree.
    expected : (n, m) float64, optional
        From :func:`gvpipe.core.signature.expected_overlaps`.

    Returns
    -------
    candidates : list of Candidate
        For every image of either robot the one of the other with the most common ground to
        expect, most first; then the one with the nearest histogram, by increasing distance
        (thesis 4.3.3, second algorithm, in both directions). Each pair once.
    """
    d = np.asarray(distances, dtype=np.float64)
    if not d.size:
        return []
    e = np.zeros(d.shape) if expected is None else np.asarray(expected, dtype=np.float64)
    pairs = {pair for pair in _best_partners(-e) if e[pair] > 0}
    pairs |= {pair for pair in _best_partners(d) if d[pair] < threshold}
    found = [Candidate(i, j, float(d[i, j]), float(e[i, j])) for i, j in pairs]
    return sorted(found, key=lambda c: (-c.expected, c.distance, c.i, c.j))


def _best_partners(costs: Float) -> set[tuple[int, int]]:
    """Cheapest entry of each row and of each column."""
    rows = {(i, int(j)) for i, j in enumerate(costs.argmin(axis=1))}
    return rows | {(int(i), j) for j, i in enumerate(costs.argmin(axis=0))}
