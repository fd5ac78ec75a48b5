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
    nx, ny, nz = occupied.shape
    lower = origin - spacing / 2
    upper = lower + spacing * np.array(occupied.shape)
    direction = np.empty(3)
    for v in range(height):
        for u in range(width):
            depth[v, u] = np.inf
            start, end, length2 = 0.0, np.inf, 0.0
            for k in range(3):
                d = map_from_ray[k, 0] * u + map_from_ray[k, 1] * v + map_from_ray[k, 2]
                direction[k] = d
                length2 += d * d
                if abs(d) < 1e-12:
                    if centre[k] < lower[k] or centre[k] > upper[k]:
                        end = -1.0
                    continue
                a, b = (lower[k] - centre[k]) / d, (upper[k] - centre[k]) / d
                start, end = max(start, min(a, b)), min(end, max(a, b))
            step = STRIDE * spacing.min() / np.sqrt(length2)
            t = start + 1e-6 * step
            # in units of voxels from the lower corner
            x = (centre[0] - lower[0] + t * direction[0]) / spacing[0]
            y = (centre[1] - lower[1] + t * direction[1]) / spacing[1]
            z = (centre[2] - lower[2] + t * direction[2]) / spacing[2]
            dx = step * direction[0] / spacing[0]
            dy = step * direction[1] / spacing[1]
            dz = step * direction[2] / spacing[2]
            while t < end:
                i, j, k = int(x), int(y), int(z)
                inside = i < nx and j < ny and k < nz and x >= 0 and y >= 0 and z >= 0
                if inside and occupied[i, j, k]:
                    depth[v, u] = t
                    break
                t, x, y, z = t + step, x + dx, y + dy, z + dz
