"""The overhead mosaic: its raster, and its composition tile by tile."""

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.blend import Blend
from gvpipe.core.ground import footprint, pixel_from_plane
from gvpipe.core.kernels.mosaic import sample_view
from gvpipe.core.pose import mount_of, yaw_tilt_roll
from gvpipe.core.types import Float, PosedView

MAX_GRAZING = 6.0
"""Depth limit in camera heights: ground seen under less than about 10 degrees, where one image
row covers six times more ground than it is wide, and any error of tilt is multiplied by 30."""

MAX_COARSENESS = 8.0
"""Depth limit by resolution: views whose pixel is longer on the ground than this many map pixels
only blur what nearer views show."""

MAX_SIDE = 40_000
"""Largest side of a mosaic, pixels: beyond it a pose or the resolution is absurd."""

TILE = 128
"""Side of a tile, pixels: all samples of its pixels stay in the cache for some ten views."""


@dataclass(frozen=True)
class MosaicRaster:
    """A raster of the ground, map x to the right and map y up.

    Attributes
    ----------
    width, height : int
        Size, pixels.
    resolution : float
        Metres per pixel.
    x_min, y_max : float
        Map coordinates of the centre of pixel (0, 0), the upper left one.
    """

    width: int
    height: int
    resolution: float
    x_min: float
    y_max: float

    @property
    def map_from_pixel(self) -> Float:
        """(3, 3) map from pixels (u right, v down) to the map (x, y), metres."""
        m = self.resolution
        return np.array([[m, 0.0, self.x_min], [0.0, -m, self.y_max], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class MosaicTile:
    """A composed rectangle of the mosaic.

    Attributes
    ----------
    column, row : int
        Mosaic pixel of the tile's upper left one.
    rgba : (h, w, 4) uint8
        Colours, alpha 0 where nothing was seen.
    views : (h, w) int16
        How many views saw the pixel.
    """

    column: int
    row: int
    rgba: NDArray[np.uint8]
    views: NDArray[np.int16]


@dataclass(frozen=True)
class Mosaic:
    """A whole mosaic in memory.

    Attributes
    ----------
    raster : MosaicRaster
        Where its pixels lie in the map.
    rgba : (height, width, 4) uint8
        Colours, alpha 0 where nothing was seen.
    views : (height, width) int16
        How many views saw the pixel.
    """

    raster: MosaicRaster
    rgba: NDArray[np.uint8]
    views: NDArray[np.int16]


def max_depth(view: PosedView, resolution: float) -> float:
    """How deep along the optical axis a view's ground is worth using, metres.

    Notes
    -----
    At depth w a camera of height h and focal length f has pixels of ``w / f`` across and
    ``w^2 / (f h)`` along the line of sight, so both limits are limits of the depth.
    """
    height = float(view.map_from_camera.translation[2])
    focal = min(view.camera.fx, view.camera.fy)
    return float(min(MAX_GRAZING * height, np.sqrt(MAX_COARSENESS * resolution * focal * height)))


def outline(view: PosedView, resolution: float) -> Float:
    """Outline in the map of the usable ground of a view, (N, 2) metres; empty if there is none."""
    mount = mount_of(view.map_from_camera)
    if mount.height <= 0:
        return np.empty((0, 2))
    depth = max_depth(view, resolution)
    # the ground at that depth is nowhere farther than at the slanted edges of the image
    corner = np.hypot(view.camera.width / view.camera.fx, view.camera.height / view.camera.fy)
    points = footprint(view.camera, mount, depth * float(np.hypot(1.0, corner)))
    yaw = yaw_tilt_roll(view.map_from_camera.rotation)[0]
    c, s = np.cos(yaw), np.sin(yaw)
    return points @ np.array([[c, s], [-s, c]]) + view.map_from_camera.translation[:2]


def plan_raster(views: Sequence[PosedView], resolution: float) -> MosaicRaster:
    """Smallest raster that holds the usable ground of all views.

    Parameters
    ----------
    views : sequence of PosedView
        Cameras in the map.
    resolution : float
        Metres per pixel.

    Returns
    -------
    raster : MosaicRaster
        Pixel centres lie at whole multiples of the resolution, so that mosaics of the same map
        lie on the same grid.

    Raises
    ------
    ValueError
        If no view sees ground, a pose is not finite or the raster would be larger than
        40,000 pixels a side.
    """
    points = np.concatenate([outline(v, resolution) for v in views] or [np.empty((0, 2))])
    if not len(points):
        raise ValueError("no view sees usable ground")
    if not np.isfinite(points).all():
        raise ValueError("a pose is not finite")
    low, high = np.floor(points.min(axis=0) / resolution), np.ceil(points.max(axis=0) / resolution)
    width, height = high - low + 1
    if max(width, height) > MAX_SIDE:
        raise ValueError(
            f"the mosaic would be {width:.0f} x {height:.0f} pixels of {resolution:g} m, more than "
            f"{MAX_SIDE} a side: take a coarser resolution, or a pose is wrong"
        )
    return MosaicRaster(
        width=int(width),
        height=int(height),
        resolution=resolution,
        x_min=float(low[0] * resolution),
        y_max=float(high[1] * resolution),
    )


@dataclass(frozen=True)
class _Placed:
    """A view ready for sampling: homography from mosaic pixels, and its box in the mosaic."""

    view: PosedView
    pixel_from_mosaic: Float
    max_depth: float
    box: tuple[float, float, float, float]


def _place(view: PosedView, raster: MosaicRaster) -> _Placed | None:
    """Prepare a view, or None if it sees no usable ground."""
    points = outline(view, raster.resolution)
    if not len(points):
        return None
    u = (points[:, 0] - raster.x_min) / raster.resolution
    v = (raster.y_max - points[:, 1]) / raster.resolution
    return _Placed(
        view,
        pixel_from_plane(view.camera, view.map_from_camera) @ raster.map_from_pixel,
        max_depth(view, raster.resolution),
        (float(u.min()), float(v.min()), float(u.max()), float(v.max())),
    )


def _compose_tile(
    placed: Sequence[_Placed], column: int, row: int, width: int, height: int, blend: Blend
) -> MosaicTile:
    """Sample all views of a tile and blend them."""
    inside = [
        (k, p)
        for k, p in enumerate(placed)
        if p.box[0] < column + width
        and p.box[2] >= column
        and p.box[1] < row + height
        and p.box[3] >= row
    ]
    rgba = np.zeros((height, width, 4), np.uint8)
    count = np.zeros((height, width), np.int16)
    if inside:
        samples = np.empty((height, width, len(inside), 3), np.float32)
        density = np.empty((height, width, len(inside)), np.float32)
        views = np.empty((height, width, len(inside)), np.int16)
        shift = np.array([[1.0, 0.0, column], [0.0, 1.0, row], [0.0, 0.0, 1.0]])
        for k, p in inside:
            a = p.pixel_from_mosaic @ shift
            sample_view(p.view.pixels, a, p.max_depth, k, samples, density, views, count)
        blend(samples, density, count, rgba)
    return MosaicTile(column, row, rgba, count)


def compose_tiles(
    views: Sequence[PosedView], raster: MosaicRaster, blend: Blend, jobs: int = 1
) -> Iterator[MosaicTile]:
    """Compose a mosaic tile by tile, left to right and top to bottom.

    Parameters
    ----------
    views : sequence of PosedView
        Pictures with their poses in the map.
    raster : MosaicRaster
        What to fill.
    blend : Blend
        One of :data:`gvpipe.core.blend.BLENDS`.
    jobs : int
        Threads; the result does not depend on it.

    Yields
    ------
    tile : MosaicTile
    """
    placed = [p for p in (_place(v, raster) for v in views) if p is not None]

    def tile(corner: tuple[int, int]) -> MosaicTile:
        row, column = corner
        width, height = min(TILE, raster.width - column), min(TILE, raster.height - row)
        return _compose_tile(placed, column, row, width, height, blend)

    corners = [(r, c) for r in range(0, raster.height, TILE) for c in range(0, raster.width, TILE)]
    with ThreadPoolExecutor(max_workers=max(jobs, 1)) as threads:
        # a few tiles ahead of the reader, so that memory stays bounded
        ahead = 4 * max(jobs, 1)
        pending = [threads.submit(tile, c) for c in corners[:ahead]]
        for k in range(len(corners)):
            done = pending[k % ahead].result()
            if k + ahead < len(corners):
                pending[k % ahead] = threads.submit(tile, corners[k + ahead])
            yield done


def compose(
    views: Sequence[PosedView], raster: MosaicRaster, blend: Blend, jobs: int = 1
) -> Mosaic:
    """Compose a whole mosaic in memory; parameters as for :func:`compose_tiles`."""
    rgba = np.zeros((raster.height, raster.width, 4), np.uint8)
    count = np.zeros((raster.height, raster.width), np.int16)
    for tile in compose_tiles(views, raster, blend, jobs):
        h, w = tile.views.shape
        window = np.s_[tile.row : tile.row + h, tile.column : tile.column + w]
        rgba[window], count[window] = tile.rgba, tile.views
    return Mosaic(raster, rgba, count)
