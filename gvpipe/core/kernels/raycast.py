"""Rays through a grid of occupied voxels."""

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.kernels.jit import kernel
from gvpipe.core.types import Float

STRIDE = 0.7
"""Step along a ray, voxels: no voxel is crossed through its middle unseen."""


@kernel
def _bounds(occupied: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First index of occupied voxels along each axis, and one past the last; equal if none is."""
    nx, ny, nz = occupied.shape
    first, last = np.array([nx, ny, nz]), np.zeros(3, np.int64)
    for i in range(nx):
        for j in range(ny):
            row = occupied[i, j]
            k = 0
            while k < nz and not row[k]:
                k += 1
            if k == nz:
                continue
            m = nz
            while not row[m - 1]:
                m -= 1
            first[0], last[0] = min(first[0], i), i + 1
            first[1], last[1] = min(first[1], j), max(last[1], j + 1)
            first[2], last[2] = min(first[2], k), max(last[2], m)
    return np.minimum(first, last), last


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
    first, last = _bounds(occupied)
    lower = origin - spacing / 2
    upper = lower + spacing * np.array(occupied.shape)
    low, high = lower + first * spacing, lower + last * spacing
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
            # whole steps up to the part that holds occupied voxels, and no farther
            for k in range(3):
                if abs(direction[k]) >= 1e-12:
                    a, b = (low[k] - centre[k]) / direction[k], (high[k] - centre[k]) / direction[k]
                    start, end = max(start, min(a, b)), min(end, max(a, b))
            t += max(np.floor((start - t) / step), 0.0) * step
            # in units of voxels from the lower corner
            x = (centre[0] - lower[0] + t * direction[0]) / spacing[0]
            y = (centre[1] - lower[1] + t * direction[1]) / spacing[1]
            z = (centre[2] - lower[2] + t * direction[2]) / spacing[2]
            dx = step * direction[0] / spacing[0]
            dy = step * direction[1] / spacing[1]
            dz = step * direction[2] / spacing[2]
            while t < end:
                i, j, k = int(x), int(y), int(z)
                inside = (
                    first[0] <= i < last[0] and first[1] <= j < last[1] and first[2] <= k < last[2]
                )
                if inside and occupied[i, j, k]:
                    depth[v, u] = t
                    break
                t, x, y, z = t + step, x + dx, y + dy, z + dz
