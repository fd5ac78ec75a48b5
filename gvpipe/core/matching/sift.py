"""Scale-invariant keypoints on the ground itself: perspective undone, resolution where it is.

The difference of Gaussians of Lowe (IJCV 2004) on a stack of overhead views. Each octave is drawn
from the picture on its own and reaches as far as the picture still resolves it: fine octaves end
near the robot, coarse ones go on, so that no time is spent on ground that is only a blur.
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from gvpipe.core.geometry.ground import (
    OverheadGrid,
    ground_points,
    overhead_grid,
    pixel_from_ground,
)
from gvpipe.core.geometry.homography import apply
from gvpipe.core.kernels.keypoints import describe, find_blobs, orientations
from gvpipe.core.kernels.matching import SIZE, nearest_two
from gvpipe.core.matching.features import Features, MatchOptions
from gvpipe.core.types import Camera, Float, Mount, View

_LAYERS = 3  # scales an octave
_SIGMA = 1.6  # smoothing of an octave's first layer, pixels
_DRAWN_SIGMA = 0.6  # smoothing that a drawn view has already
_STRETCH = 3.0  # an octave reaches to where a picture pixel covers this many of its own
_FINEST_ROW = 0.75  # of the picture's half height below the centre: resolved fully by octave 0
_OCTAVES = 5
_MAX_AREA = 250_000  # pixels of an octave: bounds time and memory for large pictures
_MIN_SIDE = 24  # pixels: nothing to find on less
_CONTRAST = 1.2  # grey levels; low, the number of keypoints is capped instead
_INSIDE_PX = 4.0  # nearer to the picture's side, gradients are artefacts
_ROOM = 20_000  # blobs a layer
_MAX_LOG_GROWTH = np.log(1.9)  # of a blob from view to view: wrong tilts and heights stretch it
_NEVER_ALIKE = 1e3  # logarithm of a size: dark blobs and bright ones are far apart
_CELLS = (12, 9)  # of the picture, to which keypoints are dealt evenly
_ASSUMED_TILTS = (np.radians(28.0), np.radians(52.0))  # of an unknown one: SIFT bears 15 degrees

Grey = NDArray[np.uint8]


@dataclass(frozen=True)
class _Blobs:
    """Keypoints of one smoothed layer: rows of u, v, sigma, contrast (above 0: dark)."""

    grid: OverheadGrid
    image: NDArray[np.float32]
    blobs: Float
    pixels: Float


def _range_of(camera: Camera, mount: Mount, density: float) -> float:
    """Distance at which a picture's rows resolve the ground to `density` pixels per metre."""
    # along a row's bearing a pixel covers (r^2 + h^2) / (f h)
    square = camera.fy * mount.height / density - mount.height**2
    return float(np.sqrt(max(square, (0.2 * mount.height) ** 2)))


def _octaves(camera: Camera, mount: Mount, max_range: float) -> list[OverheadGrid]:
    """Overhead views of falling scale and growing reach."""
    depression = mount.tilt + _FINEST_ROW * np.arctan2(0.5 * camera.height, camera.fy)
    depression = float(np.clip(depression, np.radians(10.0), np.radians(90.0)))
    # pixels per metre across and along the line of sight at that row, and their mean
    across = camera.fx * np.sin(depression) / mount.height
    scale = across * np.sqrt(np.sin(depression))
    grids = []
    for _ in range(_OCTAVES):
        reach = min(_range_of(camera, mount, scale / _STRETCH), max_range * mount.height)
        grid = overhead_grid(camera, mount, scale, reach)
        while grid.width * grid.height > _MAX_AREA:
            grid = overhead_grid(camera, mount, scale, reach := 0.9 * reach)
        if min(grid.width, grid.height) > _MIN_SIDE:
            grids.append(grid)
        scale *= 0.5
    return grids


