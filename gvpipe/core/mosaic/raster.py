"""The raster of an overhead map, and the views laid on it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.geometry.ground import footprint, pixel_from_plane
from gvpipe.core.geometry.pose import mount_of, yaw_tilt_roll
from gvpipe.core.kernels.mosaic import black_border
from gvpipe.core.types import Camera, Float, Image, Pose, PosedView

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

    def pixel_from_map(self, points: Float) -> Float:
        """Take (N, 2) map points in metres to pixels (u right, v down), fractions kept."""
        u = (points[:, 0] - self.x_min) / self.resolution
        v = (self.y_max - points[:, 1]) / self.resolution
        return np.column_stack([u, v])

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


class Posed(Protocol):
    """A camera with its place in the map."""

    @property
    def camera(self) -> Camera:
        """Intrinsics."""

    @property
    def map_from_camera(self) -> Pose:
        """Camera to map, metres."""


@dataclass(frozen=True)
class Picture:
    """A posed picture whose pixels are read when they are needed, not kept.

    Attributes
    ----------
    camera : Camera
        Intrinsics of the undistorted pixels.
    map_from_camera : Pose
        Camera to map, metres.
    read : callable
        Gives the (H, W, 3) uint8 pixels; quick when called again soon.
    inside : (H, W) bool or None
        Where the pixels come from the photograph, not from its continued border; None = all.
    """

    camera: Camera
    map_from_camera: Pose
    read: Callable[[], Image]
    inside: NDArray[np.bool_] | None = None

    @classmethod
    def of(cls, view: "PosedView | Picture") -> "Picture":
        """Wrap a view that is in memory."""
        if isinstance(view, Picture):
            return view
        return cls(view.camera, view.map_from_camera, lambda: view.pixels)

    def border(self) -> "Border":
        """First and last pixel of each row and column that show something."""
        pixels = self.read()
        if self.inside is not None:
            pixels = pixels * self.inside[..., None]
        return black_border(pixels)


Border = tuple[NDArray[np.int32], NDArray[np.int32]]
"""First and last pixel of each row (H, 2) and column (W, 2) inside a picture's black border."""


def max_depth(view: Posed, resolution: float) -> float:
    """How deep along the optical axis a view's ground is worth using, metres.

    Notes
    -----
    At depth w a camera of height h and focal length f has pixels of ``w / f`` across and
    ``w^2 / (f h)`` along the line of sight, so both limits are limits of the depth.
    """
    height = float(view.map_from_camera.translation[2])
    focal = min(view.camera.fx, view.camera.fy)
    return float(min(MAX_GRAZING * height, np.sqrt(MAX_COARSENESS * resolution * focal * height)))


def outline(view: Posed, resolution: float) -> Float:
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


def plan_raster(views: Sequence[Posed], resolution: float) -> MosaicRaster:
    """Smallest raster that holds the usable ground of all views.

    Parameters
    ----------
    views : sequence of Posed
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
    """A picture laid on a raster.

    Attributes
    ----------
    view : Picture
        The picture.
    pixel_from_raster : (3, 3) float64
        Raster pixels to image pixels; the third component is the depth, metres.
    max_depth : float
        Ground deeper than this is not used, metres.
    box : (u_min, v_min, u_max, v_max)
        Raster pixels outside of which the view shows nothing.
    border : Border
        Of the picture.
    """

    view: Picture
    pixel_from_raster: Float
    max_depth: float
    box: tuple[float, float, float, float]
    border: Border


def place(
    view: Picture, raster: MosaicRaster, depth: float, border: Border | None = None
) -> PlacedView | None:
    """Lay a picture on a raster, down to a depth in metres; None if it shows no ground of it.

    Its pixels are read only if the border is not given.

    Parameters
    ----------
    view : Picture
    raster : MosaicRaster
    depth : float
        Ground deeper than this is not used, metres.
    border : Border, optional
        Of the picture, if it is known.

    Returns
    -------
    placed : PlacedView or None
    """
    points = outline(view, raster.resolution)
    if not len(points):
        return None
    u, v = raster.pixel_from_map(points).T
    return PlacedView(
        view,
        pixel_from_plane(view.camera, view.map_from_camera) @ raster.map_from_pixel,
        depth,
        # half a pixel more on every side: a pixel's samples may lie beside its centre
        (float(u.min()) - 0.5, float(v.min()) - 0.5, float(u.max()) + 0.5, float(v.max()) + 0.5),
        view.border() if border is None else border,
    )


def whole_from_part(column: int, row: int) -> Float:
    """(3, 3) matrix from pixels of a part to those of the whole; the part begins at a pixel."""
    return np.array([[1.0, 0.0, column], [0.0, 1.0, row], [0.0, 0.0, 1.0]])


class PlacedIndex:
    """Which of many placed views may show something of a rectangle.

    Parameters
    ----------
    placed : sequence of PlacedView or None
        On the same raster.
    """

    def __init__(self, placed: Sequence[PlacedView | None]) -> None:
        nowhere = (np.inf, np.inf, -np.inf, -np.inf)
        boxes = [nowhere if p is None else p.box for p in placed]
        self._boxes = np.array(boxes).reshape(-1, 4)

    def touching(self, column: int, row: int, width: int, height: int) -> NDArray[np.intp]:
        """Positions in the sequence, in its order.

        Parameters
        ----------
        column, row, width, height : int
            The rectangle, raster pixels.

        Returns
        -------
        places : (n,) int
        """
        b = self._boxes
        return np.flatnonzero(
            (b[:, 0] < column + width)
            & (b[:, 2] >= column)
            & (b[:, 1] < row + height)
            & (b[:, 3] >= row)
        )
