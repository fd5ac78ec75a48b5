"""Single pixels with and without the distortion of the lens."""

import cv2
import numpy as np

from gvpipe.core.geometry.homography import apply
from gvpipe.core.types import Camera, Float

_EXACT = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-14)
"""Where OpenCV's iteration ends: it does five rounds unless told, which leaves up to a pixel."""


def photographed(pixels: Float, camera: Camera, distortion: tuple[float, ...]) -> Float:
    """Where pixels of the undistorted image are in the photograph.

    Parameters
    ----------
    pixels : (N, 2) float64
        Undistorted, centres at integers.
    camera : Camera
        Intrinsics of both.
    distortion : tuple of float
        0, 4, 5 or 8 coefficients in OpenCV order.

    Returns
    -------
    photographed : (N, 2) float64
    """
    if not len(pixels) or not any(distortion):
        return np.array(pixels, dtype=np.float64)
    inverse = camera.inverse
    rays = np.column_stack([apply(inverse, pixels), np.ones(len(pixels))])
    still = np.zeros(3)
    bent, _ = cv2.projectPoints(rays, still, still, np.eye(3), np.array(distortion))
    return apply(camera.matrix, np.asarray(bent, dtype=np.float64).reshape(-1, 2))


def undistorted(pixels: Float, camera: Camera, distortion: tuple[float, ...]) -> Float:
    """Where pixels (N, 2) of the photograph are in the undistorted image, see `photographed`."""
    if not len(pixels) or not any(distortion):
        return np.array(pixels, dtype=np.float64)
    inverse = camera.inverse
    bent = apply(inverse, pixels)
    rays = cv2.undistortPointsIter(
        bent[:, None], np.eye(3), np.array(distortion), np.eye(3), np.eye(3), _EXACT
    )
    return apply(camera.matrix, np.asarray(rays, dtype=np.float64).reshape(-1, 2))