def _draw(pyramid: list[Grey], camera: Camera, mount: Mount, grid: OverheadGrid) -> Grey:
    """Overhead view, each band of it from the pyramid level that has its resolution."""
    view = np.empty((grid.height, grid.width), np.uint8)
    from_overhead = pixel_from_ground(camera, mount) @ grid.ground_from_overhead
    forward = grid.x_max - np.arange(grid.height) / grid.pixels_per_metre
    distance = np.hypot(forward, mount.height)
    density = np.sqrt(camera.fx * camera.fy * mount.height / distance**3)
    level = np.rint(np.log2(density / grid.pixels_per_metre)).astype(int)
    level = np.clip(level, 0, len(pyramid) - 1)
    for k in np.unique(level):
        rows = np.flatnonzero(level == k)
        start, stop = int(rows[0]), int(rows[-1]) + 1
        down = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, float(start)], [0.0, 0.0, 1.0]])
        shrink = np.diag([0.5**k, 0.5**k, 1.0])
        view[start:stop] = cv2.warpPerspective(
            pyramid[k],
            shrink @ from_overhead @ down,
            (grid.width, stop - start),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )
    return view


def _detect(view: Grey, grid: OverheadGrid, camera: Camera, mount: Mount) -> list[_Blobs]:
    """Blobs of one octave that the camera really sees, by layer."""
    ratio = 2.0 ** (1.0 / _LAYERS)
    sigmas = _SIGMA * ratio ** np.arange(_LAYERS + 3)
    steps = np.sqrt(np.diff(sigmas**2, prepend=_DRAWN_SIGMA**2))
    smooth: list[NDArray[np.float32]] = [view.astype(np.float32)]
    for step in steps:
        smooth.append(
            cv2.GaussianBlur(smooth[-1], (0, 0), float(step)).astype(np.float32, copy=False)
        )
    smooth = smooth[1:]
    difference: list[NDArray[np.float32]] = [b - a for a, b in pairwise(smooth)]
    pixel_from_overhead = pixel_from_ground(camera, mount) @ grid.ground_from_overhead
    layers = []
    for k in range(1, _LAYERS + 1):
        below, here, above = difference[k - 1 : k + 2]
        blobs = find_blobs(below, here, above, _CONTRAST, 2, _ROOM)
        pixels = apply(pixel_from_overhead, blobs[:, :2])
        inside = (
            (pixels[:, 0] > _INSIDE_PX)
            & (pixels[:, 0] < camera.width - 1 - _INSIDE_PX)
            & (pixels[:, 1] > _INSIDE_PX)
            & (pixels[:, 1] < camera.height - 1 - _INSIDE_PX)
        )
        blobs = blobs[inside]
        blobs[:, 2] = sigmas[k] * ratio ** blobs[:, 2]
        layers.append(_Blobs(grid, smooth[k], blobs, pixels[inside]))
    return layers


