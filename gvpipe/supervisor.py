"""A small process that watches over the working one, so that a signal always ends both in time.

Python runs signal handlers between two steps of its own, which a long compiled loop puts off; and
a process that runs out of memory or crashes cannot say so itself. The first process therefore
does nothing but wait: it forwards signals, waits a moment, then kills, and turns every end into
one of the documented exit codes.
"""

import atexit
import os
import signal
import sys
import threading
from collections.abc import Callable
from types import FrameType
from typing import NoReturn

from gvpipe.errors import EXIT_DEFECT, EXIT_INTERRUPTED, EXIT_TERMINATED, ResourceError

GRACE_S = 1.5
"""Time to clean up after a signal; whoever sent it waits no longer than 2 s."""

_SIGNALS: frozenset[signal.Signals] = frozenset({signal.SIGINT, signal.SIGTERM})
_EXIT_CODES: dict[int, int] = {signal.SIGINT: EXIT_INTERRUPTED, signal.SIGTERM: EXIT_TERMINATED}


class Terminated(BaseException):
    """SIGTERM arrived; unwinds like an interruption so that everything is cleaned up."""


def supervised(work: Callable[[], int], parting: str = "") -> int:
    """Run a function in a process of its own and return its exit code.

    Parameters
    ----------
    work : callable
        Returns an exit code. In its process SIGINT raises `KeyboardInterrupt` and SIGTERM
        :class:`Terminated`, once; later signals are ignored so that cleaning up is not disturbed.
    parting : str
        What is said on standard error after a signal; nothing if it is empty.

    Returns
    -------
    code : int
        That of `work`; 130 or 143 after a signal, whatever became of the process; 7 if the
        system killed it, as it does when memory runs out.
    """
    held = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    alive, life = os.pipe()  # reads end-of-file once this process is gone, however it ended
    worker = os.fork()
    if worker == 0:
        os.close(life)
        _work(work, alive, held)
    os.close(alive)
    received: list[int] = []

    def forward(number: int, frame: FrameType | None) -> None:
        received.append(number)
        os.kill(worker, number)
        signal.setitimer(signal.ITIMER_REAL, GRACE_S)

    signal.signal(signal.SIGALRM, lambda number, frame: os.kill(worker, signal.SIGKILL))
    for number in _SIGNALS:
        signal.signal(number, forward)
    signal.pthread_sigmask(signal.SIG_SETMASK, held)
    os.waitid(os.P_PID, worker, os.WEXITED | os.WNOWAIT)  # its number is its own until it is reaped
    signal.pthread_sigmask(signal.SIG_BLOCK, {*_SIGNALS, signal.SIGALRM})
    code = os.waitstatus_to_exitcode(os.waitpid(worker, 0)[1])
    return _exit_code(code, received, parting)


def _exit_code(code: int, received: list[int], parting: str) -> int:
    """Map the end of the working process to a documented code."""
    if code and received:
        if parting:  # said here: the working process may have had to be killed
            _say(f"{'interrupted' if received[0] == signal.SIGINT else 'terminated'}; {parting}")
        return _EXIT_CODES[received[0]]
    if code >= 0:
        return code
    name = signal.Signals(-code).name
    if -code == signal.SIGKILL:
        _say(f"killed by {name}, as the system does when memory runs out")
        return ResourceError.exit_code
    if -code in _EXIT_CODES:
        return _EXIT_CODES[-code]
    _say(f"ended by {name}: this is a defect in gvpipe or a library; please report it")
    return EXIT_DEFECT


def _say(message: str) -> None:
    print(f"gvpipe: {message}", file=sys.stderr)  # noqa: T201


def _work(work: Callable[[], int], alive: int, held: set[int | signal.Signals]) -> NoReturn:
    """Live as the working process."""
    threading.Thread(target=_die_with, args=(alive,), daemon=True).start()
    _silence_libraries()
    try:
        for number in _SIGNALS:
            signal.signal(number, _unwind)
        signal.pthread_sigmask(signal.SIG_SETMASK, held)
        code = work()
    except KeyboardInterrupt:
        code = EXIT_INTERRUPTED
    except Terminated:
        code = EXIT_TERMINATED
    _leave(code)


def _leave(code: int) -> NoReturn:
    """Exit as Python does, but without taking all libraries apart: a tenth of a short run."""
    atexit._run_exitfuncs()
    try:
        sys.stdout.flush()
        sys.stderr.flush()
    except (AttributeError, OSError, ValueError):  # closed, or its reader gone: Python says so
        sys.exit(code)
    os._exit(code)


def _silence_libraries() -> None:
    """Leave standard error to gvpipe: decoders write there without naming the file they mean."""
    if sys.stderr is None:  # closed by whoever started the program
        return
    ours = os.dup(sys.stderr.fileno())
    sys.stderr = os.fdopen(ours, "w", buffering=1, errors="backslashreplace")
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    os.close(nowhere)


def _unwind(number: int, frame: FrameType | None) -> None:
    for other in _SIGNALS:
        signal.signal(other, signal.SIG_IGN)
    raise KeyboardInterrupt if number == signal.SIGINT else Terminated


def stopping() -> bool:
    """Whether a signal has ended the work: what fails from then on fails for that reason.

    A library that is being loaded turns the exception of a signal into one of its own.
    """
    return signal.getsignal(signal.SIGTERM) is signal.SIG_IGN


def _die_with(alive: int) -> None:
    """Wait until the supervising process is gone, then follow it."""
    os.read(alive, 1)
    os.kill(os.getpid(), signal.SIGKILL)
