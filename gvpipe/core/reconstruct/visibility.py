"""Which view sees which part of a surface, and in which colour."""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gvpipe.core.kernels.raster import rasterise_depth
from gvpipe.core.reconstruct.mesh import Mesh, PointCloud
from gvpipe.core.types import Float, PosedView

NEAREST_M = 0.02
"""Nothing is rendered nearer to a camera than this, metres: its lens would touch it."""

OCCLUSION_TOLERANCE = 0.01
"""A point counts as seen if nothing is nearer by more than this share of its depth: a few voxels
at arm's length, less than the size of what could hide it."""

MOST_ROWS = 30_000
"""Points sampled at a time: OpenCV maps pictures of fewer than 32,768 rows."""

GRAZING = 0.2
"""Views that meet the surface at a flatter angle (cosine) give no colour if another view does."""


def project(points: Float, view: PosedView) -> tuple[Float, Float]:
    """Project map points into a view.

    Parameters
    ----------
    points : (N, 3) float64
        Map coordinates, metres.
    view : PosedView
        Camera and pose.

    Returns
    -------
    pixels : (N, 2) float64
        (u right, v down); meaningless where the depth is not positive.
    depths : (N,) float64
        Along the optical axis, metres.
    """
    pose = view.map_from_camera
    rays = (np.asarray(points, dtype=np.float64) - pose.translation) @ pose.rotation
    homogeneous = rays @ view.camera.matrix.T
    with np.errstate(divide="ignore", invalid="ignore"):
        return homogeneous[:, :2] / homogeneous[:, 2:], rays[:, 2]


def render_depth(mesh: Mesh, view: PosedView) -> NDArray[np.float32]:
    """Depth map, (H, W) float32 metres, of a mesh seen by a view; infinite where it is not."""
    pixels, depths = project(mesh.vertices, view)
    camera = view.camera
    return rasterise_depth(pixels, depths, mesh.faces, NEAREST_M, camera.height, camera.width)


def sees(depth: NDArray[np.float32], points: Float, view: PosedView) -> NDArray[np.bool_]:
    """Which map points a view sees past the surface rendered into `depth`.

    Parameters
    ----------
    depth : (H, W) float32
        From :func:`render_depth`.
    points : (N, 3) float64
        Map coordinates, metres.
    view : PosedView
        The same view.

    Returns
    -------
    seen : (N,) bool
        In front of the camera, inside the image, and not behind the surface.
    """
    pixels, depths = project(points, view)
    height, width = depth.shape
    seen = (
        (depths > NEAREST_M)
        & (pixels >= 0).all(axis=1)
        & (pixels[:, 0] <= width - 1)
        & (pixels[:, 1] <= height - 1)
    )
    u, v = np.rint(pixels[seen]).astype(np.intp).T
    seen[seen] = depths[seen] <= depth[v, u] * (1.0 + OCCLUSION_TOLERANCE)
    return seen


def colour(mesh: Mesh, views: Sequence[PosedView]) -> Mesh:
    """Colour the vertices of a mesh from the views that see them.

    Parameters
    ----------
    mesh : Mesh
        All surfaces of the scene, since they hide each other.
    views : sequence of PosedView

    Returns
    -------
    mesh : Mesh
        With colours: the mean over the views, weighted by how squarely and how closely each looks
        at the vertex. Vertices that no view sees take the colour of the nearest that one does.
    """
    total, weight = np.zeros((len(mesh.vertices), 3)), np.zeros(len(mesh.vertices))
    for view in views:
        seen = sees(render_depth(mesh, view), mesh.vertices, view)
        ray = view.map_from_camera.translation - mesh.vertices
        distance = np.linalg.norm(ray, axis=1)
        facing = np.einsum("ij,ij->i", ray, mesh.normals) / np.maximum(distance, NEAREST_M)
        seen &= facing > 0
        if not seen.any():
            continue
        sample = _sampled(view, mesh.vertices[seen])
        # a grazing view only decides where there is no better one
        square = np.where(facing > GRAZING, facing**2, 1e-6)[seen] / distance[seen] ** 2
        total[seen] += square[:, None] * sample
        weight[seen] += square
    known = weight > 0
    if not known.any():
        return mesh
    colours = total / np.where(known, weight, 1.0)[:, None]
    if not known.all():
        nearest = cKDTree(mesh.vertices[known]).query(mesh.vertices[~known])[1]
        colours[~known] = colours[known][nearest]
    return replace(mesh, colours=np.rint(colours).astype(np.uint8))


def _sampled(view: PosedView, points: Float) -> Float:
    """Colours, (N, 3), of a view at the projections of map points that it sees."""
    pixels = project(points, view)[0].astype(np.float32)
    parts = [
        cv2.remap(
            view.pixels,
            part[:, :1],
            part[:, 1:],
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REFLECT,
        )[:, 0]
        for part in np.array_split(pixels, len(pixels) // MOST_ROWS + 1)
    ]
    return np.concatenate(parts).astype(np.float64)


def surface_points(mesh: Mesh) -> PointCloud:
    """Dense oriented points of a surface: its vertices above the ground.

    The faces on the ground, which no view can see, are left out (z > 0).
    """
    above = mesh.vertices[:, 2] > 1e-6
    return PointCloud(mesh.vertices[above], mesh.normals[above], mesh.colours[above])
