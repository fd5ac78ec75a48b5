"""What obstacles hide of the ground."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
from numpy.typing import NDArray

from gvpipe.core.reconstruct.background import Mask
from gvpipe.core.reconstruct.evidence_options import EvidenceOptions, Silhouette
from gvpipe.core.reconstruct.grid import VoxelGrid
from gvpipe.core.reconstruct.hull import (
    VoxelSolid,
    down_to_ground,
    region_grid,
    regions_of,
    render_mask,
    search_grid,
    tolerant_hull,
)
from gvpipe.core.types import PosedView

REGION_VOXELS = 600_000
"""Voxels of one region when obstacles are asked what they hide."""

FINE_PER_HEIGHT = 100
"""Voxels per camera height in those regions, at most."""

GROWTH = 2
"""Pixels by which what hides the ground is grown: a hull too small by one would pass the
obstacle's edge, in its place in all views, for ground."""

EDGE = 2
"""Pixels within which the tolerant hull's outline may show the ground beside an obstacle."""

MARGIN = 4
"""Coarse voxels around a region: its tolerant hull may still grow."""


def tolerant_solids(
    views: Sequence[PosedView],
    shapes: Sequence[Silhouette],
    options: EvidenceOptions,
    tolerance: float,
    threads: int = 1,
) -> list[VoxelSolid]:
    """Tolerant hulls of the silhouettes, one for each region they stand in.

    Parameters
    ----------
    views : sequence of PosedView
    shapes : sequence of (H, W) float32
        Silhouettes, NaN where unknown.
    options : EvidenceOptions
    tolerance : float
        Share of its views that may contradict a voxel.
    threads : int
        Do not change the result.

    Returns
    -------
    solids : list of VoxelSolid
    """
    coarse = search_grid(views)
    height = float(np.median([v.map_from_camera.translation[2] for v in views]))
    solids = []

    def hull(grid: VoxelGrid) -> NDArray[np.bool_]:
        return tolerant_hull(views, shapes, grid, options, tolerance, grounded=False, jobs=threads)

    for region in regions_of(hull(coarse), coarse, MARGIN):
        grid = region_grid(region, REGION_VOXELS, height / FINE_PER_HEIGHT)
        solids.append(VoxelSolid(hull(grid), grid))
    return solids


def hidden_ground(
    views: Sequence[PosedView],
    shapes: Sequence[Silhouette],
    solids: Sequence[VoxelSolid],
    pool: ThreadPoolExecutor,
) -> list[Mask]:
    """Where obstacles hide the ground in each view: its silhouette and the tolerant hull's, grown.

    Parameters
    ----------
    views : sequence of PosedView
    shapes : sequence of (H, W) float32
        Silhouettes, NaN where unknown.
    solids : sequence of VoxelSolid
        What may stand, see :func:`tolerant_solids`.
    pool : ThreadPoolExecutor
        Works on the views.

    Returns
    -------
    hidden : list of (H, W) uint8
        255 where the ground is hidden, else 0.
    """
    below = [VoxelSolid(down_to_ground(solid.inside), solid.grid) for solid in solids]
    around = np.ones((2 * GROWTH + 1,) * 2, np.uint8)

    def one(index: int) -> Mask:
        shape = (np.nan_to_num(shapes[index]) > 0.5).astype(np.uint8) * np.uint8(255)
        mask = np.maximum(shape, _rendered(below, views[index]))
        return cv2.dilate(mask, around).astype(np.uint8)

    return list(pool.map(one, range(len(views))))


def bodies_seen(
    views: Sequence[PosedView], solids: Sequence[VoxelSolid], pool: ThreadPoolExecutor
) -> list[Mask]:
    """Where each view shows a tolerant hull, less the edge of its outline.

    Parameters
    ----------
    views : sequence of PosedView
    solids : sequence of VoxelSolid
        What may stand, see :func:`tolerant_solids`.
    pool : ThreadPoolExecutor
        Works on the views.

    Returns
    -------
    solid : list of (H, W) uint8
        255 where a view shows it, else 0.
    """
    around = np.ones((2 * EDGE + 1,) * 2, np.uint8)

    def one(view: PosedView) -> Mask:
        return cv2.erode(_rendered(solids, view), around).astype(np.uint8)

    return list(pool.map(one, views))


def _rendered(solids: Sequence[VoxelSolid], view: PosedView) -> Mask:
    """Where a view shows any of them."""
    mask = np.zeros(view.pixels.shape[:2], np.uint8)
    for solid in solids:
        mask = np.maximum(mask, render_mask(solid.inside, solid.grid, view))
    return mask
