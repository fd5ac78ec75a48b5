"""Minimal cut of a picture into two parts by convex relaxation."""

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.kernels.jit import kernel

Single = NDArray[np.float32]

STEP = 0.35
"""Primal and dual step: their product times 8, the norm of the gradient, stays below 1."""


@kernel
def cut(gain: Single, weight_x: Single, weight_y: Single, iterations: int, start: Single) -> Single:
    """Maximise ``sum gain * x - sum weights * |differences of x|`` over x in [0, 1].

    Parameters
    ----------
    gain : (h, w) float32
        What choosing 1 at a pixel earns.
    weight_x, weight_y : (h, w) float32
        Cost of a unit step to the next pixel to the right, and below.
    iterations : int
        Primal-dual steps (Chambolle and Pock, 2011).
    start : (h, w) float32
        First guess in 0..1.

    Returns
    -------
    x : (h, w) float32
        In 0..1; thresholding it anywhere gives a minimal cut once converged.
    """
    height, width = gain.shape
    step, zero, one, two = np.float32(STEP), np.float32(0), np.float32(1), np.float32(2)
    x, ahead = start.copy(), start.copy()
    px, py = np.zeros_like(gain), np.zeros_like(gain)
    for _ in range(iterations):
        for i in range(height):
            for j in range(width - 1):
                p = px[i, j] + step * (ahead[i, j + 1] - ahead[i, j])
                px[i, j] = min(max(p, -weight_x[i, j]), weight_x[i, j])
        for i in range(height - 1):
            for j in range(width):
                p = py[i, j] + step * (ahead[i + 1, j] - ahead[i, j])
                py[i, j] = min(max(p, -weight_y[i, j]), weight_y[i, j])
        for i in range(height):
            for j in range(width):
                divergence = px[i, j] + py[i, j]
                if j > 0:
                    divergence -= px[i, j - 1]
                if i > 0:
                    divergence -= py[i - 1, j]
                new = min(max(x[i, j] + step * (divergence + gain[i, j]), zero), one)
                ahead[i, j] = two * new - x[i, j]
                x[i, j] = new
    return x