def _evenly(pixels: Float, contrast: Float, camera: Camera, most: int) -> NDArray[np.bool_]:
    """Keep the strongest of every cell of the picture in turn until there are `most`."""
    column = (pixels[:, 0] * _CELLS[0] / camera.width).astype(int)
    cell = (pixels[:, 1] * _CELLS[1] / camera.height).astype(int) * _CELLS[0] + column
    order = np.lexsort((-contrast, cell))
    sizes = np.bincount(cell, minlength=_CELLS[0] * _CELLS[1])
    rank = np.empty(len(cell), int)
    rank[order] = np.arange(len(cell)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    keep = np.zeros(len(cell), bool)
    keep[np.lexsort((-contrast, rank))[:most]] = True
    return keep


def extract_sift(view: View, options: MatchOptions) -> Features:
    """Keypoints and descriptors of the ground seen from above.

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
        With (N, 128) uint8 descriptors, angles on the ground and sizes in metres.
    """
    pyramid = [cv2.cvtColor(view.pixels, cv2.COLOR_RGB2GRAY).astype(np.uint8)]
    while len(pyramid) < _OCTAVES + 1:
        pyramid.append(cv2.pyrDown(pyramid[-1]).astype(np.uint8))
    mounts = [view.mount]
    if not view.mount.tilt_known:
        mounts = [replace(view.mount, tilt=tilt) for tilt in _ASSUMED_TILTS]
    each = options.keypoints // len(mounts)
    parts = [
        part
        for mount in mounts
        for part in _extract(pyramid, view.camera, mount, each, options.max_range)
    ]
    pixels = np.concatenate([np.empty((0, 2)), *(part.pixels for part in parts)])
    return Features(
        kind="sift",
        pixels=pixels,
        ground=ground_points(pixels, view.camera, view.mount)[0],
        descriptors=np.concatenate(
            [np.empty((0, SIZE), np.uint8), *(part.descriptors for part in parts)]
        ),
        pixels_per_metre=0.0,
        angle=np.concatenate([np.empty(0), *(part.angle for part in parts)]),
        size=np.concatenate([np.empty(0), *(part.size for part in parts)]),
        dark=np.concatenate([np.empty(0, bool), *(part.dark for part in parts)]),
    )


@dataclass(frozen=True)
class _Described:
    """Keypoints of one layer: picture pixels, descriptors, ground angles, metric sizes, sign."""

    pixels: Float
    descriptors: NDArray[np.uint8]
    angle: Float
    size: Float
    dark: NDArray[np.bool_]


def _extract(
    pyramid: list[Grey], camera: Camera, mount: Mount, most: int, max_range: float
) -> list[_Described]:
    """Keypoints under one mount, by layer."""
    layers = [
        layer
        for grid in _octaves(camera, mount, max_range)
        for layer in _detect(_draw(pyramid, camera, mount, grid), grid, camera, mount)
    ]
    if not layers:
        return []
    keep = _evenly(
        np.concatenate([layer.pixels for layer in layers]),
        np.abs(np.concatenate([layer.blobs[:, 3] for layer in layers])),
        camera,
        most,
    )
    found = []
    for layer, kept in zip(
        layers, np.split(keep, np.cumsum([len(a.blobs) for a in layers])[:-1]), strict=True
    ):
        u, v, sigma = np.ascontiguousarray(layer.blobs[kept, :3].T)
        first, second = orientations(layer.image, u, v, sigma)
        twice = np.concatenate([np.arange(len(u)), np.flatnonzero(np.isfinite(second))])
        angle = np.concatenate([first, second[np.isfinite(second)]])
        u, v, sigma = u[twice], v[twice], sigma[twice]
        found.append(
            _Described(
                layer.pixels[kept][twice],
                describe(layer.image, u, v, sigma, angle),
                # raster angles run clockwise from "right"; ground angles from forward to left
                -angle - np.pi / 2,
                2.0 * sigma / layer.grid.pixels_per_metre,
                layer.blobs[kept, 3][twice] > 0,
            )
        )
    return found


def candidate_matches(
    features_i: Features, features_j: Features, max_ratio: float
) -> tuple[NDArray[np.int64], NDArray[np.int64], Float]:
    """Nearest neighbours, of like size and sign, that stand out from the second nearest.

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
    sizes = [np.log(f.size) + _NEVER_ALIKE * f.dark for f in (features_i, features_j)]
    order_i, order_j = (np.argsort(size, kind="stable") for size in sizes)
    size_i, size_j = sizes[0][order_i], sizes[1][order_j]
    nearest, ratio = nearest_two(
        features_i.descriptors[order_i].astype(np.uint8, copy=False),
        features_j.descriptors[order_j].astype(np.uint8, copy=False),
        np.searchsorted(size_j, size_i - _MAX_LOG_GROWTH),
        np.searchsorted(size_j, size_i + _MAX_LOG_GROWTH),
    )
    distinct = np.flatnonzero(ratio < max_ratio)
    distinct = distinct[np.argsort(ratio[distinct], kind="stable")]
    return order_i[distinct], order_j[nearest[distinct]], ratio[distinct]
