"""The thesis' problem, 15 views on a 200 x 200 x 100 grid, against numpy and SimpleITK.

Run it by ``python -m tests.bench.bench_levelset [--full]``. All in one run, with the same weights f
and g from the same 15 rendered views of a ball and a box with their true silhouettes, and from the
same start, a box that fills the grid:

* gvpipe: data terms and evolution to rest, with 1 and 2 threads, also on 400 x 400 x 200;
* numpy: the same equation on whole arrays in float64; the time of 1500 iterations is extrapolated
  from a few, `--full` runs them all (some twenty minutes);
* SimpleITK: its geodesic active contour, until its own criterion stops it or after 1500 iterations.

Errors are distances, in voxels and both ways, to the surface at which 1500 iterations without
pyramid arrive; energies are those of gvpipe's energy.
"""

import argparse
import resource
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from gvpipe.core.reconstruct.evidence import data_terms
from gvpipe.core.reconstruct.evidence_options import EvidenceOptions, Silhouette
from gvpipe.core.reconstruct.grid import VoxelGrid
from gvpipe.core.reconstruct.levelset import Evolution, evolve
from gvpipe.core.synthesis.camera_path import circle, poses
from gvpipe.core.synthesis.scene import make_scene, photograph
from gvpipe.core.synthesis.solids import Solid
from gvpipe.core.synthesis.texture import stone
from gvpipe.core.types import Camera, Mount, PosedView
from tests.bench.level_set_peers import NumpyLevelSet, simpleitk

Array = NDArray[np.float32]
Shape = tuple[int, int, int]

VIEWS, ITERATIONS, NUMPY_SAMPLE = 15, 1500, 10
CAMERA = Camera(640, 480, 560.0, 560.0, 319.5, 239.5)
SOLIDS = (
    Solid("sphere", -0.2, 0.1, (0.34, 0.34, 0.34)),
    Solid("box", 0.2, -0.08, (0.24, 0.34, 0.3), yaw=0.4),
)
LOWER, UPPER = np.array([-0.5, -0.5, 0.0]), np.array([0.5, 0.5, 0.5])
SHAPE, LARGE, TINY = (200, 200, 100), (400, 400, 200), (40, 40, 30)


@dataclass
class Cost:
    """Seconds."""

    cpu: float = 0.0
    wall: float = 0.0

    def __str__(self) -> str:
        return f"cpu {self.cpu:7.2f} s, wall {self.wall:7.2f} s"


@contextmanager
def timed() -> Iterator[Cost]:
    cost = Cost()
    cpu, wall = time.process_time(), time.perf_counter()
    yield cost
    cost.cpu, cost.wall = time.process_time() - cpu, time.perf_counter() - wall


def say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def peak_mb() -> float:
    """Most memory that the process has held."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def pictures() -> tuple[list[PosedView], list[Silhouette]]:
    rng = np.random.default_rng(1)
    scene = make_scene(stone(rng), SOLIDS, rng=rng)
    mount = Mount(np.radians(35), 0.0, 0.85)
    views, shapes = [], []
    for k, pose in enumerate(poses(circle(VIEWS, 1.1), mount, 0.02, rng)):
        shot = photograph(scene, CAMERA, pose, samples=1, light_samples=1)
        views.append(PosedView(f"A/{k}.png", shot.pixels, CAMERA, pose))
        shapes.append((shot.solids >= 0).astype(np.float32))
    return views, shapes


def start_of(shape: Shape) -> Array:
    start = np.full(shape, -1.0, np.float32)
    start[2:-2, 2:-2, :-2] = 1.0
    return start


def weigh(
    views: list[PosedView], shapes: list[Silhouette], shape: Shape, jobs: int = 1
) -> tuple[Array, Array]:
    return data_terms(views, shapes, VoxelGrid.over(LOWER, UPPER, shape), EvidenceOptions(), jobs)


def run(start: Array, f: Array, g: Array, **how: object) -> Evolution:
    return evolve(start, f, g, np.ones(3), **{"iterations": ITERATIONS, **how})  # type: ignore[arg-type]


def energy_of(u: NDArray[np.floating], f: Array, g: Array) -> float:
    return run(u.astype(np.float32), f, g, iterations=0, levels=1).energy[0][1]


def state(u: NDArray[np.floating], f: Array, g: Array, reference: cKDTree) -> str:
    """Say how low the energy is and how far the surface from the reference's."""
    corners = marching_cubes(np.asarray(u, np.float32), 0.0)[0]
    there, back = reference.query(corners)[0], cKDTree(corners).query(reference.data)[0]
    off = np.concatenate([there, back])
    return (
        f"energy {energy_of(u, f, g):.0f}, error mean {off.mean():.2f} "
        f"p95 {np.percentile(off, 95):.2f} voxel"
    )


