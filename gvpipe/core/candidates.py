"""Which images of two robots may show the same ground, best first."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Candidate:
    """Two images that may overlap.

    Attributes
    ----------
    i, j : int
        Rows of the first and second robot's images.
    distance : float
        Between their histograms; smaller is more alike.
    """

    i: int
    j: int
    distance: float


def candidate_pairs(distances: NDArray[np.floating], threshold: float) -> list[Candidate]:
    """Local minima of a distance matrix below a threshold.

    Parameters
    ----------
    distances : (n, m) float
        Between the images of two robots.
    threshold : float
        Pairs at this distance or above are left out.

    Returns
    -------
    candidates : list of Candidate
        For every image of either robot the most alike image of the other one, each pair once,
        by increasing distance (thesis 4.3.3, second algorithm, in both directions).
    """
    d = np.asarray(distances)
    if not d.size:
        return []
    nearest_j, nearest_i = d.argmin(axis=1), d.argmin(axis=0)
    pairs = {(i, int(j)) for i, j in enumerate(nearest_j)}
    pairs |= {(int(i), j) for j, i in enumerate(nearest_i)}
    found = [Candidate(i, j, float(d[i, j])) for i, j in pairs if d[i, j] < threshold]
    return sorted(found, key=lambda c: (c.distance, c.i, c.j))
