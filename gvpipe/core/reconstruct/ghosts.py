"""Silhouettes that only meet by chance: bodies that no obstacle needs to explain the pictures."""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from gvpipe.core.reconstruct.evidence_options import EvidenceOptions, Silhouette
from gvpipe.core.reconstruct.hull import render_mask, search_grid, tolerant_hull
from gvpipe.core.reconstruct.mesh import Obstacle
from gvpipe.core.reconstruct.views import reduced
from gvpipe.core.types import Float, PosedView

TOLERANCE = 0.05
"""Share of the views that may contradict a body."""

APART = 0.5
"""Share of a body's picture that must agree and not be explained by others for a view to be its
witness."""

BORDER = 5
"""Pixels by which explained pictures are grown: the coarse hull's outline is rough."""

Masks = list[NDArray[np.bool_]]


def without_ghosts(
    views: Sequence[PosedView],
    shapes: Sequence[Silhouette],
    options: EvidenceOptions,
    threads: int = 1,
) -> list[Silhouette]:
    """Clear from the silhouettes what only ghosts explain.

    Where the cones of several obstacles' silhouettes cross, the hull has bodies besides the
    obstacles; at the rim of the map a few accidental silhouettes make others. Bodies are
    accepted in the order of the silhouette pixels they explain; one that fewer than
    ``options.min_views`` views see apart from those accepted before it is a ghost.

    Parameters
    ----------
    views : sequence of PosedView
    shapes : sequence of (H, W) float32
        Silhouettes, NaN where unknown.
    options : EvidenceOptions
    threads : int
        Do not change the result.

    Returns
    -------
    cleaned : list of (H, W) float32
        0 where the silhouette shows a ghost and no accepted body.
    """
    grid = search_grid(views)
    inside = tolerant_hull(views, shapes, grid, options, TOLERANCE, jobs=threads)
    labels, count = ndimage.label(inside)
    small = [reduced(v) for v in views]
    likely = [_sampled(s > 0.5, v) for s, v in zip(shapes, small, strict=True)]
    bodies = [[render_mask(labels == k, grid, v) > 0 for v in small] for k in range(1, count + 1)]
    agreed = [[m & s for m, s in zip(masks, likely, strict=True)] for masks in bodies]
    order = sorted(range(count), key=lambda k: -sum(int(a.sum()) for a in agreed[k]))
    explained: Masks = [np.zeros(s.shape, bool) for s in likely]
    ghostly: Masks = [np.zeros(s.shape, bool) for s in likely]
    for k in order:
        witnesses = sum(
            bool((a & ~e).sum() > APART * m.sum())
            for m, a, e in zip(bodies[k], agreed[k], explained, strict=True)
        )
        into = explained if witnesses >= options.min_views else ghostly
        for mask, body in zip(into, bodies[k], strict=True):
            mask |= body
    around = np.ones((BORDER, BORDER), np.uint8)
    cleaned = []
    for shape, known, ghost in zip(shapes, explained, ghostly, strict=True):
        only = ghost & (cv2.dilate(known.astype(np.uint8), around) == 0)
        wide = cv2.resize(only.astype(np.uint8), shape.shape[::-1], interpolation=cv2.INTER_NEAREST)
        cleaned.append(np.where(wide > 0, np.float32(0), shape))
    return cleaned


def standing_obstacles(found: Sequence[Obstacle]) -> list[Obstacle]:
    """Drop what floats: obstacles rest on the ground or on each other.

    The foot of one may be missed where its colours are the ground's, but not the greater part of
    it: a body over more air than it is high, and over no other one, is where silhouettes of
    something else happen to meet.

    Parameters
    ----------
    found : sequence of Obstacle

    Returns
    -------
    standing : list of Obstacle
        In the same order.
    """
    spans = [(o.mesh.vertices.min(axis=0), o.mesh.vertices.max(axis=0)) for o in found]

    def rests(low: Float, high: Float) -> bool:
        return low[2] <= high[2] - low[2] or any(
            bottom[2] < low[2] and (bottom[:2] < high[:2]).all() and (low[:2] < top[:2]).all()
            for bottom, top in spans
        )

    return [o for o, span in zip(found, spans, strict=True) if rests(*span)]


def _sampled(mask: NDArray[np.bool_], view: PosedView) -> NDArray[np.bool_]:
    """Bring a mask to the size of a reduced view."""
    size = (view.camera.width, view.camera.height)
    return cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
