"""Ground points seen in several images, chained together from the matches of image pairs."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from gvpipe.core.kernels.cells import gathered_cells
from gvpipe.core.slam.links import Matches
from gvpipe.core.types import Float, Index

SAME_CORNER_PX = 0.01
"""Matches of one image that end closer than this, pixels, on a common grid are the same corner.

Detections are stored as they were found, so one corner used in two pairs has equal coordinates
up to rounding; corners found anew for each pair stay separate points."""

CELLS = 4
"""Cells, across and down, in which the matches of a link are summed up."""

STRAY = 4.0
"""Matches that depart from the homography by more than this many medians are not summed up."""


@dataclass(frozen=True)
class Tracks:
    """Which cameras saw which ground points where.

    Attributes
    ----------
    camera : (M,) int64
        Camera of each observation, ascending within a point.
    pixel : (M, 2) float64
        Observed pixels.
    start : (T + 1,) int64
        Observations ``start[t]:start[t + 1]`` belong to point t.
    weight : (T,) float64
        Matches that each point stands for.
    """

    camera: Index
    pixel: Float
    start: Index
    weight: Float

    @property
    def point(self) -> Index:
        """Point of each observation, (M,)."""
        return np.repeat(np.arange(len(self.start) - 1), np.diff(self.start))


def chain_matches(
    pairs: Sequence[tuple[int, int]], points: Sequence[tuple[Float, Float]]
) -> Tracks:
    """Chain matched pixels that share a corner into tracks.

    Parameters
    ----------
    pairs : sequence of (int, int)
        Cameras i and j of each link.
    points : sequence of ((N, 2) float64, (N, 2) float64)
        Matched pixels of each link in i and in j.

    Returns
    -------
    tracks : Tracks
        Every track sees a camera at most once: where a chain returns to an image at another
        corner, at least one of its matches is wrong, and its matches stay points of their own.
    """
    camera = np.concatenate(
        [np.repeat([i, j], len(p)) for (i, j), (p, _) in zip(pairs, points, strict=True)]
        or [np.empty(0, np.int64)]
    )
    pixel = np.concatenate([np.concatenate(both) for both in points] or [np.empty((0, 2))])
    sizes = np.array([len(p) for p, _ in points], dtype=np.int64)
    offsets = 2 * np.append(0, np.cumsum(sizes))
    # observation n of a link in i has its partner in j as many places on as the link has matches
    left = np.arange(sum(sizes)) + np.repeat(offsets[:-1] // 2, sizes)
    right = left + np.repeat(sizes, sizes)
    cells = np.column_stack([camera, np.round(pixel / SAME_CORNER_PX)]).astype(np.int64)
    _, first, corner = np.unique(_keys(cells), return_index=True, return_inverse=True)
    count = len(first)
    graph = coo_matrix((np.ones(len(left)), (corner[left], corner[right])), (count, count))
    _, chain = connected_components(graph, directed=False)
    return _gather(camera, pixel, first, chain.astype(np.int64), corner[left], corner[right])


def _keys(rows: Index) -> Index:
    """One number for each row, (N,), in the order of the rows: they are sorted much faster."""
    low, high = rows.min(axis=0, initial=0), rows.max(axis=0, initial=0)
    return np.ravel_multi_index(tuple((rows - low).T), tuple(high - low + 1)).astype(np.int64)


def _gather(
    camera: Index, pixel: Float, first: Index, chain: Index, left: Index, right: Index
) -> Tracks:
    """Split the chains that meet an image twice, then list the observations by track."""
    seen = _keys(np.column_stack([chain, camera[first]]))
    _, inverse, times = np.unique(seen, return_inverse=True, return_counts=True)
    torn = np.zeros(chain.max(initial=-1) + 1, dtype=bool)
    torn[chain[times[inverse] > 1]] = True
    whole = ~torn[chain]
    loose = np.unique(np.column_stack([left, right])[torn[chain[left]]], axis=0)
    loose = loose[camera[first[loose[:, 0]]] != camera[first[loose[:, 1]]]]
    corner = np.concatenate([np.nonzero(whole)[0], loose.ravel()])
    track = np.concatenate([chain[whole], len(torn) + np.repeat(np.arange(len(loose)), 2)])
    order = np.lexsort((camera[first[corner]], track))
    corner, track = corner[order], track[order]
    starts = np.nonzero(np.diff(track, prepend=-1))[0]
    return Tracks(
        camera=camera[first[corner]].astype(np.int64),
        pixel=pixel[first[corner]],
        start=np.append(starts, len(track)).astype(np.int64),
        weight=np.ones(len(starts)),
    )


def cell_tracks(pairs: Index, matches: Matches, which: Index, homographies: Float) -> Tracks:
    """Sum the matches of each link up in a few points: what large maps can afford.

    Parameters
    ----------
    pairs : (E, 2) int64
        Cameras i and j of each link.
    matches : Matches
        Of these links and others.
    which : (E,) int64
        Their places among those.
    homographies : (E, 3, 3) float64
        Pixels of i to pixels of j.

    Returns
    -------
    tracks : Tracks
        Points seen by the two cameras of one link each, weighted with the matches they stand for.

    Notes
    -----
    The mean of matches that lie together says nearly all that they say about eight numbers, the
    homography. Corners that several links share count once for each of them.
    """
    link, points_i, points_j, weight = gathered_cells(
        matches.start, matches.points_i, matches.points_j, which, homographies, CELLS, STRAY
    )
    camera = pairs[link]
    pixel = np.stack([points_i, points_j], axis=1)
    back = camera[:, 0] > camera[:, 1]
    camera[back], pixel[back] = camera[back, ::-1], pixel[back, ::-1]
    return Tracks(
        camera=camera.ravel(),
        pixel=pixel.reshape(-1, 2),
        start=2 * np.arange(len(link) + 1),
        weight=weight,
    )
