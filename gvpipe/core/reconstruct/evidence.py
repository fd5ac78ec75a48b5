"""The two terms of the energy on a voxel grid, and where obstacles may stand at all."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.kernels.evidence import photo_consistency, sample_colours
from gvpipe.core.kernels.fusion import fuse_depth
from gvpipe.core.reconstruct.evidence_options import EvidenceOptions, Silhouette
from gvpipe.core.reconstruct.grid import Volume, VoxelGrid
from gvpipe.core.reconstruct.hull import (
    Region,
    entry_depth,
    log_support,
    pixel_from_map,
    regions_of,
    search_grid,
    tolerant_hull,
)
from gvpipe.core.reconstruct.slabs import Slabs, thin_slabs
from gvpipe.core.reconstruct.stereo import DepthMap, depth_maps
from gvpipe.core.reconstruct.views import reduced
from gvpipe.core.types import Float, Image, PosedView

REGION_TOLERANCE = 0.05
"""Share of the views that may contradict a point where obstacles are looked for."""

SURE_VIEWS, FAILING_SHARE = 16, 0.06
"""Views that must all agree, and the share of further ones whose silhouettes may fail."""

NIL = 1e-8
"""Probability below which further views are not asked: less than the rounding of one half."""

LEAST_BAND_M, BAND_VOXELS = 0.01, 2.0
"""Half width of the band in which a depth speaks for its surface, metres and voxels: the scatter
of depths at arm's length."""

MARGIN = 3
"""Coarse voxels between an obstacle and the border of its region."""


def hull_probability(
    views: Sequence[PosedView],
    silhouettes: Sequence[Silhouette],
    grid: VoxelGrid,
    options: EvidenceOptions,
) -> Volume:
    """Probability that a point lies in an obstacle's visual hull (thesis eq. 5.6.3).

    Views in which the point projects outside the picture or onto pixels of unknown background
    are left out; a point that fewer than ``options.min_views`` can judge has probability 0. The
    product of many views would let the worst of them carve: beyond ``SURE_VIEWS`` a share of the
    further ones may contradict.

    Parameters
    ----------
    views : sequence of PosedView
    silhouettes : sequence of (H, W) float32
        Theirs, NaN where unknown.
    grid : VoxelGrid
    options : EvidenceOptions

    Returns
    -------
    probability : (nx, ny, nz) float32
        In 0..1.
    """
    return _hull([pixel_from_map(v) for v in views], silhouettes, grid, options)


def _hull(
    matrices: Sequence[Float],
    silhouettes: Sequence[Silhouette],
    grid: VoxelGrid,
    options: EvidenceOptions,
) -> Volume:
    """Return :func:`hull_probability` of views given by their projections, (3, 4) float64 each."""
    most = FAILING_SHARE * max(len(matrices) - SURE_VIEWS, 0)
    enough = np.log(NIL) + np.log(options.view_floor) * most
    log_sum, count = log_support(matrices, silhouettes, grid, options.view_floor, enough=enough)
    failing = FAILING_SHARE * np.maximum(count.astype(np.float32) - SURE_VIEWS, 0)
    probability = np.exp(np.minimum(log_sum - np.log(options.view_floor) * failing, 0))
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
    jobs: int = 1,
) -> tuple[Volume, Volume]:
    """Volume term and area weight of the energy (thesis eqs. 5.6.5 and 5.6.8).

    The silhouettes' hull is all that is known of a surface without texture. Where views agree on
    texture behind the hull's surface, their depths take over.

    Parameters
    ----------
    views : sequence of PosedView
    silhouettes : sequence of (H, W) float32
        One a view.
    grid : VoxelGrid
    options : EvidenceOptions
    jobs : int
        Threads; the result does not depend on them.

    Returns
    -------
    f : (nx, ny, nz) float32
        ``0.5 - P``: negative inside obstacles, positive outside, zero at the surface, so that the
        surface is driven from both sides (the printed ``-P`` leaves the outside without force).
    g : (nx, ny, nz) float32
        ``1 + Gamma`` with the mean over the views in Gamma, so that it stays positive: low where
        the views agree about the colour.
    """
    f, g = np.empty(grid.shape, np.float32), np.empty(grid.shape, np.float32)
    pictures = [np.ascontiguousarray(v.pixels) for v in views]
    matrices = [pixel_from_map(v) for v in views]
    parts = thin_slabs(grid.shape)

    def weigh(bounds: tuple[int, int]) -> None:
        part, slab = grid.part(*bounds), slice(*bounds)
        f[slab] = 0.5 - _hull(matrices, silhouettes, part, options)
        consent = _consent(matrices, pictures, part, options)
        np.maximum(1.0 - consent, np.float32(options.area_floor), out=g[slab])

    with Slabs(jobs) as slabs:
        slabs.map(weigh, parts)
        maps = _depths(views, silhouettes, grid, f < 0, options, slabs)
        band = max(LEAST_BAND_M, BAND_VOXELS * float(grid.spacing.max()))
        small = [pixel_from_map(m.view) for m in maps]

        def correct(bounds: tuple[int, int]) -> None:
            _vote(small, maps, grid.part(*bounds), band, f[slice(*bounds)])

        slabs.map(correct, parts)
    return f, g


