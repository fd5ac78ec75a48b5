"""Evolution of a closed surface to the nearest minimum of a volume and an area term."""

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.kernels.resample import double, halve, nucleate
from gvpipe.core.reconstruct.energy import Energy, measure_padded, padded
from gvpipe.core.reconstruct.grid import Volume
from gvpipe.core.reconstruct.narrowband import COURANT, NarrowBand
from gvpipe.core.reconstruct.slabs import Slabs

SMALLEST_LEVEL = 12
"""A pyramid level is not made coarser than this many voxels along any axis."""

MOST_LEVELS = 3
"""Levels of the pyramid: coarser ones lose obstacles a few voxels wide."""

COARSE_ROUNDS = 4
"""Rounds of a coarse level between two looks at the energy on the finest grid, which cost as much
as several rounds."""

COARSE_PATIENCE = 10.0
"""A coarse level ends at this many times the tolerance: the next one continues cheaply."""

SMALLEST_COURANT = 0.2
"""Below this share of the stable time step a rise of the energy is noise: the front rests."""


@dataclass(frozen=True)
class Evolution:
    """A surface at rest, or as far as the iterations went.

    Attributes
    ----------
    u : (nx, ny, nz) float32
        Positive inside; within the narrow band a signed distance in the unit of the spacing,
        beyond it clipped.
    energy : list of (int, float)
        Iteration and energy on the finest grid, from the start to the end; never rises.
    iterations : int
        Time steps taken, on all levels.
    converged : bool
        Whether the surface came to rest before the iterations ran out.
    """

    u: Volume
    energy: list[tuple[int, float]]
    iterations: int
    converged: bool


def evolve(
    u0: Volume,
    f: Volume,
    g: Volume,
    spacing: NDArray[np.float64],
    *,
    iterations: int,
    evolution: Literal["volume", "layers"] = "volume",
    tolerance: float = 1e-4,
    on_iteration: Callable[[int, Volume], None] | None = None,
    levels: int | None = None,
    jobs: int = 1,
) -> Evolution:
    """Move a closed surface downhill on ``E = integral of f inside + integral of g over it``.

    Parameters
    ----------
    u0 : (nx, ny, nz) float32
        Start, positive inside; only its sign changes matter. Values may have any unit.
    f : (nx, ny, nz) float32
        Volume weight, negative inside obstacles.
    g : (nx, ny, nz) float32
        Area weight, >= 0, in the unit of f times the unit of `spacing`.
    spacing : (3,) float64
        Voxel spacing along x, y, z.
    iterations : int
        Most time steps to take, all levels together.
    evolution : "volume" or "layers"
        In three dimensions, or each z layer as a plane of its own (thesis, section 5.9).
    tolerance : float
        At rest when the energy falls by less than this share of (area term + size of volume
        term) in one round of about ten time steps.
    on_iteration : callable, optional
        Called with the iteration and u on the finest grid at every entry of the energy trace.
    levels : int, optional
        Resolutions to work on, coarse to fine. Default: three where the grid allows it; one for
        layers, whose number must not change.
    jobs : int
        Threads; the result does not depend on them.

    Returns
    -------
    evolution : Evolution

    Raises
    ------
    ValueError
        If shapes differ, a weight is not finite, g is negative, or the evolution is unknown.

    Notes
    -----
    The flow is ``u_t = grad g . grad u + g div(grad u / |grad u|) |grad u| - f |grad u|`` (thesis
    eq. 5.6.18 with the factor of its curvature term corrected from 2 to 1), with a time step per
    voxel. After each round of steps u is made a signed distance and the energy is measured: on a
    coarse level that of its own grid, which says when it rests, and every few rounds that of the
    finest grid, which is traced. On the finest level a round that would raise the energy is taken
    back and tried once more with half the step.
    """
    spacing = np.asarray(spacing, dtype=np.float64)
    _check(u0, f, g, evolution)
    layers = evolution == "layers"
    if levels is None:
        levels = 1 if layers else MOST_LEVELS
    with Slabs(jobs) as slabs:
        descent = _Descent(
            padded(u0), padded(f), padded(g), spacing, layers, tolerance, on_iteration, slabs
        )
        converged = descent.run(levels, iterations)
    u = np.ascontiguousarray(descent.best[:, :, 1:-1])
    return Evolution(u, descent.trace, descent.iteration, converged)


def _check(u0: Volume, f: Volume, g: Volume, evolution: str) -> None:
    """Raise ValueError for arguments that no evolution can begin with."""
    if not u0.shape == f.shape == g.shape or u0.ndim != 3:
        raise ValueError(f"shapes differ: u0 {u0.shape}, f {f.shape}, g {g.shape}")
    if not (np.isfinite(u0).all() and np.isfinite(f).all() and np.isfinite(g).all()):
        raise ValueError("u0, f and g must be finite")
    if g.min() < 0:
        raise ValueError("g must not be negative: curvature flow would run backwards")
    if evolution not in ("volume", "layers"):
        raise ValueError(f"unknown evolution {evolution!r}: volume or layers")


FACES = (
    (slice(1),),
    (slice(-1, None),),
    (slice(None), slice(1)),
    (slice(None), slice(-1, None)),
    (slice(None), slice(None), slice(2)),
    (slice(None), slice(None), slice(-2, None)),
)
"""The six faces of a padded grid."""


def _keep_clear(coarse: Volume, fine: Volume, depth: np.float32) -> None:
    """Take coarse voxels out of the inside along faces of the grid that the fine inside avoids.

    A surface between a face and the centres of the coarse voxels behind it would be lost: the
    inside would reach out of the grid there, and nothing drives it back.
    """
    for face in FACES:
        if (fine[face] <= 0).all():
            np.minimum(coarse[face], -depth, out=coarse[face])


