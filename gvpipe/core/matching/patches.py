"""Sub-pixel agreement of two pictures over the ground: evidence and refinement at once."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from gvpipe.core.geometry.ground import ground_points, pixel_from_ground
from gvpipe.core.geometry.homography import apply, local_jacobian
from gvpipe.core.geometry.twoview import PairFit, PairPrior, TwoView, fit_two_views
from gvpipe.core.kernels.patches import align_patches
from gvpipe.core.matching.guided import in_view
from gvpipe.core.types import Float, Image

LEVELS = 5
_MIN_CELL_PX, _MAX_CELL_PX = 8, 40
_WANTED = 250  # patches: more hardly lower the error, and time grows with them
_MIN_CORRELATION = 0.6
_FLOOR_PX = 0.1  # interpolation and model error that the patch's own covariance does not know
_CORRELATED = 2.25
"""Neighbouring patches overlap and share light and optics: the homography scatters 1.5 times as
much as independent ones would let it, measured over three hundred rendered pairs."""

_FEWEST = 8
_ITERATIONS = 10
_MAX_SHIFT = 4.0  # samples
MAX_RANGE = 7.0
"""Farthest ground used, camera heights, mean of both views: beyond, a pixel sees too much of it."""

COARSENESS = (4.0, 2.0, 1.0)

Pyramid = tuple[NDArray[np.uint8], ...]


def grey_pyramid(pixels: Image) -> Pyramid:
    """Grey picture and its halvings."""
    levels = [cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY).astype(np.uint8, copy=False)]
    while len(levels) < LEVELS:
        levels.append(cv2.pyrDown(levels[-1]).astype(np.uint8, copy=False))
    return tuple(levels)


def texture(pyramid: Pyramid) -> NDArray[np.float32]:
    """How much of a corner the surroundings are, (h, w), of every pixel of the halved picture.

    To choose the place of a patch, every second pixel is enough.
    """
    return cv2.cornerMinEigenVal(pyramid[1], 3).astype(np.float32, copy=False)


def textured_points(texture_i: NDArray[np.float32], geometry: TwoView, max_range: float) -> Float:
    """Pick the best corner, (N, 2) pixels of i, of every cell of ground that both cameras see."""
    camera = geometry.camera_i
    u, v = np.meshgrid(np.arange(8.0, camera.width, 16.0), np.arange(8.0, camera.height, 16.0))
    coarse = np.column_stack([u.ravel(), v.ravel()])
    shared = _shared(coarse, geometry, max_range).mean()
    area = shared * camera.width * camera.height
    cell = int(np.clip(np.sqrt(area / _WANTED), _MIN_CELL_PX, _MAX_CELL_PX) / 2 + 0.5)
    rows, columns = (side // cell for side in texture_i.shape)
    blocks = texture_i[: rows * cell, : columns * cell].reshape(rows, cell, columns, cell)
    best = blocks.swapaxes(1, 2).reshape(rows, columns, cell * cell).argmax(axis=2)
    v = np.arange(rows)[:, None] * cell + best // cell
    u = np.arange(columns)[None, :] * cell + best % cell
    points = 2.0 * np.column_stack([u.ravel(), v.ravel()])  # pixel n of a halving is 2 n
    return points[_shared(points, geometry, max_range)]


def _shared(pixels_i: Float, geometry: TwoView, max_range: float) -> NDArray[np.bool_]:
    """Which pixels of i see ground that j sees too and that is near both."""
    ground, below = ground_points(pixels_i, geometry.camera_i, geometry.mount_i)
    ground_j = apply(geometry.ground_j_from_ground_i, ground)
    projected = pixels_i @ geometry.projection[:, :2].T + geometry.projection[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        inside = in_view(projected[:, :2] / projected[:, 2:], geometry.camera_j)
    range_i = np.hypot(*ground.T) / geometry.mount_i.height
    range_j = np.hypot(*ground_j.T) / geometry.mount_j.height
    near = range_i + range_j < 2 * max_range
    return np.asarray(below & near & inside & (projected[:, 2] > 0))


@dataclass(frozen=True)
class Aligned:
    """Patches after their last alignment.

    Attributes
    ----------
    fit : PairFit
        Geometry from all patches.
    points_i, points_j : (N, 2) float64
        Patch centres and where their texture is in picture j.
    correlation : (N,) float64
        As of :func:`gvpipe.core.kernels.patches.align_patches`; below zero: not aligned.
    whiten : (N, 2, 2) float64
        Takes errors in picture j to unit standard deviation.
    agrees : (N,) bool
        Patches that look alike and follow the fitted plane.
    """

    fit: PairFit
    points_i: Float
    points_j: Float
    correlation: Float
    whiten: Float
    agrees: NDArray[np.bool_]


def _whitening(jacobian: Float, covariance: Float, floor_px: float) -> Float:
    """Inverse Cholesky factors of patch covariances carried to picture j."""
    in_pixels = jacobian @ covariance @ jacobian.swapaxes(1, 2) + floor_px**2 * np.eye(2)
    return np.linalg.inv(np.linalg.cholesky(in_pixels))


def correlations(
    geometry: TwoView, pyramid_i: Pyramid, pyramid_j: Pyramid, points_i: Float, spread: float
) -> Float:
    """How alike patches around given pixels look under a geometry.

    Parameters
    ----------
    geometry : TwoView
        Refined.
    pyramid_i, pyramid_j : tuple of (h, w) uint8
        From :func:`grey_pyramid`.
    points_i : (N, 2) float64
        Patch centres, pixels of i.
    spread : float
        Sample distance, in pixels of the coarser picture.

    Returns
    -------
    correlation : (N,) float64
        As of :func:`gvpipe.core.kernels.patches.align_patches`; below zero: not aligned.
    """
    _, _, (_, correlation, _) = _aligned_in_j(geometry, pyramid_i, pyramid_j, points_i, spread)
    return correlation


def _aligned_in_j(
    geometry: TwoView, pyramid_i: Pyramid, pyramid_j: Pyramid, points_i: Float, spread: float
) -> tuple[Float, Float, tuple[Float, Float, Float]]:
    """Pixels of j from ground of i, patch centres on that ground, and how they align in j."""
    from_i = pixel_from_ground(geometry.camera_i, geometry.mount_i)
    from_j = pixel_from_ground(geometry.camera_j, geometry.mount_j)
    from_j = from_j @ geometry.ground_j_from_ground_i
    ground, _ = ground_points(points_i, geometry.camera_i, geometry.mount_i)
    found = align_patches(
        pyramid_i, pyramid_j, from_i, from_j, ground, spread, _MAX_SHIFT, _ITERATIONS
    )
    return from_j, ground, found


def align(
    geometry: TwoView,
    expected: TwoView,
    prior: PairPrior,
    texture_i: NDArray[np.float32],
    pyramid_i: Pyramid,
    pyramid_j: Pyramid,
    max_range: float = MAX_RANGE,
    coarseness: tuple[float, ...] = COARSENESS,
) -> Aligned | None:
    """Align ground patches and refit the geometry to them, from coarse to fine.

    Parameters
    ----------
    geometry, expected : TwoView
        Where to start, and the configuration that `prior` speaks of.
    prior : PairPrior
        Error of the configuration.
    texture_i : (h, w) float32
        From :func:`texture`.
    pyramid_i, pyramid_j : tuple of (h, w) uint8
        From :func:`grey_pyramid`.
    max_range : float
        Ground farther than this many heights, mean of both views, is left out.
    coarseness : tuple of float
        Sample distances of the rounds, in pixels of the coarser picture.

    Returns
    -------
    aligned : Aligned or None
        None if fewer than eight patches could be aligned in the last round.
    """
    points_i = textured_points(texture_i, geometry, max_range)
    for spread in coarseness:
        result: Aligned | None = None
        points_i = points_i[_shared(points_i, geometry, max_range)]
        from_j, ground, (shift, correlation, covariance) = _aligned_in_j(
            geometry, pyramid_i, pyramid_j, points_i, spread
        )
        good = correlation > _MIN_CORRELATION
        if good.sum() < _FEWEST:
            continue
        points_j = apply(from_j, ground + shift)
        whiten = np.zeros((len(ground), 2, 2))
        whiten[good] = _whitening(
            local_jacobian(from_j, (ground + shift)[good]), covariance[good], _FLOOR_PX * spread
        )
        fit = fit_two_views(
            geometry, expected, prior, points_i[good], points_j[good], whiten[good], 12.0
        )
        fit = fit_two_views(
            fit.geometry, expected, prior, points_i[good], points_j[good], whiten[good], 4.0
        )
        fit = replace(fit, information=fit.information / _CORRELATED)
        geometry = fit.geometry
        errors = apply(geometry.homography, points_i) - points_j
        square = (np.einsum("nab,nb->na", whiten, errors) ** 2).sum(axis=1)
        agrees = good & (square < 16.0)
        result = Aligned(fit, points_i, points_j, correlation, whiten, agrees)
    return result
