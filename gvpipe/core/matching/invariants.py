"""The thesis' own features: Harris corners and colour invariants on the overhead view."""

import cv2
import numpy as np

from gvpipe.core.geometry.ground import OverheadGrid, ground_points, overhead_grid, overhead_view
from gvpipe.core.geometry.homography import apply
from gvpipe.core.matching.features import Features, MatchOptions, overhead_scale
from gvpipe.core.types import Float, Image, View

_HARRIS_K = 0.04  # the usual sensitivity of the corner response
_HARRIS_QUALITY = 0.002  # of the strongest response: weak corners are kept, their number is capped
_SIGMOID_MID, _SIGMOID_SLOPE = 20.0, 0.26  # t0 and mu, grey levels a pixel (thesis eq. 3.3.2)


def invariant_overhead(
    view: View, pixels_per_metre: float, max_range: float
) -> tuple[Image, OverheadGrid]:
    """Overhead view of the ground nearer than `max_range` camera heights, and its raster."""
    grid = overhead_grid(view.camera, view.mount, pixels_per_metre, max_range * view.mount.height)
    return overhead_view(view.pixels, view.camera, view.mount, grid)[0], grid


def harris_corners(pixels: Image, most: int, distance_px: float) -> Float:
    """Harris corners of a picture to a fraction of a pixel, strongest first.

    Parameters
    ----------
    pixels : (H, W, 3) uint8
        RGB picture.
    most : int
        Number kept.
    distance_px : float
        Least distance between two of them.

    Returns
    -------
    corners : (N, 2) float64
        Pixels (u right, v down).
    """
    grey = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
    corners = cv2.goodFeaturesToTrack(
        grey, most, _HARRIS_QUALITY, distance_px, useHarrisDetector=True, k=_HARRIS_K
    )
    if corners is None:
        return np.empty((0, 2))
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 20, 0.02)
    cv2.cornerSubPix(grey, corners, (3, 3), (-1, -1), criteria)
    return corners.reshape(-1, 2).astype(np.float64)


def invariant_vectors(overhead: Image, points: Float, smoothing_px: float) -> Float:
    """Rotation invariant colour vectors (thesis eq. 3.3.1 to 3.3.3).

    Parameters
    ----------
    overhead : (h, w, 3) uint8
        Overhead view.
    points : (N, 2) float64
        Its pixels.
    smoothing_px : float
        Standard deviation of the Gaussian, pixels.

    Returns
    -------
    vectors : (N, 6) float64
        Smoothed R, G, B and the sigmoid of their gradient magnitudes, all 0 to 255.
    """
    smooth = cv2.GaussianBlur(overhead.astype(np.float32), (0, 0), smoothing_px)
    # central differences of the smoothed picture are the Gaussian's derivatives
    du = cv2.filter2D(smooth, -1, np.array([[-0.5, 0.0, 0.5]], np.float32))
    dv = cv2.filter2D(smooth, -1, np.array([[-0.5], [0.0], [0.5]], np.float32))
    edge = 255.0 / (1.0 + np.exp(-_SIGMOID_SLOPE * (np.hypot(du, dv) - _SIGMOID_MID)))
    planes = np.concatenate([smooth, edge.astype(np.float32)], axis=2)
    u, v = np.rint(points).astype(int).T
    inside = planes[np.clip(v, 0, planes.shape[0] - 1), np.clip(u, 0, planes.shape[1] - 1)]
    return inside.astype(np.float64)


def describe(view: View, pixels: Float, pixels_per_metre: float, options: MatchOptions) -> Float:
    """Invariant vectors (N, 6) of a picture's ground pixels at a common metric scale."""
    overhead, grid = invariant_overhead(view, pixels_per_metre, options.max_range)
    ground, _ = ground_points(pixels, view.camera, view.mount)
    return invariant_vectors(
        overhead, apply(grid.overhead_from_ground, ground), options.smoothing_px
    )


def extract_invariants(view: View, options: MatchOptions) -> Features:
    """Corners of the original picture that lie on near ground, described on the overhead view."""
    pixels = harris_corners(view.pixels, options.corners, options.corner_distance_px)
    ground, below = ground_points(pixels, view.camera, view.mount)
    near = below & (np.hypot(*ground.T) < options.max_range * view.mount.height)
    pixels, ground = pixels[near], ground[near]
    scale = overhead_scale(view.camera, view.mount)
    return Features("invariants", pixels, ground, describe(view, pixels, scale, options), scale)
