"""Matched pixels brought to the ground, and from image to image, by the poses of a map."""

import numpy as np

from gvpipe.core.geometry.ground import pixel_from_plane
from gvpipe.core.kernels.transfer import median_gaps, median_misses
from gvpipe.core.slam.links import Matches
from gvpipe.core.types import Camera, Float, Index, Pose


def map_from_pixel(camera: Camera, map_from_camera: Pose) -> Float:
    """Homography (3, 3) from pixels to the ground plane of the map, metres."""
    return np.asarray(np.linalg.inv(pixel_from_plane(camera, map_from_camera)), dtype=np.float64)


def median_distance(here: Float, there: Float) -> float:
    """Median distance between two lists of ground points (N, 2), metres."""
    distance = np.linalg.norm(here - there, axis=1)
    return float(np.median(np.where(np.isfinite(distance), distance, np.inf)))


def median_errors(
    matches: Matches, ends: Index, map_from_pixels: Float, which: Index
) -> tuple[Float, Float]:
    """Tell how far apart the poses of a map place what links say is the same.

    Parameters
    ----------
    matches : Matches
        Of all E links.
    ends : (E, 2) int64
        Numbers of their images.
    map_from_pixels : (N, 3, 3) float64
        See :func:`map_from_pixel`, of all images.
    which : (W,) int64
        Links that are asked about.

    Returns
    -------
    error_px, distance_m : (W,) float64
        Median transfer error of the matches in image j; median distance on the ground.
    """
    map_from_i, map_from_j = (map_from_pixels[ends[which, k]] for k in (0, 1))
    j_from_i = np.linalg.solve(map_from_j, map_from_i)
    arrays = matches.start, matches.points_i, matches.points_j
    return (
        np.asarray(median_misses(*arrays, j_from_i, which)),
        np.asarray(median_gaps(*arrays, map_from_i, map_from_j, which)),
    )
