"""Cost and accuracy of matching against SIFT + ratio test + MAGSAC on the raw pictures.

Run ``python -m tests.bench.bench_match [CONFIG ...]`` from the repository. CPU seconds of one
thread, pictures decoded beforehand. Without a configuration, photographs of two synthetic floors
are matched, whose homographies are known: a smooth one, on which raw SIFT finds 2000 keypoints, and
a grained one with all of the 4000 it may have. With one, its pairs are matched.
"""

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from gvpipe.configfile import load_config
from gvpipe.core.geometry.homography import apply, transfer_errors
from gvpipe.core.matching.features import MatchOptions
from gvpipe.core.matching.matchers import MATCHERS, extract, match_views
from gvpipe.core.types import Camera, Float, Image, PairMatch, View
from gvpipe.dataset import open_dataset
from gvpipe.stages.match import planned_pairs
from tests.synthetic import Scene, common_ground, texture, true_homography, view_at

CAMERA = Camera(width=640, height=480, fx=545.0, fy=545.0, cx=319.5, cy=239.5)
TARGETS = {"sift": 0.5, "sift cached": 0.15}
"""Most that the default matcher may cost, as a share of the raw pictures' cost."""


@dataclass(frozen=True)
class Task:
    """A pair of views and, where it is known, the truth about it.

    Attributes
    ----------
    name : str
    view_i, view_j : View
    points_i, points_j : (N, 2) float64
        Pixels of common ground and where they are in the other picture; empty if not known.
    """

    name: str
    view_i: View
    view_j: View
    points_i: Float
    points_j: Float


def raw_sift(a: View, b: View) -> Float | None:
    """What people use today: nothing is known of the cameras."""
    sift = cv2.SIFT.create(4000)
    (k_a, d_a), (k_b, d_b) = (
        sift.detectAndCompute(cv2.cvtColor(v.pixels, cv2.COLOR_RGB2GRAY), None) for v in (a, b)
    )
    pairs = cv2.BFMatcher().knnMatch(d_a, d_b, k=2)
    good = [m for m, n in pairs if m.distance < 0.8 * n.distance]
    if len(good) < 8:
        return None
    p = np.array([k_a[m.queryIdx].pt for m in good])
    q = np.array([k_b[m.trainIdx].pt for m in good])
    return cv2.findHomography(p, q, cv2.USAC_MAGSAC, 2.0, None, 10000, 0.9999)[0]


def floors(rng: np.random.Generator) -> Iterator[tuple[str, Image]]:
    """Make one floor without fine detail, and the same with grain."""
    smooth = cv2.resize(texture(rng), None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
    grain = cv2.GaussianBlur(rng.normal(size=smooth.shape[:2]), (0, 0), 1.0)
    yield "smooth", smooth.astype(np.uint8)
    grained = smooth + 10.0 * grain[..., None] / grain.std()
    yield "grained", np.clip(np.rint(grained), 0, 255).astype(np.uint8)


def synthetic() -> Iterator[Task]:
    """Photograph floors from many places, turned by up to 180 degrees."""
    rng = np.random.default_rng(3)
    places = ((20, 0.2, 0.1, 35), (90, 0.8, -0.8, 40), (180, 1.5, 0.0, 35), (-60, 0.3, 0.7, 45))
    for name, ground in floors(rng):
        scene = Scene(ground, extent=4.5)
        first, pose = view_at(scene, 0, 0, 0, 35, hint_deg=37, camera=CAMERA, noise=2.0, rng=rng)
        for yaw, x, y, tilt in places:
            other, other_pose = view_at(
                scene, x, y, yaw, tilt, hint_deg=tilt - 2, camera=CAMERA, noise=2.0, rng=rng
            )
            true = true_homography(pose, other_pose, CAMERA, CAMERA)
            points = common_ground(true, pose, CAMERA, CAMERA)
            yield Task(f"{name}, yaw {yaw}", first, other, points, apply(true, points))


def configured(path: Path) -> Iterator[Task]:
    """Take the pairs of a configuration."""
    config = load_config(path)
    dataset = open_dataset(config)
    nothing = np.empty((0, 2))
    for i, j in planned_pairs(config, dataset):
        yield Task(f"{i} {j}", dataset.view(i), dataset.view(j), nothing, nothing)


def cpu(function: Callable[[], object]) -> tuple[float, object]:
    """Run once; CPU seconds and the result."""
    start = time.process_time()
    result = function()
    return time.process_time() - start, result


def measure(task: Task) -> Iterator[tuple[str, float, float, Float | None]]:
    """Match by each method: its name, CPU seconds, those after the features, the homography."""
    a, b = task.view_i, task.view_j
    spent, found = cpu(lambda: raw_sift(a, b))
    yield "raw", spent, spent, found
    for method in MATCHERS:
        options = MatchOptions(features=method)
        first, features = cpu(lambda o=options: (extract(a, o), extract(b, o)))
        cached, match = cpu(
            lambda o=options, f=features: match_views(a, b, *f, o, np.random.default_rng(0))
        )
        found = match.homography if isinstance(match, PairMatch) else None
        yield method, first + cached, cached, found


def verdict(task: Task, homography: Float | None) -> str:
    """Say how far a homography is off."""
    if homography is None:
        return "rejected"
    if not len(task.points_i):
        return "matched"
    return f"{transfer_errors(homography, task.points_i, task.points_j).mean():.3f} px"


def main() -> None:
    """Print one line a pair and method, then the ratios."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("configs", nargs="*", type=Path, help="configurations to take pairs of")
    paths = parser.parse_args().configs
    cv2.setNumThreads(1)
    tasks = [task for path in paths for task in configured(path)] or list(synthetic())
    list(measure(tasks[0]))  # kernels are compiled or loaded
    total = dict.fromkeys(("raw", *MATCHERS, *(f"{m} cached" for m in MATCHERS)), 0.0)
    for task in tasks:
        for method, whole, cached, homography in measure(task):
            total[method] += whole
            if method in MATCHERS:
                total[f"{method} cached"] += cached
            print(f"{task.name:20s} {method:10s} {whole:.3f} s  {verdict(task, homography)}")  # noqa: T201
    for name, seconds in total.items():
        aim = f", {TARGETS[name]:.2f} wanted" if name in TARGETS else ""
        print(f"{name:18s} {seconds / total['raw']:.2f} of raw{aim}")  # noqa: T201


if __name__ == "__main__":
    main()