@dataclass
class _Descent:
    """The evolution on all levels: the best surface so far and how its energy fell."""

    best: Volume
    f: Volume
    g: Volume
    spacing: NDArray[np.float64]
    layers: bool
    tolerance: float
    on_iteration: Callable[[int, Volume], None] | None
    slabs: Slabs
    iteration: int = 0
    trace: list[tuple[int, float]] = field(default_factory=list)

    def run(self, levels: int, iterations: int) -> bool:
        """Descend from coarse to fine; True if the finest level came to rest."""
        weights = [(self.f, self.g)]
        while len(weights) < levels and min(self._size(len(weights))) >= SMALLEST_LEVEL:
            f, g = weights[-1]
            weights.append((halve(f), halve(g)))
        starts = [self.best.copy()]
        while len(starts) < len(weights):
            starts.append(halve(starts[-1]))
        u = self._band(0, weights[0], self.best.copy()).u
        self._accept(u, self._energy(u))
        del u  # a whole grid
        rests = False
        for level in range(len(weights) - 1, -1, -1):
            if level < len(weights) - 1:
                self._seed(level, weights[level], starts[level])
            u = self._coarse(level)
            band = self._band(level, weights[level], u if level else u.copy())
            if level:
                self._approach(band, level, weights[level], iterations)
            else:
                rests = self._settle(band, iterations)
        return rests

    def _coarse(self, level: int) -> Volume:
        """Bring the best surface to a level; on the finest it is the best surface itself."""
        u = self.best
        for _ in range(level):
            u = halve(u)
        if level:
            _keep_clear(u, self.best, np.float32(self.spacing.min() * 2 ** (level - 1)))
        return u

    def _band(self, level: int, weights: tuple[Volume, Volume], u: Volume) -> NarrowBand:
        """Narrow band of a level around the front of u."""
        band = NarrowBand(u, *weights, self.spacing * 2**level, self.layers, self.slabs)
        band.redistance()
        return band

    def _seed(self, level: int, weights: tuple[Volume, Volume], start: Volume) -> None:
        """Restore what the start held and a coarser level was too coarse to keep."""
        x, y, z = (np.float32(s) for s in self.spacing * 2**level)
        area = np.float32(2.0 / 3.0) * (x * y + y * z + z * x)
        seeded = nucleate(self._coarse(level), *weights, start, x * y * z, area)
        u = self._lift(self._band(level, weights, seeded).u, level)
        energy = self._energy(u)
        if energy.total < self.trace[-1][1]:
            self._accept(u, energy)

    def _size(self, level: int) -> tuple[int, ...]:
        """Voxels along each axis on a level."""
        x, y, z = self.f.shape
        return tuple(-(-n // 2**level) for n in (x, y, z - 2))

    def _approach(
        self, band: NarrowBand, level: int, weights: tuple[Volume, Volume], iterations: int
    ) -> None:
        """Run rounds on a coarse level until its own energy rests, or the finest grid's does."""
        last = self._measured(band.u, *weights, level).total
        for rounds in itertools.count(1):
            self._round(band, COURANT, iterations)
            energy = self._measured(band.u, *weights, level)
            size = energy.area + abs(energy.volume)
            rests = last - energy.total < COARSE_PATIENCE * self.tolerance * size
            last = energy.total
            ends = rests or self.iteration >= iterations
            if ends or rounds % COARSE_ROUNDS == 0:
                u = self._lift(band.u, level)
                fine = self._energy(u)
                if fine.total >= self.trace[-1][1]:
                    return
                self._accept(u, fine)
            if ends:
                return

    def _settle(self, band: NarrowBand, iterations: int) -> bool:
        """Run rounds on the finest grid until its energy rests; True if it did."""
        courant = COURANT
        while self.iteration < iterations:
            self._round(band, courant, iterations)
            energy = self._energy(band.u)
            gain = self.trace[-1][1] - energy.total
            if gain > 0:
                self._accept(band.u, energy)
                if gain < self.tolerance * (energy.area + abs(energy.volume)):
                    return True
            elif courant < SMALLEST_COURANT:
                return True
            else:
                courant /= 2
                band.restart(self.best)
        return False

    def _round(self, band: NarrowBand, courant: float, iterations: int) -> None:
        """Take as many time steps as the band allows, then make u a signed distance again."""
        for _ in range(min(band.steps, iterations - self.iteration)):
            band.step(courant)
            self.iteration += 1
        band.redistance()

    def _lift(self, u: Volume, level: int) -> Volume:
        """Bring a level's u to the finest grid."""
        for finer in range(level - 1, -1, -1):
            nx, ny, nz = self._size(finer)
            lifted = np.empty((nx, ny, nz + 2), dtype=np.float32)
            double(u, lifted)
            u = lifted
        return u

    def _energy(self, u: Volume) -> Energy:
        """Energy of u on the finest grid."""
        return self._measured(u, self.f, self.g, 0)

    def _measured(self, u: Volume, f: Volume, g: Volume, level: int) -> Energy:
        """Energy of u on a level, its weights given."""
        return measure_padded(u, f, g, self.spacing * 2**level, self.layers, self.slabs)

    def _accept(self, u: Volume, energy: Energy) -> None:
        """Take u as the best surface so far."""
        np.copyto(self.best, u)
        self.trace.append((self.iteration, energy.total))
        if self.on_iteration is not None:
            self.on_iteration(self.iteration, self.best[:, :, 1:-1])
