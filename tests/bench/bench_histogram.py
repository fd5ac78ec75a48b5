"""Time and memory of the histogram distances: python tests/bench/bench_histogram.py [n]."""

import resource
import sys
import time

import numpy as np

from gvpipe.core.overlap.histogram import DISTANCES


def main(n: int = 10_000) -> None:
    rng = np.random.default_rng(0)
    h = rng.dirichlet(np.full(64, 0.3), n)
    g = rng.dirichlet(np.full(64, 0.3), n)
    for name, distance in DISTANCES.items():
        distance(h[:8], g[:8])  # compile
        cpu = []
        for _ in range(2):  # the first run also pays for fresh memory pages
            start = time.process_time()
            distance(h, g)
            cpu.append(time.process_time() - start)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        sys.stdout.write(
            f"{name:13s} {n} x {n}: {min(cpu):.2f} to {max(cpu):.2f} CPU s, peak {peak:.0f} MB\n"
        )


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
