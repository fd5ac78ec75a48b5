"""What a method of reconstruction makes of one region."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.reconstruct.grid import Volume
from gvpipe.core.reconstruct.history import Frames

Layer = NDArray[np.float32]
"""(nx, ny) float32."""


@dataclass(frozen=True)
class Solution:
    """A volume, and how it came about if it evolved.

    Attributes
    ----------
    u : (nx, ny, nz) float32
        Positive inside obstacles, metres.
    energy : list of (int, float)
        Iteration and energy; empty for methods that have none.
    iterations : int
        Time steps taken; 0 for methods that take none.
    converged : bool
        Whether the surface came to rest.
    frames : (n, mx, my, mz) int8
        Surfaces on the way, see :mod:`gvpipe.core.reconstruct.history`; n = 0 if it did not evolve.
    frame_iterations : list of int
        After which iteration each was seen.
    layer : int
        The z index of the layer that `f` and `g` show.
    f, g : (nx, ny) float32
        Volume and area weight in that layer; empty if the method has none.
    """

    u: Volume
    energy: list[tuple[int, float]]
    iterations: int
    converged: bool
    frames: Frames
    frame_iterations: list[int]
    layer: int
    f: Layer
    g: Layer

    @classmethod
    def carved(cls, u: Volume) -> "Solution":
        """Wrap a volume that did not evolve."""
        nothing = np.zeros((0, 0), np.float32)
        frames = np.zeros((0, 1, 1, 1), np.int8)
        return cls(u, [], 0, True, frames, [], 0, nothing, nothing)
