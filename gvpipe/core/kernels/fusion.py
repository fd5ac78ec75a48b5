"""Depth maps of many views into one volume."""

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.kernels.evidence import project
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
    wanted: NDArray[np.bool_],
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
    wanted : (nx, ny, nz) bool
        Voxels to be voted on; the others stay as they are.
    votes, weight : (nx, ny, nz) float32
        Changed in place: plus confidence times the distance to the surface in units of the band,
        positive before it, in -1..1; plus confidence (Curless and Levoy, SIGGRAPH 1996).
    """
    nx, ny, nz = votes.shape
    height, width = depth.shape
    da, db, dc = matrix[0, 2] * spacing[2], matrix[1, 2] * spacing[2], matrix[2, 2] * spacing[2]
    for i in range(nx):
        x = origin[0] + i * spacing[0]
        for j in range(ny):
            y = origin[1] + j * spacing[1]
            a, b, c = project(matrix, x, y, origin[2])
            for k in range(nz):
                w = c + k * dc
                if not wanted[i, j, k] or w <= 1e-6:
                    continue
                u, v = (a + k * da) / w, (b + k * db) / w
                if not (u >= -0.5 and v >= -0.5 and u < width - 0.5 and v < height - 0.5):
                    continue
                iu, iv = int(u + 0.5), int(v + 0.5)
                trust = confidence[iv, iu]
                if trust <= 0.0:
                    continue
                vote = (depth[iv, iu] - w) / band
                if vote < -1.0:
                    continue
                votes[i, j, k] += trust * min(vote, 1.0)
                weight[i, j, k] += trust
