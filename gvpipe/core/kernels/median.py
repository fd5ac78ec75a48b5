"""Median of a few numbers, inside other kernels."""

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.kernels.jit import kernel


@kernel
def median(values: NDArray[np.float32], n: int) -> np.float32:
    """Median of the first `n` values, n > 0; sorts them."""
    for k in range(1, n):
        value, at = values[k], k
        while at > 0 and values[at - 1] > value:
            values[at] = values[at - 1]
            at -= 1
        values[at] = value
    return (values[n // 2] + values[(n - 1) // 2]) * np.float32(0.5)
