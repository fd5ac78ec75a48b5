"""Time and memory of the histogram distances: python tests/bench/bench_histogram.py [n].

All n x n distances in blocks of rows, as the candidate list takes them, then the candidate list
itself; each in a process of its own, so that its peak memory is its own.
"""

import resource
import subprocess
import sys
import time
from collections.abc import Callable

import numpy as np

from gvpipe.core.overlap.candidates import BLOCK, shortlist
from gvpipe.core.overlap.histogram import DISTANCES


def blocks(h: np.ndarray, g: np.ndarray, name: str) -> None:
    for start in range(0, len(h), BLOCK):
        DISTANCES[name](h[start : start + BLOCK], g)


def candidates(h: np.ndarray, g: np.ndarray, name: str) -> None:
    shortlist(h, g, DISTANCES[name], 20)


TASKS: dict[str, Callable[[np.ndarray, np.ndarray, str], None]] = {
    "distances": blocks,
    "shortlist": candidates,
}


def run(task: str, name: str, n: int) -> None:
    rng = np.random.default_rng(0)
    h = rng.dirichlet(np.full(64, 0.3), n)
    g = rng.dirichlet(np.full(64, 0.3), n)
    TASKS[task](h[:64], g[:64], name)  # compile
    start = time.process_time()
    TASKS[task](h, g, name)
    cpu = time.process_time() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    sys.stdout.write(f"{task} {name:13s} {n} x {n}: {cpu:.2f} CPU s, peak {peak:.0f} MB\n")


if __name__ == "__main__":
    if len(sys.argv) > 2:
        run(sys.argv[1], sys.argv[2], int(sys.argv[3]))
    else:
        size = sys.argv[1] if len(sys.argv) > 1 else "10000"
        for case in [("distances", name) for name in DISTANCES] + [("shortlist", "chi2")]:
            subprocess.run([sys.executable, __file__, *case, size], check=True)
