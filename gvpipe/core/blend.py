"""How one colour is made of all the views of a piece of ground."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.kernels.mosaic import blend_best, blend_robust

Single = NDArray[np.float32]
Blend = Callable[[Single, Single, NDArray[np.int16], NDArray[np.uint8]], None]
"""Fills ``rgba`` (h, w, 4) of a tile from its packed samples (h, w, n, 3), their densities
(h, w, n) in image pixels per map pixel, and how many there are of each pixel (h, w)."""

BLENDS: dict[str, Blend] = {"robust": blend_robust, "best": blend_best}
"""By name in the configuration.

best
    The view that resolves the ground finest there: the highest density of image pixels,
    ``|det A| / |a3 . (X, Y, 1)|^3`` (thesis eq. 3.2.5 to 3.2.9, corrected).
robust
    The sample farthest from the mean colour is dropped until half remain, and those are averaged,
    which takes obstacles away where most views see the ground (thesis 3.2.1, steps 1 to 4).
"""
