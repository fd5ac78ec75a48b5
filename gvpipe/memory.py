"""A limit on the memory of a command: all its processes together."""

import os
import re
import signal
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

from gvpipe.errors import ResourceError, UsageError

PROCESS_BYTES = 256 << 20
"""What one process takes with its libraries and a few pictures, measured on pictures of 1 Mpx."""

CHECK_EVERY_S = 0.01
"""Fresh pages come at some 5 GB/s: between two looks a limit is passed by 50 MB at most."""

_UNITS = {"": 1, "K": 1 << 10, "M": 1 << 20, "G": 1 << 30, "T": 1 << 40}


def parse_size(text: str) -> int:
    """Read a size such as ``500M`` or ``1.5G``, in bytes.

    Raises
    ------
    UsageError
        If it is none.
    """
    match = re.fullmatch(r"([0-9]{1,12}(?:\.[0-9]{1,6})?)([KMGT]?)(?:i?B)?", text.strip(), re.I)
    size = int(float(match[1]) * _UNITS[match[2].upper()]) if match else 0
    if size <= 0:
        raise UsageError(f"--memory-limit {text!r}: expected a size, for example 500M or 2G")
    return size


def jobs_within(limit: int, jobs: int) -> int:
    """Reduce the worker processes to what a limit in bytes leaves room for."""
    room = limit // PROCESS_BYTES - 1  # one is the process that hands out the work
    return max(1, min(jobs, room))


def keep_within(limit: int) -> None:
    """End this process and those it started, with exit code 7, once they hold too much memory.

    Parameters
    ----------
    limit : int
        Bytes of main memory, all processes together; pages that they share count in each.

    Notes
    -----
    The end is as sudden as if the system had ended it, and leaves as little behind: checkpoints
    and former artefacts, nothing half-written under a final name.
    """
    threading.Thread(target=_watch, args=(limit,), daemon=True).start()


def _watch(limit: int) -> None:
    while True:
        pids = [os.getpid(), *_descendants(os.getpid())]
        held = sum(_resident_bytes(pid) for pid in pids)
        if held > limit:
            _end(held, limit, pids)
        time.sleep(CHECK_EVERY_S)


def _end(held: int, limit: int, pids: list[int]) -> NoReturn:
    processes = f"{len(pids)} processes hold" if len(pids) > 1 else "the process holds"
    message = f"memory limit of {limit >> 20} MB was hit: {processes} {held >> 20} MB"
    advice = "; fewer --jobs need less" if len(pids) > 1 else ""
    for pid in pids[1:]:
        try:
            os.kill(pid, signal.SIGKILL)
        except ProcessLookupError:
            continue
    print(f"gvpipe: {message}{advice}", file=sys.stderr, flush=True)  # noqa: T201
    os._exit(ResourceError.exit_code)


def _descendants(pid: int) -> Iterator[int]:
    """List the processes that a process started, and those that they started."""
    try:
        lists = [p.read_text() for p in Path(f"/proc/{pid}/task").glob("*/children")]
    except OSError:  # it ended meanwhile
        return
    for child in (int(number) for text in lists for number in text.split()):
        yield child
        yield from _descendants(child)


def _resident_bytes(pid: int) -> int:
    """Measure the main memory that a process holds; 0 if it has ended."""
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    except OSError:
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")
