"""How far the matcher's probability can be trusted: predicted against observed.

Run ``python -m tests.bench.match_reliability [--floors N] [--picture SVG]`` from the repository.
Pairs of small photographs of a synthetic floor with crates, chosen to be hard: little or no common
ground, tilts told wrongly by up to 8 degrees, rolls of up to 10 that are not told, dim and noisy
light. Each pair's best homography, accepted or not, is compared with the truth.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations, pairwise, product
from pathlib import Path

import numpy as np

from gvpipe.core.geometry.ground import pixel_from_plane
from gvpipe.core.geometry.homography import apply, transfer_errors
from gvpipe.core.matching.features import Features, MatchOptions
from gvpipe.core.matching.matchers import extract, match_views
from gvpipe.core.matching.patches import MAX_RANGE
from gvpipe.core.matching.verdict import WRONG_PX
from gvpipe.core.types import Float, PairMatch, Pose, View
from tests.bench.charts import Curve, Panel, draw
from tests.synthetic import (
    CAMERA,
    Box,
    Scene,
    common_ground,
    texture,
    true_homography,
    view_at,
)

Truth = tuple[Float, Float]
"""Pixels of i that show common ground, (N, 2), and where they are in j."""

Shot = tuple[View, Features]

FEWEST_PIXELS = 6  # of every eighth: with less common ground there is no truth to speak of
LENIENT = MatchOptions(min_log10_odds=-np.inf, max_uncertainty_px=np.inf)
"""Accepts whatever is found, so that it can be compared with the truth."""

BOUNDS = (0.0, 0.01, 0.1, 0.5, 0.9, 0.99, 1.0)


@dataclass(frozen=True)
class Outcome:
    """What became of a pair.

    Attributes
    ----------
    probability : float
        Predicted for the best homography; 0 if none was found.
    right : bool
        Whether it is within three pixels of the truth, mean over the common ground.
    accepted : bool
        By the default thresholds.
    """

    probability: float
    right: bool
    accepted: bool


def shoot(
    scene: Scene, x: float, y: float, yaw: float, rng: np.random.Generator
) -> tuple[View, Pose]:
    """Photograph with everything a little wrong that may be."""
    tilt, off, roll = rng.uniform(28, 55), rng.uniform(-8, 8), rng.uniform(-10, 10)
    light = {
        "gain": rng.uniform(0.5, 1.2),
        "noise": rng.uniform(1.0, 6.0),
        "rng": rng,
        "samples": 2,
    }
    return view_at(scene, x, y, yaw, tilt, roll_deg=roll, hint_deg=tilt + off, **light)


def hard_pairs(rng: np.random.Generator) -> Iterator[tuple[Shot, Shot, list[Truth]]]:
    """Pairs of views around one floor with their features, and what is true of them."""
    scene = Scene(texture(rng, 1024), boxes=tuple(crates(rng)))
    shots = []
    for _ in range(9):
        view, pose = shoot(scene, *rng.uniform(-1.3, 1.3, 2), rng.uniform(-180, 180), rng)
        shots.append(((view, extract(view, LENIENT)), pose))
    for (first, pose_i), (second, pose_j) in combinations(shots, 2):
        yield first, second, list(truths(pose_i, pose_j, scene.extent))


def truths(pose_i: Pose, pose_j: Pose, extent: float) -> Iterator[Truth]:
    """Where pixels of i are in j: in more than one place if the floor repeats far away."""
    ground_from_i = np.linalg.inv(pixel_from_plane(CAMERA, pose_i))
    for x, y in product((-extent, 0.0, extent), repeat=2):
        moved = replace(pose_j, translation=pose_j.translation + np.array([x, y, 0.0]))
        true = true_homography(pose_i, moved, CAMERA, CAMERA)
        points = common_ground(true, pose_i, CAMERA, CAMERA)
        ground = apply(ground_from_i, points)
        away = [
            np.hypot(*(ground - p.translation[:2]).T) / p.translation[2] for p in (pose_i, moved)
        ]
        points = points[sum(away) < 2 * MAX_RANGE]
        if len(points) >= FEWEST_PIXELS:
            yield points, apply(true, points)


def judge(first: Shot, second: Shot, known: list[Truth]) -> Outcome:
    """Match a pair and compare with the truth."""
    verdict, found = (
        match_views(first[0], second[0], first[1], second[1], options, np.random.default_rng(0))
        for options in (MatchOptions(), LENIENT)
    )
    accepted = isinstance(verdict, PairMatch)
    if not isinstance(found, PairMatch):
        return Outcome(found.probability, False, accepted)
    off = [transfer_errors(found.homography, *truth).mean() for truth in known]
    return Outcome(found.probability, min(off, default=np.inf) < WRONG_PX, accepted)


def outcomes(floors: int) -> Iterator[Outcome]:
    """Judge the pairs of many floors."""
    rng = np.random.default_rng(11)
    for _ in range(floors):
        for pair in hard_pairs(rng):
            yield judge(*pair)


def crates(rng: np.random.Generator) -> Iterator[Box]:
    """Stand some crates around."""
    faces = texture(rng, 512)
    for _ in range(6):
        x, y = rng.uniform(-1.5, 1.5, 2)
        side, height = rng.uniform(0.1, 0.4), rng.uniform(0.1, 0.3)
        yield Box((x, y, 0.0), (x + side, y + side, height), faces)


def main() -> None:
    """Print a Markdown table and draw it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--floors", type=int, default=25, help="36 pairs each")
    parser.add_argument("--picture", type=Path, help="SVG to write")
    arguments = parser.parse_args()
    found = list(outcomes(arguments.floors))
    print("predicted | pairs | mean prediction | right | accepted, of these wrong")  # noqa: T201
    print("--- | --- | --- | --- | ---")  # noqa: T201
    shown = []
    for low, high in pairwise(BOUNDS):
        bin_ = [o for o in found if low <= o.probability < high or o.probability == high == 1.0]
        if not bin_:
            continue
        predicted = float(np.mean([o.probability for o in bin_]))
        right = float(np.mean([o.right for o in bin_]))
        shown.append((predicted, right))
        accepted = [o for o in bin_ if o.accepted]
        wrong = sum(not o.right for o in accepted)
        print(  # noqa: T201
            f"{low:g} to {high:g} | {len(bin_)} | {predicted:.3f} | {right:.3f} | "
            f"{len(accepted)}, {wrong}"
        )
    if arguments.picture:
        x, y = np.array(shown).T
        ideal = Curve("as predicted", np.array([0.0, 1.0]), np.array([0.0, 1.0]), 1, "pale")
        seen = Curve("observed", x, y, 0, "dots")
        panel = Panel("Share that is right", "predicted probability", (0, 1), (0, 1), [ideal, seen])
        arguments.picture.write_text(draw("Reliability of the probability of a match", [panel]))


if __name__ == "__main__":
    main()
