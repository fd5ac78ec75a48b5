"""The ground plane seen by a tilted camera: homographies, overhead views, footprints."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gvpipe.core.geometry.homography import apply
from gvpipe.core.geometry.pose import robot_from_camera
from gvpipe.core.types import Camera, Float, Image, Mount, Pose


def pixel_from_plane(camera: Camera, frame_from_camera: Pose) -> Float:
    """Homography from the plane z = 0 of a frame to the pixels of a camera.

    Parameters
    ----------
    camera : Camera
        Intrinsics.
    frame_from_camera : Pose
        Pose of the camera in the frame whose plane z = 0 is the ground.

    Returns
    -------
    pixel_from_plane : (3, 3) float64
        Takes (x, y, 1) in metres to homogeneous pixels; the third component is the depth along
        the optical axis in metres, so points with a positive one are in front of the camera.

    Notes
    -----
    The plane z = 0 drops the third column of ``K [R | t]`` (thesis eq. 3.2.2, corrected).
    """
    return pixels_from_plane(
        camera.matrix, frame_from_camera.rotation, frame_from_camera.translation
    )


def pixels_from_plane(matrix: Float, rotation: Float, translation: Float) -> Float:
    """Homographies (..., 3, 3) of :func:`pixel_from_plane` of many cameras.

    Parameters
    ----------
    matrix : (..., 3, 3) float64
        Calibration matrices.
    rotation : (..., 3, 3) float64, translation : (..., 3) float64
        Poses of the cameras in the frame.
    """
    back = np.swapaxes(rotation, -1, -2)
    shift = -(back @ translation[..., None])
    return np.asarray(matrix @ np.concatenate([back[..., :2], shift], axis=-1))


def calibrations(cameras: Sequence[Camera]) -> Float:
    """Calibration matrices (N, 3, 3) of cameras, of which most are the same."""
    kinds: dict[Camera, int] = {}
    number = [kinds.setdefault(camera, len(kinds)) for camera in cameras]
    return np.array([camera.matrix for camera in kinds]).reshape(-1, 3, 3)[number]


def pixel_from_ground(camera: Camera, mount: Mount) -> Float:
    """Homography from the robot's own ground frame (x forward, y left, metres) to pixels.

    See :func:`pixel_from_plane`; the frame is the robot frame below the camera.
    """
    return pixel_from_plane(camera, robot_from_camera(mount))


def plane_normal(mount: Mount) -> Float:
    """Return the unit normal of the ground in camera axes, (3,), from the camera to the ground.

    For zero roll this is ``(0, cos tilt, sin tilt)`` (thesis eq. 4.2.3 with y down and the tilt
    counted from the horizon).
    """
    return -robot_from_camera(mount).rotation[2]


@dataclass(frozen=True)
class OverheadGrid:
    """A raster of the ground seen from straight above, forward up and left on the left.

    Attributes
    ----------
    pixels_per_metre : float
        Scale.
    x_max, y_max : float
        Ground coordinates of the centre of pixel (0, 0), metres: the far left corner.
    width, height : int
        Size in pixels.
    """

    pixels_per_metre: float
    x_max: float
    y_max: float
    width: int
    height: int

    @property
    def overhead_from_ground(self) -> Float:
        """(3, 3) map from ground (x forward, y left, metres) to raster (u right, v down)."""
        s = self.pixels_per_metre
        return np.array([[0.0, -s, s * self.y_max], [-s, 0.0, s * self.x_max], [0.0, 0.0, 1.0]])

    @property
    def ground_from_overhead(self) -> Float:
        """(3, 3) inverse of :attr:`overhead_from_ground`."""
        m = 1.0 / self.pixels_per_metre
        return np.array([[0.0, -m, self.x_max], [-m, 0.0, self.y_max], [0.0, 0.0, 1.0]])


def footprint(camera: Camera, mount: Mount, max_range: float, samples: int = 24) -> Float:
    """Outline on the ground of what the camera sees of it.

    Parameters
    ----------
    camera, mount : Camera, Mount
        The view.
    max_range : float
        Ground farther than this from the robot is cut off, metres.
    samples : int
        Points taken along each image side.

    Returns
    -------
    outline : (N, 2) float64
        Ground points (x forward, y left), metres, of the image border, those above the horizon
        or beyond `max_range` pulled in to that range along their bearing. Empty if the camera
        sees no ground.
    """
    u = np.linspace(-0.5, camera.width - 0.5, samples)
    v = np.linspace(-0.5, camera.height - 0.5, samples)
    border = np.concatenate(
        [
            np.column_stack([u, np.full_like(u, -0.5)]),
            np.column_stack([np.full_like(v, camera.width - 0.5), v]),
            np.column_stack([u[::-1], np.full_like(u, camera.height - 0.5)]),
            np.column_stack([np.full_like(v, -0.5), v[::-1]]),
        ]
    )
    rays = (
        np.column_stack([border, np.ones(len(border))])
        @ camera.inverse.T
        @ robot_from_camera(mount).rotation.T
    )
    if (rays[:, 2] >= 0).all():
        return np.empty((0, 2))
    horizontal = np.hypot(rays[:, 0], rays[:, 1])
    down = np.maximum(-rays[:, 2], 1e-12)
    reach = np.minimum(mount.height * horizontal / down, max_range)
    return rays[:, :2] / np.maximum(horizontal, 1e-12)[:, None] * reach[:, None]


def overhead_grid(
    camera: Camera, mount: Mount, pixels_per_metre: float, max_range: float
) -> OverheadGrid:
    """Smallest raster of the given scale that holds the camera's :func:`footprint`.

    Parameters
    ----------
    camera, mount : Camera, Mount
        The view.
    pixels_per_metre : float
        Scale.
    max_range : float
        Ground farther than this from the robot is left out, metres.

    Returns
    -------
    grid : OverheadGrid

    Raises
    ------
    ValueError
        If the camera sees no ground.
    """
    outline = footprint(camera, mount, max_range)
    if not len(outline):
        raise ValueError("the camera sees no ground")
    x_min, y_min = outline.min(axis=0)
    x_max, y_max = outline.max(axis=0)
    return OverheadGrid(
        pixels_per_metre=pixels_per_metre,
        x_max=float(x_max),
        y_max=float(y_max),
        width=int(np.ceil((y_max - y_min) * pixels_per_metre)) + 1,
        height=int(np.ceil((x_max - x_min) * pixels_per_metre)) + 1,
    )


def overhead_view(
    pixels: Image, camera: Camera, mount: Mount, grid: OverheadGrid
) -> tuple[Image, NDArray[np.bool_]]:
    """Undo the perspective: the ground as seen from straight above.

    Parameters
    ----------
    pixels : (H, W, 3) uint8
        The image.
    camera, mount : Camera, Mount
        Its intrinsics and how it was held.
    grid : OverheadGrid
        The raster to fill.

    Returns
    -------
    overhead : (h, w, 3) uint8
        Bilinear samples; zero where the camera does not see.
    seen : (h, w) bool
        True where the ground point lies in front of the camera and inside the image.
    """
    pixel_from_overhead = pixel_from_ground(camera, mount) @ grid.ground_from_overhead
    size = (grid.width, grid.height)
    overhead = cv2.warpPerspective(
        pixels, pixel_from_overhead, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    )
    return overhead.astype(np.uint8, copy=False), seen_from(pixel_from_overhead, camera, size)


def seen_from(pixel_from_raster: Float, camera: Camera, size: tuple[int, int]) -> NDArray[np.bool_]:
    """Which raster pixels project in front of the camera and inside its image.

    Parameters
    ----------
    pixel_from_raster : (3, 3) float64
        Homography with positive third component in front of the camera.
    camera : Camera
        For the image size.
    size : (int, int)
        Raster width and height.

    Returns
    -------
    seen : (height, width) bool
    """
    width, height = size
    a = np.asarray(pixel_from_raster, dtype=np.float64)
    u, v = np.arange(width)[None, :], np.arange(height)[:, None]
    x, y, w = (a[k, 0] * u + a[k, 1] * v + a[k, 2] for k in range(3))
    return (
        (w > 0)
        & (x >= 0)
        & (x <= (camera.width - 1) * w)
        & (y >= 0)
        & (y <= (camera.height - 1) * w)
    )


def ground_points(pixels: Float, camera: Camera, mount: Mount) -> tuple[Float, NDArray[np.bool_]]:
    """Ground points under pixels.

    Parameters
    ----------
    pixels : (N, 2) float64
        Pixels (u right, v down).
    camera, mount : Camera, Mount
        The view.

    Returns
    -------
    points : (N, 2) float64
        Ground coordinates (x forward, y left), metres; meaningless above the horizon.
    below_horizon : (N,) bool
        True where the pixel's ray meets the ground.
    """
    ground_from_pixel = np.linalg.inv(pixel_from_ground(camera, mount)).astype(np.float64)
    w = pixels @ ground_from_pixel[2, :2] + ground_from_pixel[2, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        points = apply(ground_from_pixel, np.asarray(pixels, dtype=np.float64))
    return points, w > 1e-12
