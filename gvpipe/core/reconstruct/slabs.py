"""Slabs of an array handed to threads, with results that do not depend on how many there are."""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from types import TracebackType
from typing import Self, TypeVar

import numpy as np
from numpy.typing import NDArray

R = TypeVar("R")
T = TypeVar("T")

THIN = 1 << 17
"""Values in the slabs of an array that is worked on a slab at a time: they stay in the cache."""


class Slabs:
    """Runs a kernel on slabs ``start <= i < stop`` of the first axis, side by side.

    Kernels release the interpreter lock and write their own slab only, so the number of threads
    changes nothing but the time.

    Parameters
    ----------
    jobs : int
        Threads; 1 runs everything in this one.
    """

    def __init__(self, jobs: int) -> None:
        self.jobs = jobs
        self._pool = ThreadPoolExecutor(jobs) if jobs > 1 else None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._pool is not None:
            self._pool.shutdown()

    def map(self, function: Callable[[T], R], items: Iterable[T]) -> list[R]:
        """Call a function for each item, side by side; results in order."""
        if self._pool is None:
            return [function(item) for item in items]
        return list(self._pool.map(function, items))

    def run(self, work: NDArray[np.int64], function: Callable[[int, int], R]) -> list[R]:
        """Call ``function(start, stop)`` for slabs of about equal work; results in order.

        Parameters
        ----------
        work : (n,) int64
            Work at each index of the first axis.
        function : callable
            Takes the slab's bounds.

        Returns
        -------
        results : list
            One a slab.
        """
        if self._pool is None:
            return [function(0, len(work))]
        total = np.cumsum(work)
        inner = np.searchsorted(total, total[-1] * np.arange(1, self.jobs) / self.jobs)
        bounds = [0, *(int(b) for b in inner), len(work)]
        return list(self._pool.map(function, bounds[:-1], bounds[1:]))


def thin_slabs(shape: tuple[int, ...]) -> list[tuple[int, int]]:
    """Bounds along the first axis of slabs of about ``THIN`` values, whatever the threads."""
    thickness = max(THIN // int(np.prod(shape[1:])), 1)
    return [(i, min(i + thickness, shape[0])) for i in range(0, shape[0], thickness)]
