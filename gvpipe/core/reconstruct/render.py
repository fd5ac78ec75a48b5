"""Pictures of the map: obstacles standing on their ground, seen from anywhere."""

import cv2
import numpy as np
from numpy.typing import NDArray

from gvpipe.core.geometry.ground import pixel_from_plane
from gvpipe.core.geometry.pose import planar_pose
from gvpipe.core.kernels.raster import rasterise_colours
from gvpipe.core.reconstruct.background import GroundModel
from gvpipe.core.reconstruct.mesh import Mesh
from gvpipe.core.reconstruct.visibility import NEAREST_M, project
from gvpipe.core.types import Camera, Float, Image, Mount, Pose, PosedView

BACKGROUND = 255.0
"""Grey level of what was never seen."""

LIGHT = np.array([0.35, 0.25, 0.9]) / np.linalg.norm([0.35, 0.25, 0.9])
"""Direction towards the lamp, in the map."""

AMBIENT = 0.65
"""Brightness of a surface turned away from the lamp: its colours already hold the true light."""


def render(mesh: Mesh, ground: GroundModel, camera: Camera, map_from_camera: Pose) -> Image:
    """Draw the map as a camera would see it.

    Parameters
    ----------
    mesh : Mesh
        Obstacles with colours.
    ground : GroundModel
        The mosaic.
    camera : Camera
        Size and intrinsics of the picture.
    map_from_camera : Pose
        Where it is taken from, above the ground.

    Returns
    -------
    picture : (H, W, 3) uint8
        White where nothing was ever seen.
    """
    size = (camera.width, camera.height)
    pixel_from_raster = pixel_from_plane(camera, map_from_camera) @ ground.map_from_pixel
    warped = cv2.warpPerspective(ground.raster, pixel_from_raster, size, flags=cv2.INTER_LINEAR)
    nearness = _ground_nearness(camera, map_from_camera)
    share = np.where(nearness > 0, warped[..., 3] / 255.0, 0.0)[..., None]
    picture = share * warped[..., :3] + (1.0 - share) * BACKGROUND
    view = PosedView("", warped[..., :3].astype(np.uint8), camera, map_from_camera)
    pixels, depths = project(mesh.vertices, view)
    bright = AMBIENT + (1.0 - AMBIENT) * np.maximum(mesh.normals @ LIGHT, 0.0)
    colours = mesh.colours * bright[:, None]
    rasterise_colours(pixels, depths, mesh.faces, colours, NEAREST_M, nearness, picture)
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def _ground_nearness(camera: Camera, map_from_camera: Pose) -> NDArray[np.float64]:
    """One over the depth of the ground at each pixel, zero above the horizon."""
    ray_z: Float = map_from_camera.rotation[2] @ np.linalg.inv(camera.matrix)
    u, v = np.arange(camera.width)[None, :], np.arange(camera.height)[:, None]
    down = -(ray_z[0] * u + ray_z[1] * v + ray_z[2])
    # a hair less near than it is, so that faces on the ground win
    return np.maximum(down, 0.0) / float(map_from_camera.translation[2]) * (1 - 1e-6)


def turntable(
    mesh: Mesh, ground: GroundModel, count: int, size: tuple[int, int] = (640, 480)
) -> list[Image]:
    """Draw the obstacles from all round.

    Parameters
    ----------
    mesh : Mesh
        Obstacles with colours, at least one vertex.
    ground : GroundModel
        The mosaic.
    count : int
        Pictures, at equal angles.
    size : (int, int)
        Width and height of each, pixels.

    Returns
    -------
    pictures : list of (H, W, 3) uint8
    """
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    middle, extent = (low + high) / 2, float(np.linalg.norm(high - low))
    width, height = size
    focal = 1.2 * width
    camera = Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    tilt, distance = np.radians(35.0), 1.35 * extent
    mount = Mount(tilt, 0.0, float(middle[2] + distance * np.sin(tilt)))
    pictures = []
    for k in range(count):
        heading = 2 * np.pi * k / count
        back = distance * np.cos(tilt)
        x, y = middle[:2] - back * np.array([np.cos(heading), np.sin(heading)])
        pose = planar_pose(float(x), float(y), heading, mount)
        pictures.append(render(mesh, ground, camera, pose))
    return pictures