def ours(
    views: list[PosedView], shapes: list[Silhouette], shape: Shape, jobs: int
) -> tuple[Cost, Cost]:
    """Time data terms and evolution to rest."""
    with timed() as data:
        f, g = weigh(views, shapes, shape, jobs)
    with timed() as evolution:
        found = run(start_of(shape), f, g, jobs=jobs)
    total = Cost(data.cpu + evolution.cpu, data.wall + evolution.wall)
    say(
        f"gvpipe {'x'.join(map(str, shape))}, {jobs} threads: {total} "
        f"(data terms {data.wall:.2f}, evolution {evolution.wall:.2f}), {found.iterations} "
        f"iterations, at rest: {found.converged}, energy {found.energy[-1][1]:.0f}, "
        f"peak {peak_mb():.0f} MB"
    )
    return data, evolution


def main(arguments: list[str]) -> None:
    """Print one line a method, then the ratios."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--full", action="store_true", help="run all iterations of numpy")
    full = parser.parse_args(arguments).full
    views, shapes = pictures()
    run(start_of(TINY), *weigh(views, shapes, TINY))  # compile
    say(f"before: peak {peak_mb():.0f} MB")
    mine = [ours(views, shapes, SHAPE, jobs) for jobs in (1, 2)]

    f, g = weigh(views, shapes, SHAPE)
    start = start_of(SHAPE)
    with timed() as cost:
        plain = run(start, f, g, levels=1, tolerance=0.0)
    reference = cKDTree(marching_cubes(plain.u, 0.0)[0])
    iterations = f"{plain.iterations} iterations"
    say(f"without pyramid, {iterations}: {cost}, {state(plain.u, f, g, reference)}")
    say(f"gvpipe at rest: {state(run(start, f, g).u, f, g, reference)}")

    with timed() as itk:
        u, steps = simpleitk(start, f, ITERATIONS)
    say(f"SimpleITK, {steps} iterations: {itk}, {state(u, f, g, reference)}")

    peer = NumpyLevelSet(start, f, g)
    count = ITERATIONS if full else NUMPY_SAMPLE
    with timed() as cost:
        for _ in range(count):
            peer.iterate()
    numpy = Cost(cost.cpu * ITERATIONS / count, cost.wall * ITERATIONS / count)
    reached = state(peer.u, f, g, reference) if full else f"extrapolated from {count} iterations"
    say(f"numpy, {ITERATIONS} iterations: {numpy}, {reached}")

    (data, alone), (data_2, alone_2) = mine
    for name, other in (("numpy", numpy), ("SimpleITK", itk)):
        say(
            f"{name} / gvpipe, evolution: cpu {other.cpu / alone.cpu:.0f}x of one thread, "
            f"wall {other.wall / alone_2.wall:.0f}x of two; with the same data terms before both: "
            f"cpu {(other.cpu + data.cpu) / (alone.cpu + data.cpu):.0f}x, "
            f"wall {(other.wall + data_2.wall) / (alone_2.wall + data_2.wall):.0f}x"
        )
    ours(views, shapes, LARGE, 2)


if __name__ == "__main__":
    main(sys.argv[1:])
