"""The visual hull of soft silhouettes: where obstacles may stand, and what they hide."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from gvpipe.core.kernels.evidence import add_view_evidence
from gvpipe.core.kernels.raycast import cast_depth
from gvpipe.core.reconstruct.evidence_options import EvidenceOptions, Silhouette
from gvpipe.core.reconstruct.grid import Volume, VoxelGrid
from gvpipe.core.reconstruct.slabs import Slabs, thin_slabs
from gvpipe.core.types import Float, PosedView

Bool = NDArray[np.bool_]
Box = tuple[NDArray[np.int64], NDArray[np.int64]]
"""First voxel of a box and the first one beyond it, (3,) int64 each."""

COARSE_VOXELS = 2_000_000
"""Voxels of the search for regions: bounds its time to about a second for ten views."""

COARSE_PER_HEIGHT = 50
"""Voxels of that search per camera height: obstacles of a 25th of it are two voxels high."""

RANGE_PER_HEIGHT = 2.5
"""Ground farther than this many camera heights from all cameras is not searched."""

LATTICE = 64
"""Steps along each side of the ground in the search for what enough views see."""

SPECK = 27
"""Voxels below which a part is noise: 3 across, on average."""

STANDING_LAYERS = 3
"""A part stands on the ground if it reaches down to one of this many lowest layers."""

VIEW_SHARE = 0.2
"""Share of the views that can see the best seen ground which must be able to judge a point."""


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


@dataclass(frozen=True)
class VoxelSolid:
    """Occupied voxels of a grid.

    Attributes
    ----------
    inside : (nx, ny, nz) bool
    grid : VoxelGrid
    """

    inside: Bool
    grid: VoxelGrid


def pixel_from_map(view: PosedView) -> Float:
    """(3, 4) projection K [R | t] of the view (thesis eq. 5.5.1), third row the depth in metres."""
    camera_from_map = view.map_from_camera.inverse()
    matrix = view.camera.matrix @ np.column_stack(
        [camera_from_map.rotation, camera_from_map.translation]
    )
    return np.ascontiguousarray(matrix)


def log_support(
    matrices: Sequence[Float],
    silhouettes: Sequence[Silhouette],
    grid: VoxelGrid,
    floor: float,
    *,
    enough: float = -np.inf,
    jobs: int = 1,
) -> tuple[Volume, NDArray[np.uint16]]:
    """Sum the log probabilities of all views that can judge a voxel, and count these.

    Parameters
    ----------
    matrices : sequence of (3, 4) float64
        Pixels from map of the views, see :func:`pixel_from_map`.
    silhouettes : sequence of (H, W) float32
        Theirs, NaN where unknown.
    grid : VoxelGrid
    floor : float
        Lowest probability one view may contribute.
    enough : float
        Views are no longer asked about voxels whose sum has fallen below this.
    jobs : int
        Threads; the result does not depend on them.

    Returns
    -------
    log_sum : (nx, ny, nz) float32
        At most 0.
    count : (nx, ny, nz) uint16
        Views asked that can judge the voxel.
    """
    log_sum = np.zeros(grid.shape, np.float32)
    count = np.zeros(grid.shape, np.uint16)

    def add(bounds: tuple[int, int]) -> None:
        part, slab = grid.part(*bounds), slice(*bounds)
        for matrix, silhouette in zip(matrices, silhouettes, strict=True):
            add_view_evidence(
                silhouette, matrix, part.origin, part.spacing, floor, enough,
                log_sum[slab], count[slab],
            )  # fmt: skip

    with Slabs(jobs) as slabs:
        slabs.map(add, thin_slabs(grid.shape))
    return log_sum, count


def tolerant_hull(
    views: Sequence[PosedView],
    silhouettes: Sequence[Silhouette],
    grid: VoxelGrid,
    options: EvidenceOptions,
    tolerance: float,
    grounded: bool = True,
    jobs: int = 1,
) -> Bool:
    """Voxels that at most a share of their views contradict, in parts that are more than specks.

    Parameters
    ----------
    views : sequence of PosedView
    silhouettes : sequence of (H, W) float32
        Theirs, NaN where unknown.
    grid : VoxelGrid
    options : EvidenceOptions
    tolerance : float
        Share of its views that may contradict a voxel.
    grounded : bool
        Parts must also stand on the ground.
    jobs : int
        Threads; the result does not depend on them.

    Returns
    -------
    inside : (nx, ny, nz) bool
    """
    matrices = [pixel_from_map(v) for v in views]
    log_sum, count = log_support(matrices, silhouettes, grid, options.view_floor, jobs=jobs)
    inside = log_sum > np.log(options.view_floor) * tolerance * count + np.log(0.5)
    inside &= count >= max(options.min_views, VIEW_SHARE * int(count.max()))
    return standing(inside, STANDING_LAYERS if grounded else grid.shape[2])


def standing(inside: Bool, layers: int = STANDING_LAYERS) -> Bool:
    """Keep the connected parts that reach the lowest layers and are more than specks."""
    labels, count = ndimage.label(inside)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    keep = np.zeros(count + 1, bool)
    low = np.unique(labels[:, :, :layers])
    keep[low[sizes[low] >= SPECK]] = True
    keep[0] = False
    kept: Bool = keep[labels]
    return kept


def down_to_ground(inside: Bool) -> Bool:
    """Fill everything below each voxel: under an obstacle no view can see the ground bare."""
    filled: Bool = np.maximum.accumulate(inside[:, :, ::-1], axis=2)[:, :, ::-1]
    return filled


def render_mask(inside: Bool, grid: VoxelGrid, view: PosedView) -> NDArray[np.uint8]:
    """Picture of the voxels in a view: 255 where a ray meets one, (H, W) uint8."""
    return np.isfinite(entry_depth(inside, grid, view)).astype(np.uint8) * np.uint8(255)


def entry_depth(inside: Bool, grid: VoxelGrid, view: PosedView) -> Volume:
    """Depth, (H, W) float32 metres, at which a view's rays enter the voxels; else infinite."""
    depth = np.empty((view.camera.height, view.camera.width), np.float32)
    pose = view.map_from_camera
    map_from_ray = pose.rotation @ view.camera.inverse
    cast_depth(inside, grid.origin, grid.spacing, map_from_ray, pose.translation, depth)
    return depth


