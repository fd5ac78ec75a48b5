"""An ordered map over worker processes whose results do not depend on their number."""

import ctypes
import gc
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context, parent_process
from multiprocessing.reduction import ForkingPickler
from types import TracebackType
from typing import Any, Generic, Self, TypeVar

S = TypeVar("S")
T = TypeVar("T")
R = TypeVar("R")

_GARBAGE_AFTER = 500_000
"""New objects after which Python looks for garbage: after its usual 700 it looks hundreds of times
while libraries load, a tenth of a short run."""

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of glibc's malloc.h
_KEPT_FREE, _LARGE = 64 << 20, 32 << 20
"""Bytes of freed memory kept, and of an array that is handed back at once whatever is kept: where
glibc arrives by itself once it has freed an array of the latter size."""

IN_FLIGHT_PER_WORKER = 4
"""Items handed out ahead of the workers: keeps them busy, bounds what waits in memory."""


@dataclass(frozen=True)
class Crashed(Generic[T]):
    """A worker process died twice on this item."""

    item: T


def spare_housekeeping() -> None:
    """Let this process look for garbage seldom, and keep what arrays the size of a picture free.

    Until it has seen larger ones, glibc hands such memory back and gets it anew, page by page.
    """
    gc.set_threshold(_GARBAGE_AFTER)
    libc = ctypes.CDLL(None)
    if hasattr(libc, "mallopt"):
        libc.mallopt(_M_TRIM_THRESHOLD, _KEPT_FREE)
        libc.mallopt(_M_MMAP_THRESHOLD, _LARGE)


_shared: Any = None
"""What every call in this worker process receives; set once when the process starts."""


def _start_worker(shared: bytes) -> None:
    """Prepare a worker: one thread for OpenCV, interrupts left to the parent."""
    global _shared
    spare_housekeeping()
    threading.Thread(target=_die_with_parent, daemon=True).start()
    _shared = ForkingPickler.loads(shared)  # imports what takes seconds on a busy machine
    import cv2

    cv2.setNumThreads(1)


def _die_with_parent() -> None:
    """End this worker when the process that started it is gone, however that ended."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """Hold SIGINT back for a moment; processes started meanwhile never receive it.

    A terminal sends it to all processes at once, but only the parent is to act on it.
    """
    held = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, held)


def _call(function: Callable[[Any, T], R], item: T) -> R:
    return function(_shared, item)


class Workers(Generic[S]):
    """Worker processes that share one read-only object; they start when they are first needed.

    Parameters
    ----------
    shared : object
        First argument of every mapped function; sent to each worker once.
    jobs : int
        Worker processes; with 1 everything runs in this process.
    """

    def __init__(self, shared: S, jobs: int):
        self._shared, self._jobs = shared, jobs
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stop()

    def map(self, function: Callable[[S, T], R], items: Sequence[T]) -> Iterator[R | Crashed[T]]:
        """Yield ``function(shared, item)`` for each item, in the items' order.

        A worker that dies is noticed: the item whose turn it is runs again alone, in a process
        of its own, and yields `Crashed` if that dies as well. `function` must be importable by
        name.
        """
        if self._jobs <= 1 or len(items) <= 1:
            for item in items:
                yield function(self._shared, item)
            return
        done = 0
        while done < len(items):
            for result in self._until_a_worker_dies(function, items[done:]):
                yield result
                done += 1
            if done < len(items):
                yield self._alone(function, items[done])
                done += 1

    def stop(self) -> None:
        """End the processes at once, for good or until more is mapped; none may linger."""
        pool, self._pool = self._pool, None
        if pool is None:
            return
        processes = list((pool._processes or {}).values())
        for process in processes:
            process.kill()  # workers hold nothing that would need their cleaning up
        pool.shutdown(wait=True, cancel_futures=True)  # or its thread races the interpreter's end
        for process in processes:
            process.join()

    def _until_a_worker_dies(
        self, function: Callable[[S, T], R], items: Sequence[T]
    ) -> Iterator[R]:
        """Yield results in order; end early, without error, when the pool breaks."""
        pool = self._pool = self._pool or self._start(self._jobs)
        waiting: deque[Future[R]] = deque()
        try:
            for item in items:
                with _interrupts_held():
                    waiting.append(pool.submit(_call, function, item))
                if len(waiting) >= IN_FLIGHT_PER_WORKER * self._jobs:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        except BrokenProcessPool:
            self.stop()

    def _alone(self, function: Callable[[S, T], R], item: T) -> R | Crashed[T]:
        """Run one item in a process of its own."""
        self._pool = self._start(1)
        try:
            with _interrupts_held():
                future = self._pool.submit(_call, function, item)
            return future.result()
        except BrokenProcessPool:
            return Crashed(item)
        finally:
            self.stop()

    def _start(self, workers: int) -> ProcessPoolExecutor:
        # a fresh interpreter each: forking a process that has threads is not safe
        return ProcessPoolExecutor(
            workers,
            mp_context=get_context("spawn"),
            initializer=_start_worker,
            initargs=(bytes(ForkingPickler.dumps(self._shared)),),
        )
