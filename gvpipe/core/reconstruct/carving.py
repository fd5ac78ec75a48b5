"""Voxel carving by silhouettes and by colours: the methods that level sets are compared with."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from gvpipe.core.kernels.carving import carve_silhouettes, sweep_colours
from gvpipe.core.reconstruct.evidence_options import Silhouette
from gvpipe.core.reconstruct.grid import VoxelGrid
from gvpipe.core.reconstruct.hull import pixel_from_map
from gvpipe.core.types import Float, PosedView

FOREGROUND = 0.5
"""Mask values from here on count as obstacle."""

LEAST_VIEWS = 2
"""Voxels that fewer views see stay empty: one silhouette is a cone without an end."""

LARGEST_BLOCK = 32
"""Side of the octree's largest blocks, voxels."""

COLOUR_DEVIATION = 40.0
"""Standard deviation between views, grey levels (root of the summed squares of R, G and B), above
which a voxel is not on the surface: shading and exposure change a mat surface by less."""

REPEATED_DEVIATION = 60.0
"""The same for space carving, which asks each voxel in six directions and many rounds and would
otherwise carve the share of true surface that fails once by chance."""

MOST_ROUNDS = 4
"""Rounds of six sweeps: later ones carve a few voxels only."""

SMOOTHING = 0.8
"""Standard deviation of the blur that turns occupancy into a smooth surface, voxels."""

Occupancy = NDArray[np.bool_]
"""(nx, ny, nz) bool."""


def visual_hull(
    views: Sequence[PosedView],
    masks: Sequence[Silhouette],
    grid: VoxelGrid,
    *,
    least_views: int = LEAST_VIEWS,
) -> Occupancy:
    """Intersect the cones of all silhouettes (thesis, section 5.2.2).

    Parameters
    ----------
    views : sequence of PosedView
    masks : sequence of (H, W) float32
        One silhouette a view; NaN or negative where the view says nothing.
    grid : VoxelGrid
    least_views : int
        Voxels that fewer views see are left empty.

    Returns
    -------
    occupied : (nx, ny, nz) bool
        Voxels whose centre no view sees as background.

    Raises
    ------
    ValueError
        If a mask has not the size of its view, or there is not one for each.
    """
    stack = _stack(views, masks)
    background = _summed(stack.known & ~stack.foreground)
    return carve_silhouettes(
        _pixel_from_index(views, grid), background, _summed(stack.known), least_views,
        LARGEST_BLOCK, grid.shape,
    )  # fmt: skip


def voxel_coloring(
    views: Sequence[PosedView],
    masks: Sequence[Silhouette],
    grid: VoxelGrid,
    *,
    least_views: int = LEAST_VIEWS,
    deviation: float = COLOUR_DEVIATION,
) -> Occupancy:
    """Carve the visual hull by colour, one layer after the other from the top.

    Parameters
    ----------
    views, masks, grid, least_views
        As for :func:`visual_hull`.
    deviation : float
        Largest standard deviation of a surface voxel's colours, grey levels.

    Returns
    -------
    occupied : (nx, ny, nz) bool
        Solid: voxels that no view sees stay.

    Notes
    -----
    Needs all cameras on one side of the scene so that the layers have one order (Seitz and Dyer,
    IJCV 35, 1999); cameras on a robot are above what they look at. A view below a layer has no
    say in it.
    """
    occupied = visual_hull(views, masks, grid, least_views=least_views)
    _Sweeper(views, masks, grid, deviation).sweep(occupied, axis=2, forward=False)
    return occupied


def space_carving(
    views: Sequence[PosedView],
    masks: Sequence[Silhouette],
    grid: VoxelGrid,
    *,
    least_views: int = LEAST_VIEWS,
    deviation: float = REPEATED_DEVIATION,
) -> Occupancy:
    """Carve the visual hull by colour with planes along all six directions until nothing changes.

    Parameters and result are those of :func:`voxel_coloring`; the cameras may be anywhere
    (Kutulakos and Seitz, IJCV 38, 2000).
    """
    occupied = visual_hull(views, masks, grid, least_views=least_views)
    sweeper = _Sweeper(views, masks, grid, deviation)
    for _ in range(MOST_ROUNDS):
        carved = sum(
            sweeper.sweep(occupied, axis, forward)
            for axis in (2, 0, 1)
            for forward in (False, True)
        )
        if carved == 0:
            break
    return occupied


