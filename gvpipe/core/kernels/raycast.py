"""Rays through a grid of occupied voxels."""

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.kernels.jit import kernel
from gvpipe.core.types import Float

STRIDE = 0.7
"""Step along a ray, voxels: no voxel is crossed through its middle unseen."""


@kernel
def cast_depth(
    occupied: NDArray[np.bool_],
    origin: Float,
    spacing: Float,
    map_from_ray: Float,
    centre: Float,
    depth: NDArray[np.float32],
) -> None:
    """Fill where each ray of a view first meets an occupied voxel.

    Parameters
    ----------
    occupied : (nx, ny, nz) bool
        The voxels.
    origin, spacing : (3,) float64
        Of the voxel centres, metres.
    map_from_ray : (3, 3) float64
        Ray direction in the map from a homogeneous pixel.
    centre : (3,) float64
        Camera centre in the map, metres.
    depth : (h, w) float32
        Filled: multiples of the ray, which is the depth if the ray's own is 1; infinite where it
        meets nothing.
    """
    height, width = depth.shape
    lower = origin - spacing / 2
    upper = lower + spacing * np.array(occupied.shape)
    for v in range(height):
        for u in range(width):
            depth[v, u] = np.inf
            direction = map_from_ray[:, 0] * u + map_from_ray[:, 1] * v + map_from_ray[:, 2]
            start, end = 0.0, np.inf
            for k in range(3):
                if abs(direction[k]) < 1e-12:
                    if centre[k] < lower[k] or centre[k] > upper[k]:
                        end = -1.0
                    continue
                a = (lower[k] - centre[k]) / direction[k]
                b = (upper[k] - centre[k]) / direction[k]
                start, end = max(start, min(a, b)), min(end, max(a, b))
            step = STRIDE * spacing.min() / np.sqrt((direction**2).sum())
            t = start + 1e-6 * step
            while t < end:
                i = int((centre[0] + t * direction[0] - lower[0]) / spacing[0])
                j = int((centre[1] + t * direction[1] - lower[1]) / spacing[1])
                k = int((centre[2] + t * direction[2] - lower[2]) / spacing[2])
                inside = (
                    0 <= i < occupied.shape[0]
                    and 0 <= j < occupied.shape[1]
                    and 0 <= k < occupied.shape[2]
                )
                if inside and occupied[i, j, k]:
                    depth[v, u] = t
                    break
                t += step
