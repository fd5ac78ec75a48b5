"""Time and memory of the level-set engine on a ball and a box, against their known surface.

Run it by ``python -m tests.bench.bench_levelset [NX NY NZ]``; default 200 200 100.
"""

import argparse
import resource
import sys
import time

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from skimage.measure import marching_cubes

from gvpipe.core.reconstruct.levelset import evolve

Array = NDArray[np.float32]


def problem(shape: tuple[int, int, int]) -> tuple[Array, Array, Array, Array]:
    """True distance, weights and an all-enclosing start, in voxels."""
    scale = np.float32(shape[0] / 200)
    x, y, z = np.meshgrid(
        *[np.arange(n, dtype=np.float32) - (n - 1) / 2 for n in shape], indexing="ij", sparse=True
    )
    ball = np.sqrt((x + 35 * scale) ** 2 + (y + 20 * scale) ** 2 + (z + 10 * scale) ** 2)
    floor = np.float32(-shape[2] / 2)
    box = np.maximum(np.abs(x - 45 * scale) - 25 * scale, np.abs(y - 25 * scale) - 35 * scale)
    box = np.maximum(box, z - floor - 60 * scale)
    distance = np.minimum(ball - 30 * scale, box).astype(np.float32)
    f = np.tanh(distance / 3) * np.where(distance < 0, 1.0, 0.15)
    g = 0.5 - 0.4 * np.exp(-((distance / 3) ** 2))
    margin = 8 * scale
    start = np.minimum(shape[0] / 2 - margin - np.abs(x), shape[1] / 2 - margin - np.abs(y))
    start = np.minimum(start, shape[2] / 2 - margin - z)
    return distance, f.astype(np.float32), g.astype(np.float32), start.astype(np.float32)


def main(arguments: list[str]) -> None:
    """Print one line for each number of threads."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("shape", nargs="*", type=int, default=[200, 200, 100])
    nx, ny, nz = parser.parse_args(arguments).shape
    _, *small = problem((40, 40, 30))
    evolve(small[2], small[0], small[1], np.ones(3), iterations=9)  # compile
    distance, f, g, start = problem((nx, ny, nz))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for jobs in (1, 2):
        wall, cpu = time.perf_counter(), time.process_time()
        result = evolve(start, f, g, np.ones(3), iterations=1500, jobs=jobs)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        corners, *_ = marching_cubes(result.u, 0.0)
        error = np.abs(map_coordinates(distance, corners.T, order=1))
        sys.stdout.write(
            f"{nx}x{ny}x{nz} jobs {jobs}: cpu {cpu:.2f} s, wall {wall:.2f} s, "
            f"{result.iterations} iterations, at rest {result.converged}, energy "
            f"{result.energy[-1][1]:.0f}, error mean {error.mean():.3f} p95 "
            f"{np.percentile(error, 95):.3f} voxel, "
            f"peak of the process {peak / 1024:.0f} MB, before {before / 1024:.0f} MB\n"
        )


if __name__ == "__main__":
    main(sys.argv[1:])
