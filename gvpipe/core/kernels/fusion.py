"""Depth maps of many views into one volume."""

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.kernels.jit import kernel
from gvpipe.core.types import Float

Single = NDArray[np.float32]


@kernel
def fuse_depth(
    depth: Single,
    confidence: Single,
    matrix: Float,
    origin: Float,
    spacing: Float,
    band: float,
    votes: Single,
    weight: Single,
) -> None:
    """Add one depth map's truncated signed distances to the voxels before and at its surface.

    Parameters
    ----------
    depth, confidence : (H, W) float32
        Metres, and 0..1: nothing is known where it is 0.
    matrix : (3, 4) float64
        Pixels from map, third row the depth.
    origin, spacing : (3,) float64
        Of the voxel centres, metres.
    band : float
        Distance, metres, to which the surface speaks for what is behind it, and at which a vote
        for free space is a full one.
    votes, weight : (nx, ny, nz) float32
        Changed in place: plus confidence times the distance to the surface in units of the band,
        positive before it, in -1..1; plus confidence (Curless and Levoy, SIGGRAPH 1996).
    """
    nx, ny, nz = votes.shape
    height, width = depth.shape
    for i in range(nx):
        x = origin[0] + i * spacing[0]
        for j in range(ny):
            y = origin[1] + j * spacing[1]
            for k in range(nz):
                z = origin[2] + k * spacing[2]
                c = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z + matrix[2, 3]
                if c <= 1e-6:
                    continue
                u = (matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z + matrix[0, 3]) / c
                v = (matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z + matrix[1, 3]) / c
                if not (u >= -0.5 and v >= -0.5 and u < width - 0.5 and v < height - 0.5):
                    continue
                iu, iv = int(u + 0.5), int(v + 0.5)
                trust = confidence[iv, iu]
                if trust <= 0.0:
                    continue
                vote = (depth[iv, iu] - c) / band
                if vote < -1.0:
                    continue
                votes[i, j, k] += trust * min(vote, 1.0)
                weight[i, j, k] += trust