def search_grid(views: Sequence[PosedView]) -> VoxelGrid:
    """Coarse voxels over the ground that enough views see near the cameras.

    They reach up to the cameras' median height.

    Parameters
    ----------
    views : sequence of PosedView
        At least one.

    Returns
    -------
    grid : VoxelGrid
        Cubic voxels from the ground up, at most about :data:`COARSE_VOXELS`.
    """
    centres = np.array([v.map_from_camera.translation for v in views])
    height = float(np.median(centres[:, 2]))
    lower = centres.min(axis=0) - RANGE_PER_HEIGHT * height
    upper = centres.max(axis=0) + RANGE_PER_HEIGHT * height
    lower[:2], upper[:2] = _common_ground(views, lower[:2], upper[:2])
    lower[2], upper[2] = 0.0, height
    spacing = height / COARSE_PER_HEIGHT
    spacing = max(spacing, float(np.cbrt(np.prod(upper - lower) / COARSE_VOXELS)))
    return _cover(lower, upper, spacing)


def _common_ground(views: Sequence[PosedView], lower: Float, upper: Float) -> tuple[Float, Float]:
    """Corners (2,) of the part of a box whose ground enough views show."""
    step = (upper - lower) / LATTICE
    x, y = np.meshgrid(*(lower[:, None] + step[:, None] * np.arange(LATTICE + 1)))
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size), np.ones(x.size)])
    count = np.zeros(x.size, int)
    for view in views:
        u, v, depth = pixel_from_map(view) @ points
        size = view.camera.width - 1, view.camera.height - 1
        inside = (depth > 0) & (u >= 0) & (v >= 0)
        count += inside & (u <= size[0] * depth) & (v <= size[1] * depth)
    common = points[:2, count >= max(VIEW_SHARE * count.max(), 1)]
    if not common.size:
        return lower, upper
    return (
        np.maximum(common.min(axis=1) - step, lower),
        np.minimum(common.max(axis=1) + step, upper),
    )


def regions_of(inside: Bool, grid: VoxelGrid, margin: int) -> list[Region]:
    """Boxes around the parts of a coarse hull, grown by a margin of voxels; largest first.

    Boxes that overlap are joined, so that nothing stands in two of them.

    Parameters
    ----------
    inside : (nx, ny, nz) bool
        A coarse hull.
    grid : VoxelGrid
        Of the hull.
    margin : int
        Voxels on all sides.

    Returns
    -------
    regions : list of Region
        Each from the ground up.
    """
    grown = ndimage.binary_dilation(inside, iterations=margin)
    labels, _ = ndimage.label(grown)
    boxes = [  # all of them from the ground up
        (np.array([x.start, y.start, 0]), np.array([x.stop, y.stop, z.stop]))
        for x, y, z in ndimage.find_objects(labels)
    ]
    regions = [
        Region(*(grid.origin + (corner - 0.5) * grid.spacing for corner in box))
        for box in _joined(boxes)
    ]
    return sorted(regions, key=lambda r: -float(np.prod(r.upper - r.lower)))


def _joined(boxes: Sequence[Box]) -> list[Box]:
    """Join boxes, lower and upper corners, as long as any two have a common inside."""
    apart: list[Box] = []
    for box in boxes:
        low, high = box
        while over := [b for b in apart if (b[0] < high).all() and (low < b[1]).all()]:
            apart = [b for b in apart if not any(b is o for o in over)]
            low = np.minimum.reduce([low, *(b[0] for b in over)])
            high = np.maximum.reduce([high, *(b[1] for b in over)])
        apart.append((low, high))
    return apart


def region_grid(region: Region, voxels: int, finest: float) -> VoxelGrid:
    """Cubic voxels over a region, at most about `voxels` of them and none below `finest` metres."""
    size = region.upper - region.lower
    spacing = max(finest, float(np.cbrt(np.prod(size) / voxels)))
    return _cover(region.lower, region.upper, spacing)


def _cover(lower: Float, upper: Float, spacing: float) -> VoxelGrid:
    """Cubic voxels over a box, from its lower corner on."""
    counts = np.maximum(np.ceil((upper - lower) / spacing).astype(int), 1)
    shape = (int(counts[0]), int(counts[1]), int(counts[2]))
    return VoxelGrid(lower + spacing / 2, np.full(3, spacing), shape)
