"""A level-set function that is kept up to date near its front only."""

import functools

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.kernels.distance import distance_slab, front_spans, settle
from gvpipe.core.kernels.levelset import evolve_slab
from gvpipe.core.reconstruct.energy import inverse_spacing
from gvpipe.core.reconstruct.grid import Volume
from gvpipe.core.reconstruct.slabs import Slabs

BAND = 5
"""Half width of the narrow band, voxels: the front's travel between two redistancings, and the
smoothed step of the energy, fit in it."""

COURANT = 0.9
"""Share of the largest stable time step that is taken (below 1 by a margin for rounding)."""

SLOWEST = 1e-3
"""Smallest rate by which a time step is divided, as a share of the largest possible one: keeps
steps finite where both weights vanish."""


class NarrowBand:
    """One resolution of the evolution: weights, two buffers for u, and where the front is.

    Parameters
    ----------
    u : (nx, ny, nz + 2) float32
        Padded level-set function; only its sign changes matter. Becomes the first buffer.
    f, g : (nx, ny, nz + 2) float32
        Padded volume and area weights.
    spacing : (3,) float64
        Voxel spacing.
    layers : bool
        Evolve every z layer as a plane of its own.
    slabs : Slabs
        Threads to work with.

    Attributes
    ----------
    u : (nx, ny, nz + 2) float32
        Current level-set function, a signed distance after :meth:`redistance`.
    steps : int
        Time steps that may pass between two redistancings.
    """

    def __init__(
        self,
        u: Volume,
        f: Volume,
        g: Volume,
        spacing: NDArray[np.float64],
        layers: bool,
        slabs: Slabs,
    ) -> None:
        self._slabs = slabs
        self.u, self._spare, self._f, self._g = u, u.copy(), f, g
        self._layers = layers
        self._inverse = inverse_spacing(spacing, layers)
        inverse = np.array(self._inverse, dtype=np.float64)
        self._pitch = float(1.0 / inverse.max())
        self.steps = max(int((BAND - 1.5) / (COURANT * inverse.max() / inverse.sum())), 1)
        rate = float(max(f.max(), -f.min()) * inverse.sum() + 2.0 * g.max() * (inverse**2).sum())
        self._floor = np.float32(max(SLOWEST * rate, 1e-30))
        self._spans = self._everywhere()

    def _everywhere(self) -> NDArray[np.int32]:
        """Spans of a band that holds every voxel: (nx, ny, 2), first and last but one in z."""
        nx, ny, depth = self.u.shape
        return np.broadcast_to(np.array([1, depth - 1], dtype=np.int32), (nx, ny, 2)).copy()

    def restart(self, u: Volume) -> None:
        """Go back to a given u."""
        np.copyto(self.u, u)
        np.copyto(self._spare, u)
        self._spans = self._everywhere()
        self.redistance()

    def step(self, courant: float) -> None:
        """Take one time step, `courant` times the largest stable one of each voxel."""
        limit = np.float32(1.0 / self._pitch)
        arguments = (
            self.u, self._spare, self._f, self._g, self._spans, self._inverse,
            np.float32(courant), limit, self._floor,
        )  # fmt: skip
        self._slabs.run(_work(self._spans), functools.partial(evolve_slab, *arguments))
        self.u, self._spare = self._spare, self.u

    def redistance(self) -> None:
        """Make u a signed distance near the front, and move the band there."""
        new = front_spans(self.u, self._layers, BAND, self._spans)
        work = _work(new)
        for sweep in range(BAND + 1):
            arguments = (self.u, self._spare, new, self._inverse, sweep == 0)
            self._slabs.run(work, functools.partial(distance_slab, *arguments))
            self.u, self._spare = self._spare, self.u
        settle(self.u, self._spare, self._spans, new, np.float32(BAND * self._pitch))
        self._spans = new


def _work(spans: NDArray[np.int32]) -> NDArray[np.int64]:
    """Voxels inside the spans of each x slice."""
    return (spans[..., 1] - spans[..., 0]).sum(axis=1, dtype=np.int64)