def _consent(
    matrices: Sequence[Float],
    pictures: Sequence[Image],
    grid: VoxelGrid,
    options: EvidenceOptions,
) -> Volume:
    """How well the views agree about the colour of each voxel, 0..1."""
    nx, ny, nz = grid.shape
    samples = np.empty((len(matrices), nx, ny, 4, nz), np.uint8)
    for matrix, picture, out in zip(matrices, pictures, samples, strict=True):
        sample_colours(picture, matrix, grid.origin, grid.spacing, out)
    consent = np.empty(grid.shape, np.float32)
    photo_consistency(samples, options.consistency_scale, options.min_views, consent)
    return consent


def _depths(
    views: Sequence[PosedView],
    silhouettes: Sequence[Silhouette],
    grid: VoxelGrid,
    hull: NDArray[np.bool_],
    options: EvidenceOptions,
    slabs: Slabs,
) -> list[DepthMap]:
    """Match the views' texture behind the hull, where no other obstacle hides it."""
    small = [reduced(v) for v in views]
    coarse = search_grid(views)
    others = tolerant_hull(views, silhouettes, coarse, options, REGION_TOLERANCE, jobs=slabs.jobs)
    low, high = (coarse.index_from_map(corner) for corner in (grid.lower, grid.upper))
    (i0, j0, _), (i1, j1, _) = np.maximum(np.floor(low), 0).astype(int), np.ceil(high).astype(int)
    others[i0 : i1 + 1, j0 : j1 + 1] = False

    def entry(view: PosedView) -> Volume:
        depth = entry_depth(hull, grid, view)
        return np.where(entry_depth(others, coarse, view) < depth, np.inf, depth).astype(np.float32)

    return depth_maps(small, slabs.map(entry, small), (grid.lower + grid.upper) / 2, slabs.jobs)


def _vote(
    matrices: Sequence[Float], maps: Sequence[DepthMap], grid: VoxelGrid, band: float, f: Volume
) -> None:
    """Correct the volume term inside the hull, in place, by the surfaces that views agree on."""
    hull = f < 0
    votes, weight = np.zeros(grid.shape, np.float32), np.zeros(grid.shape, np.float32)
    for matrix, m in zip(matrices, maps, strict=True):
        fuse_depth(
            m.depth, m.confidence, matrix, grid.origin, grid.spacing, band, hull,
            votes, weight,
        )  # fmt: skip
    free, trust = votes / np.maximum(weight, 1e-6), np.minimum(weight, 1)
    f[hull] = ((1 - trust) * f + 0.5 * trust * free)[hull]


def find_regions(
    views: Sequence[PosedView],
    silhouettes: Sequence[Silhouette],
    options: EvidenceOptions,
    jobs: int = 1,
) -> list[Region]:
    """Boxes of the map in which obstacles stand.

    A coarse hull over all ground near the cameras is split into connected parts; parts that do
    not reach the ground are dropped (nothing floats), boxes that touch are joined.

    Parameters
    ----------
    views : sequence of PosedView
    silhouettes : sequence of (H, W) float32
        Theirs, NaN where unknown.
    options : EvidenceOptions
    jobs : int
        Threads; the result does not depend on them.

    Returns
    -------
    regions : list of Region
        Largest first; empty if nothing stands on the ground.
    """
    grid = search_grid(views)
    inside = tolerant_hull(views, silhouettes, grid, options, REGION_TOLERANCE, jobs=jobs)
    return regions_of(inside, grid, MARGIN)
