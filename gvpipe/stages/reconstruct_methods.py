"""The methods of reconstruction by their names in the configuration."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from gvpipe.config import ReconstructConfig
from gvpipe.core.reconstruct.carving import level_set_of, space_carving, visual_hull, voxel_coloring
from gvpipe.core.reconstruct.evidence import data_terms
from gvpipe.core.reconstruct.evidence_options import EvidenceOptions, Silhouette
from gvpipe.core.reconstruct.grid import VoxelGrid
from gvpipe.core.reconstruct.history import Recorder, middle_layer
from gvpipe.core.reconstruct.hull import Region
from gvpipe.core.reconstruct.levelset import evolve
from gvpipe.core.reconstruct.solution import Solution
from gvpipe.core.types import PosedView

Method = Callable[
    [VoxelGrid, Sequence[PosedView], Sequence[Silhouette], ReconstructConfig, int], Solution
]

FEWEST_VOXELS = 8
"""A region has at least this many voxels along each axis."""


def grid_over(region: Region, views: Sequence[PosedView], cells: tuple[int, int, int]) -> VoxelGrid:
    """Lay voxels over a region: as many as configured, none smaller than a pixel's footprint."""
    size = region.upper - region.lower
    middle = (region.lower + region.upper) / 2
    distances = [np.linalg.norm(v.map_from_camera.translation - middle) for v in views]
    focal = np.median([v.camera.fx for v in views])
    pixel = float(np.median(distances) / focal)
    spacing = max(float((size / np.array(cells)).max()), pixel)
    shape = np.maximum(np.ceil(size / spacing).astype(int), FEWEST_VOXELS)
    origin = np.array([*(middle[:2] - (shape[:2] - 1) * spacing / 2), spacing / 2])
    return VoxelGrid(origin, np.full(3, spacing), (int(shape[0]), int(shape[1]), int(shape[2])))


def _level_set(
    grid: VoxelGrid,
    views: Sequence[PosedView],
    shapes: Sequence[Silhouette],
    settings: ReconstructConfig,
    jobs: int,
) -> Solution:
    """Evolve a box that fills the region down to the surface (thesis 5.6)."""
    f, g = data_terms(views, shapes, grid, EvidenceOptions(), jobs)
    g *= np.float32(grid.spacing[0])  # in place: each grid may fill a good part of the memory
    start = np.full(grid.shape, -1.0, np.float32)
    start[2:-2, 2:-2, :-2] = 1.0
    recorder = Recorder(grid)
    found = evolve(
        start,
        f,
        g,
        grid.spacing,
        iterations=settings.iterations,
        evolution=settings.evolution,
        on_iteration=recorder,
        jobs=jobs,
    )
    layer = middle_layer(found.u)
    return Solution(
        u=found.u,
        energy=found.energy,
        iterations=found.iterations,
        converged=found.converged,
        frames=recorder.stacked(),
        frame_iterations=recorder.iterations,
        layer=layer,
        f=f[:, :, layer].copy(),
        g=g[:, :, layer] / np.float32(grid.spacing[0]),
    )


def _carved(carve: Callable[..., NDArray[np.bool_]]) -> Method:
    """Make a method of a carving function: it has no energy and no iterations."""

    def method(
        grid: VoxelGrid,
        views: Sequence[PosedView],
        shapes: Sequence[Silhouette],
        settings: ReconstructConfig,
        jobs: int,
    ) -> Solution:
        return Solution.carved(level_set_of(carve(views, shapes, grid), grid))

    return method


METHODS: dict[str, Method] = {
    "level-set": _level_set,
    "visual-hull": _carved(visual_hull),
    "voxel-coloring": _carved(voxel_coloring),
    "space-carving": _carved(space_carving),
}
"""By name in the configuration: grid, views, silhouettes, settings and threads to a volume."""
