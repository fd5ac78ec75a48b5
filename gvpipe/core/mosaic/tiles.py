"""Work on many pieces at once, with results in their order and bounded memory."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")

AHEAD = 4
"""Pieces in work or waiting for each thread: enough to keep it busy, few enough to hold."""


def in_order(work: Callable[[T], R], pieces: Iterable[T], jobs: int) -> Iterator[R]:
    """Do the same work on each piece in threads.

    Parameters
    ----------
    work : callable
        Compiled loops and decoders let other threads run.
    pieces : iterable
        Read only a little ahead of the results.
    jobs : int
        Threads; the results do not depend on it.

    Yields
    ------
    result : object
        Of each piece, in their order.
    """
    threads = max(jobs, 1)
    with ThreadPoolExecutor(max_workers=threads) as pool:
        waiting: deque[Future[R]] = deque()
        try:
            for piece in pieces:
                waiting.append(pool.submit(work, piece))
                if len(waiting) >= AHEAD * threads:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for unfinished in waiting:
                unfinished.cancel()
