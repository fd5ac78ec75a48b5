"""Pictures of the map: obstacles standing on their ground, seen from anywhere."""

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from gvpipe.core.geometry.ground import pixel_from_plane
from gvpipe.core.geometry.pose import planar_pose
from gvpipe.core.kernels.raster import rasterise_colours
from gvpipe.core.reconstruct.background import GroundModel
from gvpipe.core.reconstruct.mesh import Mesh
from gvpipe.core.reconstruct.views import upward
from gvpipe.core.reconstruct.visibility import NEAREST_M, project
from gvpipe.core.types import Camera, Float, Image, Mount, Pose, PosedView

BACKGROUND = 255.0
"""Grey level of what was never seen."""

LIGHT = np.array([0.35, 0.25, 0.9]) / np.linalg.norm([0.35, 0.25, 0.9])
"""Direction towards the lamp, in the map."""

AMBIENT, AMBIENT_CLAY = 0.65, 0.3
"""Brightness of a surface turned away from the lamp: photographs already hold the true light,
one colour shows its shape by the light only."""

CLAY = np.array([226, 176, 92], np.uint8)
"""Colour of surfaces that are no obstacles yet."""

HEADING = np.radians(250.0)
"""Where a single picture of the scene looks: with the lamp beside the camera, not behind it all."""

TILT = np.radians(35.0)
"""How steeply pictures of the whole scene look down."""


def render(
    mesh: Mesh,
    ground: GroundModel,
    camera: Camera,
    map_from_camera: Pose,
    ambient: float = AMBIENT,
) -> Image:
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
    ambient : float
        Brightness of a surface turned away from the lamp, 0 to 1.

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
    bright = ambient + (1.0 - ambient) * np.maximum(mesh.normals @ LIGHT, 0.0)
    colours = mesh.colours * bright[:, None]
    rasterise_colours(pixels, depths, mesh.faces, colours, NEAREST_M, nearness, picture)
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def _ground_nearness(camera: Camera, map_from_camera: Pose) -> NDArray[np.float64]:
    """One over the depth of the ground at each pixel, zero above the horizon."""
    down = -upward(camera, map_from_camera)
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
    bounds = (mesh.vertices.min(axis=0), mesh.vertices.max(axis=0))
    headings = 2 * np.pi * np.arange(count) / count
    return [render(mesh, ground, *_standpoint(bounds, float(h), size)) for h in headings]


def sculpture(
    mesh: Mesh, ground: GroundModel, bounds: tuple[Float, Float], size: tuple[int, int]
) -> Image:
    """Draw a surface without its colours, to show its shape.

    Parameters
    ----------
    mesh : Mesh
        May be empty.
    ground : GroundModel
        The mosaic.
    bounds : ((3,), (3,)) float64
        Corners of what the picture is to show, map coordinates, metres.
    size : (int, int)
        Width and height, pixels.

    Returns
    -------
    picture : (H, W, 3) uint8
    """
    plain = replace(mesh, colours=np.broadcast_to(CLAY, mesh.vertices.shape))
    standpoint = _standpoint(bounds, float(HEADING), size)
    return render(plain, ground, *standpoint, ambient=AMBIENT_CLAY)


def _standpoint(
    bounds: tuple[Float, Float], heading: float, size: tuple[int, int]
) -> tuple[Camera, Pose]:
    """Choose a camera that has a box of the map in its picture, looking along a heading."""
    low, high = bounds
    middle, distance = (low + high) / 2, 1.6 * float(np.linalg.norm(high - low))
    width, height = size
    focal = 1.2 * width
    camera = Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    mount = Mount(TILT, 0.0, float(middle[2] + distance * np.sin(TILT)))
    back = distance * np.cos(TILT)
    x, y = middle[:2] - back * np.array([np.cos(heading), np.sin(heading)])
    return camera, planar_pose(float(x), float(y), heading, mount)
