"""The ordered map gives the same results at any number of workers, and survives dying ones."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from gvpipe.parallel import Crashed, Workers
from tests.faults.rig import session_members


def add(shared: int, item: int) -> int:
    return shared + item


def die_on_three(shared: int, item: int) -> int:
    if item == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return shared + item


def die_once(shared: str, item: int) -> int:
    if item == 1 and not Path(shared).exists():
        Path(shared).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return item


def fail(shared: int, item: int) -> int:
    raise ValueError(f"item {item}")


@pytest.mark.parametrize("jobs", [1, 2, 3])
def test_results_come_in_order(jobs: int) -> None:
    with Workers(10, jobs) as workers:
        assert list(workers.map(add, range(20))) == [10 + k for k in range(20)]
        assert list(workers.map(add, range(3))) == [10, 11, 12]


def test_an_item_that_kills_its_worker_is_named_and_the_rest_goes_on() -> None:
    with Workers(0, 2) as workers:
        results = list(workers.map(die_on_three, range(6)))
    assert results == [0, 1, 2, Crashed(3), 4, 5]


def test_a_worker_that_dies_once_costs_nothing(tmp_path: Path) -> None:
    with Workers(str(tmp_path / "died"), 2) as workers:
        assert list(workers.map(die_once, range(4))) == [0, 1, 2, 3]


def test_errors_of_the_function_reach_the_caller() -> None:
    with Workers(0, 2) as workers, pytest.raises(ValueError, match="item 0"):
        list(workers.map(fail, range(4)))


class Slow:
    """Takes a minute to arrive in a worker."""

    def __reduce__(self) -> tuple[Callable[[float], None], tuple[float]]:
        return time.sleep, (60.0,)


ORPHANING = """
from gvpipe.parallel import Workers
from tests.test_parallel import Slow, add
with Workers(Slow(), 2) as workers:
    next(workers.map(add, range(20)))
"""


def test_a_worker_that_still_starts_dies_with_its_parent() -> None:
    parent = subprocess.Popen([sys.executable, "-c", ORPHANING], start_new_session=True)
    started = time.monotonic()
    while len(session_members(parent.pid)) < 4 and time.monotonic() - started < 10:
        time.sleep(0.05)  # itself, two workers, and what tracks their resources
    time.sleep(0.5)
    parent.kill()
    parent.wait()
    killed = time.monotonic()
    while (left := session_members(parent.pid)) and time.monotonic() - killed < 5:
        time.sleep(0.05)
    for pid in left:
        os.kill(pid, signal.SIGKILL)
    assert not left


def test_nothing_runs_on_after_the_work() -> None:
    before = set(threading.enumerate())
    with Workers(10, 2) as workers:
        assert next(workers.map(add, range(20))) == 10
    assert set(threading.enumerate()) <= before
