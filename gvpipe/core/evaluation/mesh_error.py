"""How far a reconstructed surface is from the true one."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gvpipe.core.kernels.winding import wind
from gvpipe.core.types import Float

MOST_CELLS = 20_000_000
"""Cells of the grid on which volumes are compared: 80 MB."""


@dataclass(frozen=True)
class Surface:
    """A closed triangle mesh.

    Attributes
    ----------
    vertices : (N, 3) float64
        Metres.
    faces : (M, 3) int
        Counter-clockwise seen from outside.
    """

    vertices: Float
    faces: NDArray[np.integer]


@dataclass(frozen=True)
class SurfaceErrors:
    """Distances between two surfaces, metres, and shares.

    Attributes
    ----------
    precision, recall, fscore : float
        Share of the estimate near the truth, of the truth near the estimate, and their harmonic
        mean (Knapitsch et al. 2017).
    chamfer_m : float
        Mean of the two mean distances.
    accuracy_p90_m, completeness_p90_m : float
        Distance that nine tenths of the estimate, of the truth, keep.
    """

    precision: float
    recall: float
    fscore: float
    chamfer_m: float
    accuracy_p90_m: float
    completeness_p90_m: float


def sample_surface(surface: Surface, count: int, rng: np.random.Generator) -> Float:
    """Draw points evenly by area.

    Parameters
    ----------
    surface : Surface
        With at least one face of some area.
    count : int
        How many points.
    rng : Generator
        Which ones.

    Returns
    -------
    points : (count, 3) float64

    Raises
    ------
    ValueError
        If the surface has no area.
    """
    corners = surface.vertices[surface.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(across, axis=1)
    if not areas.sum() > 0:
        raise ValueError("the surface has no area")
    face = rng.choice(len(areas), size=count, p=areas / areas.sum())
    a, b = rng.random((2, count, 1))
    root = np.sqrt(a)
    first, second, third = corners[face].transpose(1, 0, 2)
    return np.asarray((1 - root) * first + root * (1 - b) * second + root * b * third)


def surface_errors(estimate: Float, truth: Float, tolerance_m: float) -> SurfaceErrors:
    """Compare points of two surfaces.

    Parameters
    ----------
    estimate, truth : (N, 3), (M, 3) float64
        From :func:`sample_surface`, metres, one frame.
    tolerance_m : float
        What counts as near.

    Returns
    -------
    errors : SurfaceErrors
    """
    accuracy = np.asarray(cKDTree(truth).query(estimate)[0])
    completeness = np.asarray(cKDTree(estimate).query(truth)[0])
    precision = float((accuracy < tolerance_m).mean())
    recall = float((completeness < tolerance_m).mean())
    both = precision + recall
    return SurfaceErrors(
        precision=precision,
        recall=recall,
        fscore=2 * precision * recall / both if both > 0 else 0.0,
        chamfer_m=float((accuracy.mean() + completeness.mean()) / 2),
        accuracy_p90_m=float(np.percentile(accuracy, 90)),
        completeness_p90_m=float(np.percentile(completeness, 90)),
    )


def volume_iou(estimate: Surface, truth: Surface, spacing_m: float) -> float:
    """Share of the volume of either that both hold, 0 to 1.

    Parameters
    ----------
    estimate, truth : Surface
        Closed; parts may overlap.
    spacing_m : float
        Side of the cells that are counted.

    Returns
    -------
    iou : float
        0 if neither holds a cell.

    Raises
    ------
    ValueError
        If that takes more than :data:`MOST_CELLS` cells.
    """
    both = np.concatenate([estimate.vertices, truth.vertices])
    low = both.min(axis=0) - spacing_m
    size = np.ceil((both.max(axis=0) + spacing_m - low) / spacing_m)
    if size.prod() > MOST_CELLS:
        raise ValueError(f"{size.prod():.0f} cells of {spacing_m:g} m; at most {MOST_CELLS}")
    shape = tuple(int(n) for n in size)
    # a start that no flat face of round numbers shares keeps cell centres off surfaces
    held = [_inside(s, low + 0.493827 * spacing_m, spacing_m, shape) for s in (estimate, truth)]
    union = int((held[0] | held[1]).sum())
    return float((held[0] & held[1]).sum() / union) if union else 0.0


def _inside(
    surface: Surface, origin: Float, spacing_m: float, shape: tuple[int, ...]
) -> NDArray[np.bool_]:
    """Cells whose centre the surface holds."""
    counts = np.zeros(shape, np.int32)
    corners = (surface.vertices[surface.faces] - origin) / spacing_m
    wind(np.ascontiguousarray(corners, dtype=np.float64), counts)
    return counts > 0
