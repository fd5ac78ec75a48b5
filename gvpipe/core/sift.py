"""SIFT on overhead views: perspective undone first, so that only rotation and scale are left."""

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from gvpipe.core.features import Features, MatchOptions
from gvpipe.core.ground import (
    ground_points,
    overhead_grid,
    overhead_view,
    pixel_from_ground,
)
from gvpipe.core.homography import apply
from gvpipe.core.types import Float, Mount, View

_SCALE = 0.4  # overhead pixels a picture pixel on the axis; SIFT doubles the view again itself
_MAX_AREA = 260_000  # overhead pixels: bounds time and memory for large pictures
_CONTRAST = 0.01  # low, the number of features is capped instead
_ASSUMED_TILTS = (np.radians(28.0), np.radians(52.0))  # of an unknown one: SIFT bears 15 degrees
_BORDER_PX = 6  # nearer to what the camera does not see, gradients are artefacts


def extract_sift(view: View, options: MatchOptions) -> Features:
    """SIFT keypoints and descriptors of the ground seen from above.

    Parameters
    ----------
    view : View
        The image; its mount may be off by several degrees. If its tilt is not known, several are
        assumed in turn and the keypoints of all are kept.
    options : MatchOptions
        ``keypoints`` and ``max_range``.

    Returns
    -------
    features : Features
        With (N, 128) uint8 descriptors (square root of the normalised histogram), angles on the
        ground and sizes in metres.
    """
    mount = view.mount
    if mount.tilt_known:
        return _describe(view, mount, options.keypoints, options.max_range)
    each = options.keypoints // len(_ASSUMED_TILTS)
    parts = [
        _describe(view, replace(mount, tilt=tilt), each, options.max_range)
        for tilt in _ASSUMED_TILTS
    ]
    ground, _ = ground_points(np.concatenate([p.pixels for p in parts]), view.camera, mount)
    return Features(
        kind="sift",
        pixels=np.concatenate([p.pixels for p in parts]),
        ground=ground,
        descriptors=np.concatenate([p.descriptors for p in parts]),
        pixels_per_metre=parts[0].pixels_per_metre,
        angle=np.concatenate([p.angle for p in parts]),
        size=np.concatenate([p.size for p in parts]),
    )


def _describe(view: View, mount: Mount, most: int, max_range: float) -> Features:
    """SIFT on the overhead view that a mount makes."""
    reach = max_range * mount.height
    scale = _SCALE * view.camera.fx * np.sin(mount.tilt) / mount.height
    grid = overhead_grid(view.camera, mount, scale, reach)
    if grid.width * grid.height > _MAX_AREA:
        scale *= np.sqrt(_MAX_AREA / (grid.width * grid.height))
        grid = overhead_grid(view.camera, mount, scale, reach)
    overhead, seen = overhead_view(view.pixels, view.camera, mount, grid)
    side = 2 * _BORDER_PX + 1
    mask = cv2.erode(
        seen.astype(np.uint8), np.ones((side, side), np.uint8), borderType=cv2.BORDER_CONSTANT
    )
    detector = cv2.SIFT.create(most, contrastThreshold=_CONTRAST)
    keypoints, histograms = detector.detectAndCompute(
        cv2.cvtColor(overhead, cv2.COLOR_RGB2GRAY), mask
    )
    raster = np.array([k.pt for k in keypoints], dtype=np.float64).reshape(-1, 2)
    h = np.empty((0, 128)) if histograms is None else np.asarray(histograms, dtype=np.float64)
    h = np.sqrt(h / np.maximum(h.sum(axis=1, keepdims=True), 1e-9))
    ground = apply(grid.ground_from_overhead, raster)
    return Features(
        kind="sift",
        pixels=apply(pixel_from_ground(view.camera, mount), ground),
        ground=ground,
        descriptors=np.rint(255.0 * h).astype(np.uint8),
        pixels_per_metre=scale,
        # raster angles run clockwise from "right"; on the ground, left of "forward" is positive
        angle=np.array([-np.radians(k.angle) - np.pi / 2 for k in keypoints]),
        size=np.array([k.size / scale for k in keypoints]),
    )


def candidate_matches(
    features_i: Features, features_j: Features, max_ratio: float
) -> tuple[NDArray[np.int64], NDArray[np.int64], Float]:
    """Nearest neighbours that stand out from the second nearest.

    Parameters
    ----------
    features_i, features_j : Features
        From :func:`extract_sift`.
    max_ratio : float
        Largest distance to the nearest over distance to the second nearest.

    Returns
    -------
    index_i, index_j : (N,) int64
        Matched features, most distinct first.
    ratio : (N,) float64
    """
    if not len(features_i.pixels) or len(features_j.pixels) < 2:
        return np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0)
    a, b = (f.descriptors.astype(np.float32) for f in (features_i, features_j))
    # whole numbers below 2**24: sums are exact in float32 and do not depend on their order
    product = a @ b.T
    square = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1) - 2.0 * product
    index_j = square.argmin(axis=1)
    rows = np.arange(len(a))
    first = square[rows, index_j].copy()
    square[rows, index_j] = np.inf
    second = square.min(axis=1)
    ratio = np.sqrt(np.maximum(first, 0.0) / np.maximum(second, 1.0)).astype(np.float64)
    index_i = np.flatnonzero(ratio < max_ratio)
    index_i = index_i[np.argsort(ratio[index_i], kind="stable")]
    return index_i, index_j[index_i], ratio[index_i]
