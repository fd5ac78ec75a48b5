"""The obstacle energy minimised by others: plain numpy, and SimpleITK's geodesic active contour.

Level-set functions are positive inside and lengths are in voxels; f and g are the weights of the
energy and `start` is positive inside the first surface.
"""

import numpy as np
import SimpleITK as sitk
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

Array = NDArray[np.float32]
Exact = NDArray[np.float64]

EDGE_SIGMA, EDGE_SLOPE = 1.5, 0.05
"""Blur, voxels, and slope of f, a voxel, that make an edge for SimpleITK: f rises by one across
the surface."""


def _neighbour(padded: Exact, **by: int) -> Exact:
    """View of the neighbours at offsets along x, y, z of an array with one more voxel all round."""
    starts = [1 + by.get(axis, 0) for axis in "xyz"]
    return padded[tuple(slice(s, s + n - 2) for s, n in zip(starts, padded.shape, strict=True))]


class NumpyLevelSet:
    """Explicit scheme of thesis eq. 5.9.2, signs corrected, on whole arrays in float64.

    Godunov for f, upwind for grad g, central differences for the curvature, one time step for all
    voxels.
    """

    def __init__(self, start: Array, f: Array, g: Array) -> None:
        inside = start > 0
        self.u: Exact = np.where(
            inside, distance_transform_edt(inside) - 0.5, 0.5 - distance_transform_edt(~inside)
        )
        self._f, self._g = f.astype(np.float64), g.astype(np.float64)
        wide = np.pad(self._g, 1, mode="edge")
        self._slope_g = [
            (_neighbour(wide, **{a: 1}) - _neighbour(wide, **{a: -1})) / 2 for a in "xyz"
        ]
        steepest = float(np.sqrt(sum(s**2 for s in self._slope_g)).max())
        self._step = 0.9 / (3 * (float(np.abs(f).max()) + steepest) + 6 * float(g.max()))

    def iterate(self) -> None:
        """Take one time step."""
        u, f = self.u, self._f
        wide = np.pad(u, 1, mode="edge")
        outward, inward, flow = np.zeros_like(u), np.zeros_like(u), np.zeros_like(u)
        first, second = [], []
        for axis, slope in zip("xyz", self._slope_g, strict=True):
            before, after = _neighbour(wide, **{axis: -1}), _neighbour(wide, **{axis: 1})
            back, ahead = u - before, after - u
            inward += np.maximum(back, 0) ** 2 + np.minimum(ahead, 0) ** 2
            outward += np.minimum(back, 0) ** 2 + np.maximum(ahead, 0) ** 2
            flow += np.maximum(slope, 0) * ahead + np.minimum(slope, 0) * back
            first.append((after - before) / 2)
            second.append(ahead - back)
        square = first[0] ** 2 + first[1] ** 2 + first[2] ** 2 + 1e-12
        bend = np.zeros_like(u)
        for a in range(3):
            bend += second[a] * (square - first[a] ** 2)
            for b in range(a):
                p, q = "xyz"[a], "xyz"[b]
                alike = _neighbour(wide, **{p: 1, q: 1}) + _neighbour(wide, **{p: -1, q: -1})
                unlike = _neighbour(wide, **{p: 1, q: -1}) + _neighbour(wide, **{p: -1, q: 1})
                bend -= first[a] * first[b] * (alike - unlike) / 2
        kappa = np.clip(bend / square**1.5, -1, 1)
        force = np.maximum(f, 0) * np.sqrt(inward) + np.minimum(f, 0) * np.sqrt(outward)
        self.u = u + self._step * (flow - force + self._g * kappa * np.sqrt(square))


def simpleitk(start: Array, f: Array, iterations: int) -> tuple[Array, int]:
    """Shrink the start onto the edges of f; how many iterations it took.

    The filter knows no volume term: the surface is where its feature image is small, made from the
    gradient of f in the way its documentation recommends. It stops by its own default criterion.
    """
    slope = sitk.GradientMagnitudeRecursiveGaussian(sitk.GetImageFromArray(f), EDGE_SIGMA)
    edges = sitk.Cast(sitk.Exp(-1 * sitk.Square(slope / EDGE_SLOPE)), sitk.sitkFloat32)
    inside = sitk.GetImageFromArray((start > 0).astype(np.uint8))
    distance = sitk.SignedMaurerDistanceMap(inside, insideIsPositive=False, squaredDistance=False)
    contour = sitk.GeodesicActiveContourLevelSetImageFilter()
    contour.SetPropagationScaling(-1.0)  # inwards
    contour.SetCurvatureScaling(0.2)
    contour.SetAdvectionScaling(1.0)
    contour.SetNumberOfIterations(iterations)
    result = contour.Execute(sitk.Cast(distance, sitk.sitkFloat32), edges)
    return -sitk.GetArrayFromImage(result), int(contour.GetElapsedIterations())
