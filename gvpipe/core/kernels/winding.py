"""Which cells of a grid a closed surface holds."""

import math

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.kernels.jit import kernel
from gvpipe.core.types import Float


@kernel
def wind(corners: Float, counts: NDArray[np.int32]) -> None:
    """Add to each cell how often the surface goes round it.

    Parameters
    ----------
    corners : (F, 3, 3) float64
        Triangles in grid coordinates (cell centres at integers), counter-clockwise from outside.
    counts : (X, Y, Z) int32
        Changed in place: 1 is added below every triangle that faces up, taken off below every
        one that faces down.
    """
    nx, ny, nz = counts.shape
    for f in range(len(corners)):
        ax, ay, az = corners[f, 0, 0], corners[f, 0, 1], corners[f, 0, 2]
        bx, by, bz = corners[f, 1, 0], corners[f, 1, 1], corners[f, 1, 2]
        cx, cy, cz = corners[f, 2, 0], corners[f, 2, 1], corners[f, 2, 2]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area == 0.0:
            continue
        step = 1 if area > 0.0 else -1
        for x in range(max(math.ceil(min(ax, bx, cx)), 0), min(max(ax, bx, cx) + 1, nx)):
            for y in range(max(math.ceil(min(ay, by, cy)), 0), min(max(ay, by, cy) + 1, ny)):
                wb = ((x - ax) * (cy - ay) - (y - ay) * (cx - ax)) / area
                wc = ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) / area
                if wb < 0.0 or wc < 0.0 or wb + wc > 1.0:
                    continue
                z = az + wb * (bz - az) + wc * (cz - az)
                for k in range(min(max(math.ceil(z), 0), nz)):
                    counts[x, y, k] += step
