"""The raster of an overhead map, and the views laid on it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.ground import footprint, pixel_from_plane
from gvpipe.core.kernels.mosaic import black_border
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

    def coarser(self, factor: int) -> "MosaicRaster":
        """Raster of cells of `factor` by `factor` pixels each, the first at pixel (0, 0)."""
        half = (factor - 1) / 2 * self.resolution
        return MosaicRaster(
            width=-(-self.width // factor),
            height=-(-self.height // factor),
            resolution=self.resolution * factor,
            x_min=self.x_min + half,
            y_max=self.y_max - half,
        )


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
class PlacedView:
    """A view laid on a raster.

    Attributes
    ----------
    view : PosedView
        The view.
    pixel_from_raster : (3, 3) float64
        Raster pixels to image pixels; the third component is the depth, metres.
    max_depth : float
        Ground deeper than this is not used, metres.
    box : (u_min, v_min, u_max, v_max)
        Raster pixels outside of which the view shows nothing.
    rows, columns : (H, 2), (W, 2) int32
        First and last image pixel of each row and column inside the image's black border.
    """

    view: PosedView
    pixel_from_raster: Float
    max_depth: float
    box: tuple[float, float, float, float]
    rows: NDArray[np.int32]
    columns: NDArray[np.int32]

    def touches(self, column: int, row: int, width: int, height: int) -> bool:
        """Whether the view may show something of a rectangle of the raster."""
        u_min, v_min, u_max, v_max = self.box
        return bool(
            u_min < column + width and u_max >= column and v_min < row + height and v_max >= row
        )


def place(view: PosedView, raster: MosaicRaster, depth: float) -> PlacedView | None:
    """Lay a view on a raster, down to a depth in metres; None if it shows no ground of it."""
    points = outline(view, raster.resolution)
    if not len(points):
        return None
    u = (points[:, 0] - raster.x_min) / raster.resolution
    v = (raster.y_max - points[:, 1]) / raster.resolution
    return PlacedView(
        view,
        pixel_from_plane(view.camera, view.map_from_camera) @ raster.map_from_pixel,
        depth,
        # half a pixel more on every side: a pixel's samples may lie beside its centre
        (float(u.min()) - 0.5, float(v.min()) - 0.5, float(u.max()) + 0.5, float(v.max()) + 0.5),
        *black_border(view.pixels),
    )
