"""Loops over voxels that gather what the pictures say about them."""

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.kernels.jit import kernel
from gvpipe.core.types import Float

Single = NDArray[np.float32]
Count = NDArray[np.uint8]


@kernel
def project_row(matrix: Float, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Homogeneous pixel of a map point: three numbers, the last one the depth in metres."""
    a = matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z + matrix[0, 3]
    b = matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z + matrix[1, 3]
    c = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z + matrix[2, 3]
    return a, b, c


@kernel
def add_view_evidence(
    probability: Single,
    matrix: Float,
    origin: Float,
    spacing: Float,
    floor: float,
    log_sum: Single,
    count: Count,
) -> None:
    """Add one view's log probabilities to every voxel it can judge.

    Parameters
    ----------
    probability : (H, W) float32
        Silhouette probability; NaN where the view knows nothing.
    matrix : (3, 4) float64
        Pixels from map, third row the depth.
    origin, spacing : (3,) float64
        Of the voxel centres, metres.
    floor : float
        Lowest probability one view may contribute.
    log_sum : (nx, ny, nz) float32
        Changed in place: plus log(max(p, floor)).
    count : (nx, ny, nz) uint8
        Changed in place: plus one.
    """
    nx, ny, nz = log_sum.shape
    height, width = probability.shape
    for i in range(nx):
        x = origin[0] + i * spacing[0]
        for j in range(ny):
            y = origin[1] + j * spacing[1]
            a, b, c = project_row(matrix, x, y, origin[2])
            da, db, dc = (
                matrix[0, 2] * spacing[2],
                matrix[1, 2] * spacing[2],
                matrix[2, 2] * spacing[2],
            )
            for k in range(nz):
                w = c + k * dc
                if w <= 1e-6:
                    continue
                u, v = (a + k * da) / w, (b + k * db) / w
                if not (u >= 0.0 and v >= 0.0 and u < width - 1 and v < height - 1):
                    continue
                iu, iv = int(u), int(v)
                fu, fv = u - iu, v - iv
                p = (1 - fv) * (
                    (1 - fu) * probability[iv, iu] + fu * probability[iv, iu + 1]
                ) + fv * ((1 - fu) * probability[iv + 1, iu] + fu * probability[iv + 1, iu + 1])
                if np.isnan(p):
                    continue
                log_sum[i, j, k] += np.log(max(p, floor))
                count[i, j, k] += 1


@kernel
def photo_consistency(
    images: NDArray[np.uint8],
    sizes: NDArray[np.int64],
    matrices: Float,
    origin: Float,
    spacing: Float,
    scale: float,
    min_views: int,
    out: Single,
) -> None:
    """Mean robust agreement of the views' colours at every voxel (thesis eq. 5.6.4, mean form).

    Parameters
    ----------
    images : (N, H, W, 3) uint8
        RGB pictures, padded to a common size.
    sizes : (N, 2) int64
        True width and height of each picture.
    matrices : (N, 3, 4) float64
        Pixels from map, third row the depth.
    origin, spacing : (3,) float64
        Of the voxel centres, metres.
    scale : float
        Colour deviation, levels, at which a view's consent halves.
    min_views : int
        Voxels seen by fewer views get 0.
    out : (nx, ny, nz) float32
        Filled: mean over the views of 1 / (1 + |I - mean I| / scale), in 0..1.
    """
    nx, ny, nz = out.shape
    n = len(images)
    colours = np.zeros((n, 3))
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                x = origin[0] + i * spacing[0]
                y = origin[1] + j * spacing[1]
                z = origin[2] + k * spacing[2]
                m = 0
                mean = np.zeros(3)
                for q in range(n):
                    a, b, c = project_row(matrices[q], x, y, z)
                    if c <= 1e-6:
                        continue
                    u, v = a / c, b / c
                    if not (u >= 0.0 and v >= 0.0 and u < sizes[q, 0] - 1 and v < sizes[q, 1] - 1):
                        continue
                    iu, iv = int(u + 0.5), int(v + 0.5)
                    for channel in range(3):
                        value = float(images[q, iv, iu, channel])
                        colours[m, channel] = value
                        mean[channel] += value
                    m += 1
                if m < min_views:
                    out[i, j, k] = 0.0
                    continue
                consent = 0.0
                for q in range(m):
                    square = 0.0
                    for channel in range(3):
                        square += (colours[q, channel] - mean[channel] / m) ** 2
                    consent += 1.0 / (1.0 + np.sqrt(square) / scale)
                out[i, j, k] = consent / m
