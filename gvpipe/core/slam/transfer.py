"""Matched pixels brought to the ground, and from image to image, by the poses of a map."""

import numpy as np

from gvpipe.core.geometry.ground import pixel_from_plane
from gvpipe.core.geometry.homography import apply, transfer_errors
from gvpipe.core.slam.links import Link
from gvpipe.core.types import Camera, Float, Pose


def map_from_pixel(camera: Camera, map_from_camera: Pose) -> Float:
    """Homography (3, 3) from pixels to the ground plane of the map, metres."""
    return np.asarray(np.linalg.inv(pixel_from_plane(camera, map_from_camera)), dtype=np.float64)


def median_error_px(link: Link, cameras: tuple[Camera, Camera], poses: tuple[Pose, Pose]) -> float:
    """Median transfer error of a link's matches in image j under the map, pixels."""
    j_from_i = pixel_from_plane(cameras[1], poses[1]) @ map_from_pixel(cameras[0], poses[0])
    return float(np.median(transfer_errors(j_from_i, link.points_i, link.points_j)))


def median_distance(here: Float, there: Float) -> float:
    """Median distance between two lists of ground points (N, 2), metres."""
    distance = np.linalg.norm(here - there, axis=1)
    return float(np.median(np.where(np.isfinite(distance), distance, np.inf)))


def residual_m(link: Link, cameras: tuple[Camera, Camera], poses: tuple[Pose, Pose]) -> float:
    """Median distance on the ground between the two placements of a link's matches, metres."""
    return median_distance(
        apply(map_from_pixel(cameras[0], poses[0]), link.points_i),
        apply(map_from_pixel(cameras[1], poses[1]), link.points_j),
    )
