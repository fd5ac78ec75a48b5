"""Exposure, white balance and vignetting of posed views, levelled on the ground they share."""

from collections.abc import Sequence

import cv2
import numpy as np

from gvpipe.core.geometry.ground import pixel_from_plane
from gvpipe.core.types import Float, Image, PosedView

SAMPLES = 6000
"""Ground points compared: plenty for six numbers a view and channel."""

REACH = 5.0
"""Ground farther than this many camera heights is not compared: pixels there mix metres."""

OFFSET = 8.0
"""Levels added before the logarithm, so that noise in the dark does not dominate."""

SATURATED = 250
"""Levels from which a pixel's true brightness is unknown."""

ITERATIONS = 12
"""Alternations between the ground's colours and the views' corrections; 4 halve the scale."""

RIDGE = (0.004, 0.01, 0.01, 0.02, 0.02, 0.02)
"""Pull of each coefficient towards none, per unit of weight: fixes the common factor that no
view can see, and holds curvature down in views that share little ground."""

FIELD_STEP = 16
"""Pixels between nodes at which the smooth correction is evaluated."""


def levelled(views: Sequence[PosedView]) -> list[Image]:
    """Bring the pictures to one common exposure, colour balance and vignetting.

    Each view's logarithm is corrected by a quadratic in the pixel coordinates, a channel at a
    time, so that ground points look alike in all views. Points where views differ for other
    reasons (obstacles, gloss) are given little weight.

    Parameters
    ----------
    views : sequence of PosedView
        Pictures with poses.

    Returns
    -------
    pictures : list of (H, W, 3) uint8
        Corrected pixels.
    """
    values, bases = _shared_ground(views)
    if values.shape[1] < 20 * len(RIDGE):
        return [view.pixels for view in views]
    coefficients = _level(values, bases)
    return [_corrected(view.pixels, c) for view, c in zip(views, coefficients, strict=True)]


def _basis(u: Float, v: Float, width: int, height: int) -> Float:
    """Quadratic monomials of centred pixel coordinates, (..., 6)."""
    x, y = (u - width / 2) / (width / 2), (v - height / 2) / (width / 2)
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)


def _shared_ground(views: Sequence[PosedView]) -> tuple[Float, Float]:
    """Sample log colours (V, P, 3), NaN where unseen, of common ground; and bases (V, P, 6)."""
    centres = np.array([v.map_from_camera.translation for v in views])
    height = float(np.median(centres[:, 2]))
    lower = centres[:, :2].min(axis=0) - 3 * height
    upper = centres[:, :2].max(axis=0) + 3 * height
    step = np.sqrt(np.prod(upper - lower) / (2 * SAMPLES))
    x, y = np.meshgrid(*(np.arange(a, b, step) for a, b in zip(lower, upper, strict=True)))
    points = np.stack([x.ravel(), y.ravel(), np.ones(x.size)])
    values = np.full((len(views), points.shape[1], 3), np.nan)
    bases = np.zeros((len(views), points.shape[1], len(RIDGE)))
    for k, view in enumerate(views):
        h, w = view.pixels.shape[:2]
        p = pixel_from_plane(view.camera, view.map_from_camera) @ points
        depth = np.where(p[2] > 1e-6, p[2], np.nan)
        u, v = p[0] / depth, p[1] / depth
        near = np.hypot(*(points[:2] - centres[k, :2, None])) < REACH * centres[k, 2]
        seen = near & (u > 2) & (v > 2) & (u < w - 3) & (v < h - 3)
        smooth = cv2.GaussianBlur(view.pixels, (0, 0), w / 200)
        columns, rows = np.rint(u[seen]).astype(int), np.rint(v[seen]).astype(int)
        values[k, seen] = np.log(smooth[rows, columns] + OFFSET)
        bases[k, seen] = _basis(u[seen], v[seen], w, h)
    shared = np.isfinite(values[..., 0]).sum(axis=0) >= min(3, len(views))
    return values[:, shared], bases[:, shared]


def _level(values: Float, bases: Float) -> Float:
    """Corrections (V, 3, 6) by alternating robust least squares."""
    seen = np.isfinite(values[..., 0])
    filled = np.nan_to_num(values)
    usable = seen & (filled.max(axis=-1) < np.log(SATURATED + OFFSET))
    coefficients = np.zeros((len(values), 3, len(RIDGE)))
    scale = 0.3  # log units: a generous start that lets a stop of exposure through
    for _ in range(ITERATIONS):
        corrected = filled - np.einsum("vpb,vcb->vpc", bases, coefficients)
        ground = np.nanmedian(np.where(seen[..., None], corrected, np.nan), axis=0)
        for _ in range(3):
            off2 = ((corrected - ground) ** 2).sum(axis=-1) / scale**2
            weight = np.where(seen, 1.0 / (1.0 + off2) ** 2, 0.0)
            ground = np.einsum("vp,vpc->pc", weight, corrected) / np.maximum(
                weight.sum(axis=0), 1e-9
            ).reshape(-1, 1)
        off = np.sqrt(((corrected - ground) ** 2).sum(axis=-1))
        scale = max(0.04, 1.5 * float(np.median(off[seen])))
        weight = np.where(usable, 1.0 / (1.0 + (off / scale) ** 2) ** 2, 0.0)
        for k in range(len(values)):
            weighted = bases[k] * weight[k][:, None]
            ridge = np.diag(np.array(RIDGE) * weight[k].sum() + 1e-9)
            normal = weighted.T @ bases[k] + ridge
            coefficients[k] = np.linalg.solve(normal, weighted.T @ (filled[k] - ground)).T
    return coefficients


def _corrected(pixels: Image, coefficients: Float) -> Image:
    """Divide a picture by its smooth field of gains."""
    height, width = pixels.shape[:2]
    u = np.arange(0, width + FIELD_STEP, FIELD_STEP, dtype=np.float64)
    v = np.arange(0, height + FIELD_STEP, FIELD_STEP, dtype=np.float64)
    nodes = _basis(*np.meshgrid(u, v), width, height) @ coefficients.T
    columns, rows = np.meshgrid(
        np.arange(width, dtype=np.float32) / FIELD_STEP,
        np.arange(height, dtype=np.float32) / FIELD_STEP,
    )
    gain = cv2.remap(np.exp(-nodes).astype(np.float32), columns, rows, cv2.INTER_LINEAR)
    picture = (pixels + np.float32(OFFSET)) * gain - np.float32(OFFSET)
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)
