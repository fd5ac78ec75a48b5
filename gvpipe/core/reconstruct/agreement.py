"""How well the pictures agree with an obstacle that was found."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gvpipe.core.reconstruct.mesh import Mesh
from gvpipe.core.reconstruct.visibility import render_depth
from gvpipe.core.types import PosedView

RING = 0.1
"""Width of the surroundings that an obstacle answers for, as a share of its size in the picture."""

LEAST_KNOWN = 0.5
"""A view has a say if it can judge at least this share of the obstacle's picture."""

ONE_SIDE_DEG = 120.0
"""Views whose directions span less than this see an obstacle from one side only: what its far side
looks like is not known, however well the silhouettes agree."""


@dataclass(frozen=True)
class Agreement:
    """What the views say about one obstacle.

    Attributes
    ----------
    confidence : float
        Mean over the views of intersection over union, 0 to 1, of the obstacle's picture and the
        view's silhouette near it; 0 if no view has a say.
    views : int
        How many views have a say.
    azimuth_span : float
        The smallest angle, seen from above, that holds their directions from the obstacle,
        radians; 0 of a single view, and of none.
    """

    confidence: float
    views: int
    azimuth_span: float


def agreement(
    meshes: Sequence[Mesh],
    views: Sequence[PosedView],
    silhouettes: Sequence[NDArray[np.float32]],
) -> list[Agreement]:
    """Compare the picture of every obstacle with the silhouettes.

    Parameters
    ----------
    meshes : sequence of Mesh
        All obstacles, map frame.
    views : sequence of PosedView
    silhouettes : sequence of (H, W) float32
        Of each view: probability in 0..1 that a pixel shows an obstacle, NaN where unknown.

    Returns
    -------
    agreements : list of Agreement
        One a mesh, in order.
    """
    shares: list[list[float]] = [[] for _ in meshes]
    azimuths: list[list[float]] = [[] for _ in meshes]
    for view, silhouette in zip(views, silhouettes, strict=True):
        known = ~np.isnan(silhouette)
        probability = np.where(known, silhouette, 0.0)
        masks = [np.isfinite(render_depth(mesh, view)) for mesh in meshes]
        every = np.any(masks, axis=0) if masks else known
        for mesh, mask, mine, around_it in zip(meshes, masks, shares, azimuths, strict=True):
            if not mask.any() or known[mask].mean() < LEAST_KNOWN:
                continue
            around = _grown(mask) & known & ~every
            union = (mask & known).sum() + probability[around].sum(dtype=np.float64)
            mine.append(float(probability[mask].sum(dtype=np.float64) / union))
            x, y, _ = view.map_from_camera.translation - mesh.vertices.mean(axis=0)
            around_it.append(float(np.arctan2(y, x)))
    return [
        Agreement(float(np.mean(s)) if s else 0.0, len(s), _span(a))
        for s, a in zip(shares, azimuths, strict=True)
    ]


def _span(azimuths: Sequence[float]) -> float:
    """Smallest arc that holds all directions, radians: the circle without the largest gap."""
    if not azimuths:
        return 0.0
    ordered = np.sort(azimuths)
    return float(2 * np.pi - np.diff(ordered, append=ordered[0] + 2 * np.pi).max())


def _grown(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Grow a mask by the surroundings that it answers for, (H, W) bool."""
    width = 2 * round(RING * float(np.sqrt(mask.sum()))) + 1
    grown = cv2.dilate(mask.astype(np.uint8), np.ones((width, width), np.uint8))
    return np.asarray(grown > 0)
