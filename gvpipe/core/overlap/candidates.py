"""Which images of two robots may show the same ground, best first."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.overlap.histogram import Distance
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


BLOCK = 1024
"""Rows of a distance matrix in memory at a time: 40 MB for ten thousand columns."""


def candidate_pairs(
    i: NDArray[np.intp],
    j: NDArray[np.intp],
    distances: NDArray[np.floating],
    threshold: float,
    expected: Float,
) -> list[Candidate]:
    """Choose the pairs worth a homography, the most promising first.

    Parameters
    ----------
    i, j : (k,) int
        Pairs of images of two robots, each once.
    distances : (k,) float
        Between their histograms.
    threshold : float
        Pairs at this distance or above are left out, unless their spots agree.
    expected : (k,) float64
        Of :func:`gvpipe.core.overlap.signature.expected_overlap`.

    Returns
    -------
    candidates : list of Candidate
        For every image of either robot the one of the other with the most common ground to
        expect, most first; then the one with the nearest histogram, by increasing distance
        (thesis 4.3.3, second algorithm, in both directions).
    """
    chosen = {k for k in _best_partners(i, j, -expected) if expected[k] > 0}
    chosen |= {k for k in _best_partners(i, j, distances) if distances[k] < threshold}
    found = [
        Candidate(int(i[k]), int(j[k]), float(distances[k]), float(expected[k])) for k in chosen
    ]
    return sorted(found, key=lambda c: (-c.expected, c.distance, c.i, c.j))


def _best_partners(
    i: NDArray[np.intp], j: NDArray[np.intp], costs: NDArray[np.floating]
) -> set[int]:
    """Positions of the cheapest pair of each image; the first of equals."""
    chosen: set[int] = set()
    for one, other in ((i, j), (j, i)):
        order = np.lexsort((other, costs, one))
        first = np.unique(one[order], return_index=True)[1]
        chosen |= {int(k) for k in order[first]}
    return chosen


def shortlist(
    h: Float, g: Float, distance: Distance, count: int, block: int = BLOCK
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float32]]:
    """Pairs that are among the nearest of either image, without holding the matrix.

    Parameters
    ----------
    h, g : (n, bins), (m, bins) float64
        Histograms of two robots' images.
    distance : callable
        One of :data:`gvpipe.core.overlap.histogram.DISTANCES`.
    count : int
        Nearest images to keep for each image.
    block : int
        Rows of the matrix in memory at a time.

    Returns
    -------
    i, j : (k,) int
        Rows of h and g, in their order; each pair once.
    distances : (k,) float32
        Of the pairs.
    """
    pairs = []
    # the nearest rows of every column so far
    best = np.full((0, len(g)), np.inf, np.float32)
    rows = np.empty((0, len(g)), np.intp)
    for start in range(0, len(h), block):
        d = distance(h[start : start + block], g)
        near = _smallest(d, count)
        here = np.repeat(np.arange(len(d)), near.shape[1])
        pairs.append((start + here, near.ravel(), d[here, near.ravel()]))
        down = _smallest(np.ascontiguousarray(d.T), count).T
        best = np.concatenate([best, np.take_along_axis(d, down, axis=0)])
        rows = np.concatenate([rows, start + down])
        keep = _smallest(np.ascontiguousarray(best.T), count).T
        best = np.take_along_axis(best, keep, axis=0)
        rows = np.take_along_axis(rows, keep, axis=0)
    pairs.append((rows.ravel(), np.tile(np.arange(len(g)), len(rows)), best.ravel()))
    i, j, d = (np.concatenate(part) for part in zip(*pairs, strict=True))
    _, first = np.unique(i * max(len(g), 1) + j, return_index=True)
    return i[first], j[first], d[first]


def _smallest(values: NDArray[np.float32], count: int) -> NDArray[np.intp]:
    """Columns of the smallest values of each row, (n, count or fewer)."""
    count = min(count, values.shape[1])
    if count == 1:
        return values.argmin(axis=1)[:, None]
    return (
        values.argpartition(count - 1, axis=1)[:, :count]
        if count
        else np.empty((len(values), 0), np.intp)
    )
