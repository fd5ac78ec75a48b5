"""What pictures of an evolution are made from: surfaces on the way, and its weights in a layer."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.reconstruct.grid import Volume, VoxelGrid
from gvpipe.core.reconstruct.narrowband import BAND

MOST_FRAMES = 32
"""Surfaces that are kept: when there are more, every other one is forgotten."""

FRAME_VOXELS = 100
"""Longest side of a kept surface's grid, about, voxels: fine enough for a small picture."""

Frames = NDArray[np.int8]
"""(n, mx, my, mz) int8: u in steps of the narrow band's half width / 127, positive inside."""


@dataclass
class Recorder:
    """Keeps surfaces of an evolution, evenly spread, in little memory.

    Parameters
    ----------
    grid : VoxelGrid
        Of the evolution.
    """

    grid: VoxelGrid
    frames: list[NDArray[np.int8]] = field(default_factory=list)
    iterations: list[int] = field(default_factory=list)
    _calls: int = 0
    _every: int = 1

    def __call__(self, iteration: int, u: Volume) -> None:
        """Look at the surface, positive inside, after an iteration."""
        if self._calls % self._every == 0:
            step = stride(self.grid)
            reach = BAND * float(self.grid.spacing.min())
            small = np.clip(u[::step, ::step, ::step] * (127.0 / reach), -127, 127)
            self.frames.append(np.rint(small).astype(np.int8))
            self.iterations.append(iteration)
        self._calls += 1
        if len(self.frames) > MOST_FRAMES:
            del self.frames[1::2], self.iterations[1::2]
            self._every *= 2

    def stacked(self) -> Frames:
        """All kept surfaces as one array."""
        return np.stack(self.frames)


def stride(grid: VoxelGrid) -> int:
    """Every how many voxels of a grid a kept surface has one."""
    return -(-max(grid.shape) // FRAME_VOXELS)


def restored(frame: NDArray[np.int8], grid: VoxelGrid) -> tuple[Volume, VoxelGrid]:
    """Give a kept surface back as a level-set function, metres, and its own coarser grid.

    Parameters
    ----------
    frame : (mx, my, mz) int8
        One of the frames.
    grid : VoxelGrid
        Of the evolution.

    Returns
    -------
    u : (mx, my, mz) float32
        Positive inside, metres.
    grid : VoxelGrid
        Its own.
    """
    step = stride(grid)
    coarse = VoxelGrid(grid.origin, grid.spacing * step, frame.shape)
    reach = BAND * float(grid.spacing.min())
    return (frame * np.float32(reach / 127.0)).astype(np.float32), coarse


def nearest_frame(iterations: list[int], wanted: float) -> int:
    """Which kept surface is nearest to an iteration."""
    return int(np.argmin(np.abs(np.array(iterations) - wanted)))


def middle_layer(u: Volume) -> int:
    """Layer half as high as the highest point inside u."""
    occupied = np.flatnonzero((u > 0).any(axis=(0, 1)))
    return int(occupied[-1]) // 2 if len(occupied) else u.shape[2] // 2
