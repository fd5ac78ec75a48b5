"""How one colour is made of all the views of a piece of ground."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.kernels.mosaic import blend_best, blend_half, blend_robust

Single = NDArray[np.float32]
Counts = NDArray[np.int16]


@dataclass(frozen=True)
class Samples:
    """The packed samples of a tile: those of pixel (v, u) are ``[v, u, : count[v, u]]``.

    Attributes
    ----------
    colours : (h, w, n, 3) float32
        RGB, exposure and vignetting taken out.
    density : (h, w, n) float32
        Image pixels per map pixel.
    clean : (h, w, n) float32
        How surely the sample shows ground, 0 to 1.
    count : (h, w) int16
        Samples of each pixel.
    """

    colours: Single
    density: Single
    clean: Single
    count: Counts

    @classmethod
    def empty(cls, height: int, width: int, views: int) -> "Samples":
        """Room for the samples of some views."""
        shape = (height, width, views)
        return cls(
            colours=np.empty((*shape, 3), np.float32),
            density=np.empty(shape, np.float32),
            clean=np.empty(shape, np.float32),
            count=np.zeros((height, width), np.int16),
        )


@dataclass(frozen=True)
class Blend:
    """A way to compose.

    Attributes
    ----------
    kernel : callable
        Fills ``rgba`` (h, w, 4) and ``error`` (h, w) uint8 from the colours, densities and clean
        weights of :class:`Samples`, which it may reorder, the light (h, w) and the counts.
    surveys : bool
        Whether samples are weighed and balanced by the survey of obstacles and exposures.
    """

    kernel: Callable[
        [Single, Single, Single, Single, Counts, NDArray[np.uint8], NDArray[np.uint8]], None
    ]
    surveys: bool


BLENDS: dict[str, Blend] = {
    "robust": Blend(blend_robust, surveys=True),
    "half": Blend(blend_half, surveys=False),
    "best": Blend(blend_best, surveys=False),
}
"""By name in the configuration.

robust
    Views that show an obstacle there are left out by the survey; the median of the others,
    balanced in exposure and vignetting, is lit as the survey found the ground lit around there.
    The default.
half
    The sample farthest from the mean colour is dropped until half remain, and those are averaged
    (thesis 3.2.1, steps 1 to 4).
best
    The view that resolves the ground finest there: the highest density of image pixels,
    ``|det A| / |a3 . (X, Y, 1)|^3`` (thesis eq. 3.2.5 to 3.2.9, corrected).
"""
