"""Loops over voxels that gather what the pictures say about them."""

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.kernels.jit import kernel
from gvpipe.core.types import Float

Single = NDArray[np.float32]
Bytes = NDArray[np.uint8]


@kernel
def add_view_evidence(
    probability: Single,
    matrix: Float,
    origin: Float,
    spacing: Float,
    floor: float,
    enough: float,
    log_sum: Single,
    count: NDArray[np.uint16],
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
    enough : float
        Voxels whose sum has fallen below this are left alone.
    log_sum : (nx, ny, nz) float32
        Changed in place: plus log(max(p, floor)).
    count : (nx, ny, nz) uint16
        Changed in place: plus one.
    """
    nx, ny, nz = log_sum.shape
    height, width = probability.shape
    least = np.log(floor)
    da, db, dc = matrix[0, 2] * spacing[2], matrix[1, 2] * spacing[2], matrix[2, 2] * spacing[2]
    for i in range(nx):
        x = origin[0] + i * spacing[0]
        for j in range(ny):
            y = origin[1] + j * spacing[1]
            a, b, c = project(matrix, x, y, origin[2])
            for k in range(nz):
                w = c + k * dc
                if w <= 1e-6 or log_sum[i, j, k] < enough:
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
                count[i, j, k] += 1
                if p <= floor:  # most pixels are sure: they need no logarithm
                    log_sum[i, j, k] += least
                elif p < 1.0:
                    log_sum[i, j, k] += np.log(p)


@kernel
def project(matrix: Float, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Homogeneous pixel of a map point: three numbers, the last one the depth in metres."""
    a = matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z + matrix[0, 3]
    b = matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z + matrix[1, 3]
    c = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z + matrix[2, 3]
    return a, b, c


@kernel
def sample_colours(
    picture: Bytes, matrix: Float, origin: Float, spacing: Float, samples: Bytes
) -> None:
    """Fetch one view's colour at every voxel.

    Parameters
    ----------
    picture : (H, W, 3) uint8
        RGB.
    matrix : (3, 4) float64
        Pixels from map, third row the depth.
    origin, spacing : (3,) float64
        Of the voxel centres, metres.
    samples : (nx, ny, 4, nz) uint8
        Filled: RGB of the nearest pixel and 1, or zeros where the view does not see the voxel.
    """
    nx, ny, _, nz = samples.shape
    height, width, _ = picture.shape
    da, db, dc = matrix[0, 2] * spacing[2], matrix[1, 2] * spacing[2], matrix[2, 2] * spacing[2]
    for i in range(nx):
        x = origin[0] + i * spacing[0]
        for j in range(ny):
            y = origin[1] + j * spacing[1]
            a, b, c = project(matrix, x, y, origin[2])
            for k in range(nz):
                w = c + k * dc
                u, v = (a + k * da) / w, (b + k * db) / w
                if w > 1e-6 and u >= 0.0 and v >= 0.0 and u < width - 1 and v < height - 1:
                    iu, iv = int(u + 0.5), int(v + 0.5)
                    samples[i, j, 0, k] = picture[iv, iu, 0]
                    samples[i, j, 1, k] = picture[iv, iu, 1]
                    samples[i, j, 2, k] = picture[iv, iu, 2]
                    samples[i, j, 3, k] = 1
                else:
                    for channel in range(4):
                        samples[i, j, channel, k] = 0


@kernel
def photo_consistency(samples: Bytes, scale: float, min_views: int, out: Single) -> None:
    """Mean robust agreement of the views' colours at every voxel (thesis eq. 5.6.4, mean form).

    Parameters
    ----------
    samples : (N, nx, ny, 4, nz) uint8
        The views' colours, from :func:`sample_colours`.
    scale : float
        Colour deviation, levels, at which a view's consent halves.
    min_views : int
        Voxels seen by fewer views get 0.
    out : (nx, ny, nz) float32
        Filled: mean over the views of 1 / (1 + |I - mean I| / scale), in 0..1.
    """
    nx, ny, nz = out.shape
    n, softness = len(samples), np.float32(scale)
    mean, seen = np.empty((3, nz), np.float32), np.empty(nz, np.float32)
    consent = np.empty(nz, np.float32)
    for i in range(nx):
        for j in range(ny):
            mean[:] = 0
            seen[:] = 0
            consent[:] = 0
            for q in range(n):
                for k in range(nz):
                    mean[0, k] += np.float32(samples[q, i, j, 0, k])
                    mean[1, k] += np.float32(samples[q, i, j, 1, k])
                    mean[2, k] += np.float32(samples[q, i, j, 2, k])
                    seen[k] += np.float32(samples[q, i, j, 3, k])
            for k in range(nz):
                share = np.float32(1) / max(seen[k], np.float32(1))
                mean[0, k] *= share
                mean[1, k] *= share
                mean[2, k] *= share
            for q in range(n):
                for k in range(nz):
                    r = np.float32(samples[q, i, j, 0, k]) - mean[0, k]
                    g = np.float32(samples[q, i, j, 1, k]) - mean[1, k]
                    b = np.float32(samples[q, i, j, 2, k]) - mean[2, k]
                    like = softness / (softness + np.sqrt(r * r + g * g + b * b))
                    consent[k] += like * np.float32(samples[q, i, j, 3, k])
            for k in range(nz):
                enough = seen[k] >= min_views
                out[i, j, k] = consent[k] / seen[k] if enough else np.float32(0)