def level_set_of(occupied: Occupancy, grid: VoxelGrid) -> NDArray[np.float32]:
    """Smooth level-set function of an occupancy: positive inside, about metres near its front.

    Parameters
    ----------
    occupied : (nx, ny, nz) bool
    grid : VoxelGrid

    Returns
    -------
    u : (nx, ny, nz) float32
        Its zero level runs halfway between occupied and empty voxels where these are flat.
    """
    blurred = ndimage.gaussian_filter(
        np.where(occupied, 1.0, -1.0).astype(np.float32), SMOOTHING, mode="nearest", truncate=3.0
    )
    # the slope of a blurred step of height 2 is 2 / (sigma sqrt(2 pi))
    slope = 2.0 / (SMOOTHING * np.sqrt(2.0 * np.pi))
    return np.asarray(blurred * np.float32(grid.spacing.min() / slope))


@dataclass(frozen=True)
class _Stack:
    """The masks of all views as one array, padded to the largest image with unknown."""

    known: NDArray[np.bool_]
    foreground: NDArray[np.bool_]


def _stack(views: Sequence[PosedView], masks: Sequence[Silhouette]) -> _Stack:
    """Check masks against their views and pad them to one size."""
    if len(views) != len(masks) or not views:
        raise ValueError(f"{len(masks)} masks for {len(views)} views")
    for view, mask in zip(views, masks, strict=True):
        if mask.shape != view.pixels.shape[:2]:
            raise ValueError(f"{view.image_id}: mask {mask.shape}, image {view.pixels.shape[:2]}")
    height, width = (max(m.shape[a] for m in masks) for a in range(2))
    values = np.full((len(masks), height, width), -1.0, dtype=np.float32)
    for row, mask in zip(values, masks, strict=True):
        row[: mask.shape[0], : mask.shape[1]] = np.where(np.isnan(mask), -1.0, mask)
    return _Stack(known=values >= 0, foreground=values >= FOREGROUND)


def _summed(pixels: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Summed-area table of each view, (V, H + 1, W + 1)."""
    total = np.zeros((len(pixels), pixels.shape[1] + 1, pixels.shape[2] + 1), dtype=np.int32)
    np.cumsum(np.cumsum(pixels, axis=1, dtype=np.int32), axis=2, out=total[:, 1:, 1:])
    return total


def _pixel_from_index(views: Sequence[PosedView], grid: VoxelGrid) -> Float:
    """(V, 3, 4) projections from homogeneous voxel indices."""
    map_from_index = np.eye(4)
    map_from_index[:3, :3] = np.diag(grid.spacing)
    map_from_index[:3, 3] = grid.origin
    return np.stack([pixel_from_map(view) @ map_from_index for view in views])


class _Sweeper:
    """Pictures and projections in the form the sweeping kernel wants."""

    def __init__(
        self,
        views: Sequence[PosedView],
        masks: Sequence[Silhouette],
        grid: VoxelGrid,
        deviation: float,
    ) -> None:
        self._usable = _stack(views, masks).foreground
        self._images = np.zeros((*self._usable.shape, 3), dtype=np.uint8)
        for row, view in zip(self._images, views, strict=True):
            row[: view.pixels.shape[0], : view.pixels.shape[1]] = view.pixels
        centres = np.stack([view.map_from_camera.translation for view in views])
        self._cameras = grid.index_from_map(centres)
        self._matrices = _pixel_from_index(views, grid)
        self._deviation = deviation

    def sweep(self, occupied: Occupancy, axis: int, forward: bool) -> int:
        """Carve in place; how many voxels went."""
        return sweep_colours(
            occupied, axis, forward, self._cameras, self._matrices, self._images, self._usable,
            self._deviation,
        )  # fmt: skip
