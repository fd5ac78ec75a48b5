"""The voxel grid in which obstacles are reconstructed."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.types import Float

Volume = NDArray[np.float32]
"""(nx, ny, nz) float32 values at the voxel centres."""


@dataclass(frozen=True)
class VoxelGrid:
    """A regular grid of voxels whose axes are those of the map.

    Arrays over the grid are indexed ``[x, y, z]``; index (i, j, k) is the voxel's centre.

    Attributes
    ----------
    origin : (3,) float64
        Map coordinates of the centre of voxel (0, 0, 0), metres.
    spacing : (3,) float64
        Distance between neighbouring centres along x, y and z, metres, > 0.
    shape : (int, int, int)
        Number of voxels along x, y and z.

    Raises
    ------
    ValueError
        If the spacing or the shape is not positive.
    """

    origin: Float
    spacing: Float
    shape: tuple[int, int, int]

    def __post_init__(self) -> None:
        if not (np.asarray(self.spacing) > 0).all() or min(self.shape) < 1:
            raise ValueError("voxel spacing and grid shape must be positive")

    @classmethod
    def over(cls, lower: Float, upper: Float, shape: tuple[int, int, int]) -> "VoxelGrid":
        """Divide the box from `lower` to `upper`, (3,) metres each, into `shape` equal voxels."""
        low = np.asarray(lower, dtype=np.float64)
        spacing = (np.asarray(upper, dtype=np.float64) - low) / np.array(shape)
        return cls(origin=low + spacing / 2, spacing=spacing, shape=shape)

    @property
    def lower(self) -> Float:
        """Corner of the grid with the smallest coordinates, (3,) metres: half a voxel outside."""
        return self.origin - self.spacing / 2

    @property
    def upper(self) -> Float:
        """Corner of the grid with the largest coordinates, (3,) metres."""
        return self.lower + self.spacing * np.array(self.shape)

    def part(self, start: int, stop: int) -> "VoxelGrid":
        """Cut out the layers ``start <= i < stop`` along x."""
        shift = np.array([start * self.spacing[0], 0.0, 0.0])
        return replace(self, origin=self.origin + shift, shape=(stop - start, *self.shape[1:]))

    def axes(self) -> tuple[Float, Float, Float]:
        """Map coordinates of the centres along x, (nx,), along y, (ny,), and along z, (nz,)."""
        x, y, z = (self.origin[a] + self.spacing[a] * np.arange(self.shape[a]) for a in range(3))
        return x, y, z

    def centres(self) -> Float:
        """Map coordinates of all centres, (nx, ny, nz, 3) metres."""
        return np.stack(np.meshgrid(*self.axes(), indexing="ij"), axis=-1)

    def map_from_index(self, indices: Float) -> Float:
        """Take (..., 3) indices, fractions allowed, to map coordinates in metres."""
        return self.origin + np.asarray(indices, dtype=np.float64) * self.spacing

    def index_from_map(self, points: Float) -> Float:
        """Take (..., 3) map coordinates in metres to fractional indices."""
        return (np.asarray(points, dtype=np.float64) - self.origin) / self.spacing
