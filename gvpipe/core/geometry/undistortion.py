"""Lens distortion taken out of images, the calibration matrix kept."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gvpipe.core.types import Camera, Image


@dataclass(frozen=True)
class Undistortion:
    """Where each pixel of the undistorted image comes from.

    Attributes
    ----------
    source : (H, W, 2) int16
        Whole part of the distorted pixel (u right, v down).
    fraction : (H, W) uint16
        Index of its fraction in OpenCV's table of 1/32 pixel steps.
    inside : (H, W) bool
        False where that pixel lies outside the photograph: nothing is known there.
    """

    source: NDArray[np.int16]
    fraction: NDArray[np.uint16]
    inside: NDArray[np.bool_]


def undistortion(camera: Camera, distortion: tuple[float, ...]) -> Undistortion:
    """Tabulate the distortion of a camera.

    Parameters
    ----------
    camera : Camera
        Intrinsics, the same before and after.
    distortion : tuple of float
        4, 5 or 8 coefficients in OpenCV order (k1 k2 p1 p2 k3 k4 k5 k6).

    Returns
    -------
    undistortion : Undistortion
    """
    k = camera.matrix
    u, v = cv2.initUndistortRectifyMap(
        k, np.array(distortion), np.eye(3), k, (camera.width, camera.height), cv2.CV_32FC1
    )
    # OpenCV takes the skew out on the way to rays but not back in on the way to pixels
    u = u + np.float32(camera.skew / camera.fy) * (v - np.float32(camera.cy))
    # half a pixel beyond the outermost centres still is photograph
    inside = (u >= -0.5) & (u <= camera.width - 0.5) & (v >= -0.5) & (v <= camera.height - 0.5)
    source, fraction = cv2.convertMaps(u, v, cv2.CV_16SC2)
    return Undistortion(np.asarray(source, np.int16), np.asarray(fraction, np.uint16), inside)


def undistort(pixels: Image, table: Undistortion) -> Image:
    """Resample an image without its distortion.

    Parameters
    ----------
    pixels : (H, W, 3) uint8
        As photographed.
    table : Undistortion
        Of its camera.

    Returns
    -------
    undistorted : (H, W, 3) uint8
        Bicubic; outside the photograph its border is continued, since an edge to black would look
        like texture that moves with the camera.
    """
    undistorted = cv2.remap(
        pixels, table.source, table.fraction, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(undistorted, dtype=np.uint8)
