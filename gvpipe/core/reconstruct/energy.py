"""The energy whose minimum is the obstacles' surface."""

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.kernels.resample import energy_slab
from gvpipe.core.reconstruct.grid import Volume
from gvpipe.core.reconstruct.slabs import Slabs


@dataclass(frozen=True)
class Energy:
    """The two integrals of the energy.

    Attributes
    ----------
    volume : float
        Integral of f over the inside, in the unit of f times a cubic length.
    area : float
        Integral of g over the surface, in the unit of g times a squared length.
    """

    volume: float
    area: float

    @property
    def total(self) -> float:
        """What is minimised."""
        return self.volume + self.area


def padded(a: Volume) -> Volume:
    """Repeat the first and last voxel along z, as the kernels want it: (nx, ny, nz + 2)."""
    return np.pad(np.asarray(a, dtype=np.float32), ((0, 0), (0, 0), (1, 1)), mode="edge")


def inverse_spacing(
    spacing: NDArray[np.float64], layers: bool
) -> tuple[np.float32, np.float32, np.float32]:
    """One over the spacing along each axis; 0 along z where layers do not see each other."""
    x, y, z = (np.float32(1.0 / s) for s in spacing)
    return x, y, np.float32(0.0) if layers else z


def measure(
    u: Volume, f: Volume, g: Volume, spacing: NDArray[np.float64], *, layers: bool = False
) -> Energy:
    """Evaluate ``E = integral of f inside + integral of g over the surface`` (thesis eq. 5.6.6).

    Parameters
    ----------
    u : (nx, ny, nz) float32
        Level-set function, positive inside, near its front a signed distance in the unit of
        `spacing`.
    f, g : (nx, ny, nz) float32
        Volume weight (negative inside obstacles) and area weight (>= 0).
    spacing : (3,) float64
        Voxel spacing along x, y, z.
    layers : bool
        Measure the length of the outline in each layer, times the layer's thickness, in place of
        the area.

    Returns
    -------
    energy : Energy
    """
    with Slabs(1) as slabs:
        return measure_padded(padded(u), padded(f), padded(g), np.asarray(spacing), layers, slabs)


def measure_padded(
    u: Volume,
    f: Volume,
    g: Volume,
    spacing: NDArray[np.float64],
    layers: bool,
    slabs: Slabs,
) -> Energy:
    """Evaluate the energy of arrays that are :func:`padded` already.

    Parameters
    ----------
    u, f, g : (nx, ny, nz + 2) float32
        As for :func:`measure`, padded.
    spacing : (3,) float64
        Voxel spacing.
    layers : bool
        As for :func:`measure`.
    slabs : Slabs
        Threads to work with.

    Returns
    -------
    energy : Energy
    """
    pitch = np.float32(spacing[: 2 if layers else 3].min())
    arguments = (u, f, g, inverse_spacing(spacing, layers), pitch)
    even = np.ones(len(u), dtype=np.int64)
    slices = slabs.run(even, functools.partial(energy_slab, *arguments))
    # summed slice by slice: the same order for any number of slabs
    sums = np.concatenate(slices).sum(axis=0)
    cell = float(np.prod(spacing))
    return Energy(volume=float(sums[0]) * cell, area=float(sums[1]) * cell)
