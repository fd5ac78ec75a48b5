"""The two terms of the energy on a voxel grid, and where obstacles may stand at all."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from gvpipe.core.grid import VoxelGrid
from gvpipe.core.kernels.evidence import add_view_evidence, photo_consistency
from gvpipe.core.silhouette import EvidenceOptions, Silhouette
from gvpipe.core.types import Float, PosedView

Volume = NDArray[np.float32]
"""(nx, ny, nz) float32 values at the voxel centres."""

COARSE_VOXELS = 2_000_000
"""Voxels of the search for regions: bounds its time to about a second for ten views."""

COARSE_PER_HEIGHT = 50
"""Voxels of that search per camera height: obstacles of a 25th of it are two voxels high."""

RANGE_PER_HEIGHT = 4.0
"""Ground farther than this many camera heights is not searched: a pixel covers centimetres."""


@dataclass(frozen=True)
class Region:
    """An axis-aligned box of the map in which an obstacle stands.

    Attributes
    ----------
    lower, upper : (3,) float64
        Corners, metres.
    """

    lower: Float
    upper: Float


def pixel_from_map(view: PosedView) -> Float:
    """(3, 4) projection K [R | t] of the view (thesis eq. 5.5.1), third row the depth in metres."""
    camera_from_map = view.map_from_camera.inverse()
    matrix = view.camera.matrix @ np.column_stack(
        [camera_from_map.rotation, camera_from_map.translation]
    )
    return np.ascontiguousarray(matrix)


def hull_probability(
    views: Sequence[PosedView],
    silhouettes: Sequence[Silhouette],
    grid: VoxelGrid,
    options: EvidenceOptions,
) -> Volume:
    """Probability that a point lies in an obstacle's visual hull (thesis eq. 5.6.3).

    Views in which the point projects outside the picture or onto pixels of unknown background
    are left out; a point that fewer than ``options.min_views`` can judge has probability 0.

    Returns
    -------
    probability : (nx, ny, nz) float32
        In 0..1.
    """
    log_sum = np.zeros(grid.shape, np.float32)
    count = np.zeros(grid.shape, np.uint8)
    for view, silhouette in zip(views, silhouettes, strict=True):
        add_view_evidence(
            silhouette,
            pixel_from_map(view),
            grid.origin,
            grid.spacing,
            options.view_floor,
            log_sum,
            count,
        )
    probability = np.exp(log_sum)
    probability[count < options.min_views] = 0.0
    height = grid.origin[2] + np.arange(grid.shape[2]) * grid.spacing[2]
    above = 1.0 / (1.0 + np.exp(np.clip(-height / options.ground_softness, -50.0, 50.0)))
    product: Volume = (probability * above).astype(np.float32)
    return product


def data_terms(
    views: Sequence[PosedView],
    silhouettes: Sequence[Silhouette],
    grid: VoxelGrid,
    options: EvidenceOptions,
) -> tuple[Volume, Volume]:
    """Volume term and area weight of the energy (thesis eqs. 5.6.5 and 5.6.8).

    Returns
    -------
    f : (nx, ny, nz) float32
        ``0.5 - P``: negative inside obstacles, positive outside, zero at the surface, so that the
        surface is driven from both sides (the printed ``-P`` leaves the outside without force).
    g : (nx, ny, nz) float32
        ``1 + Gamma`` with the mean over the views in Gamma, so that it stays positive: low where
        the views agree about the colour.
    """
    f = (0.5 - hull_probability(views, silhouettes, grid, options)).astype(np.float32)
    consent = np.zeros(grid.shape, np.float32)
    width = max(v.camera.width for v in views)
    height = max(v.camera.height for v in views)
    images = np.zeros((len(views), height, width, 3), np.uint8)
    sizes = np.array([[v.camera.width, v.camera.height] for v in views])
    for k, view in enumerate(views):
        images[k, : view.camera.height, : view.camera.width] = view.pixels
    photo_consistency(
        images,
        sizes,
        np.stack([pixel_from_map(v) for v in views]),
        grid.origin,
        grid.spacing,
        options.consistency_scale,
        options.min_views,
        consent,
    )
    return f, np.maximum(1.0 - consent, options.area_floor).astype(np.float32)


def find_regions(
    views: Sequence[PosedView], silhouettes: Sequence[Silhouette], options: EvidenceOptions
) -> list[Region]:
    """Boxes of the map in which obstacles stand.

    A coarse hull over all ground near the cameras is split into connected parts; parts that do
    not reach the ground are dropped (nothing floats), boxes that touch are joined.

    Returns
    -------
    regions : list of Region
        Largest first; empty if nothing stands on the ground.
    """
    grid = _search_grid(views)
    inside = hull_probability(views, silhouettes, grid, options) > 0.5
    labels, count = ndimage.label(inside)
    standing = np.unique(labels[:, :, :2])
    # a part must be more than a speck: 3 voxels across, on average
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    keep = [k for k in standing if k > 0 and sizes[k] >= 27]
    margin = 4
    grown = ndimage.binary_dilation(np.isin(labels, keep), iterations=margin)
    joined, _ = ndimage.label(grown)
    boxes = ndimage.find_objects(joined)
    regions = []
    for box in boxes:
        low = np.array([s.start for s in box]) - 0.5
        high = np.array([s.stop for s in box]) - 0.5
        lower = grid.origin + low * grid.spacing
        upper = grid.origin + high * grid.spacing
        lower[2] = 0.0
        regions.append(Region(lower, upper))
    return sorted(regions, key=lambda r: -float(np.prod(r.upper - r.lower)))


def _search_grid(views: Sequence[PosedView]) -> VoxelGrid:
    """Coarse voxels over the ground within reach of the cameras, up to their median height."""
    centres = np.array([v.map_from_camera.translation for v in views])
    height = float(np.median(centres[:, 2]))
    lower = centres.min(axis=0) - RANGE_PER_HEIGHT * height
    upper = centres.max(axis=0) + RANGE_PER_HEIGHT * height
    lower[2], upper[2] = 0.0, height
    spacing = height / COARSE_PER_HEIGHT
    spacing = max(spacing, float(np.cbrt(np.prod(upper - lower) / COARSE_VOXELS)))
    counts = np.maximum(np.ceil((upper - lower) / spacing).astype(int), 1)
    return VoxelGrid(
        lower + spacing / 2,
        np.full(3, spacing),
        (int(counts[0]), int(counts[1]), int(counts[2])),
    )
