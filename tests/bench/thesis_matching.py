"""The matching experiments of the thesis' chapter 3, on photographs of made-up carpets.

Run ``python -m tests.bench.thesis_matching [FOLDER]`` from the repository: prints the tables of
``docs/experiments.md`` and writes its pictures, to ``docs/img`` by default. The carpets are seen as
the thesis' own: 640 x 480 pixels, focal length 699, tilts of 45 degrees, 78 cm above the ground,
turned by some 40 degrees against each other, obstacles in between.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gvpipe.core.geometry.homography import apply
from gvpipe.core.kernels.matching import segment_trial
from gvpipe.core.matching.features import Features, MatchOptions, overhead_scale
from gvpipe.core.matching.invariants import extract_invariants, invariant_overhead
from gvpipe.core.matching.isometry import corner_windows, distances
from gvpipe.core.types import Camera, Float, View
from tests.bench.charts import Curve, Panel, draw
from tests.synthetic import Box, Scene, texture, true_homography, view_at

CAMERA = Camera(width=640, height=480, fx=699.0, fy=699.0, cx=319.5, cy=239.5)
TILT_DEG, HEIGHT, YAW_DEG = 45.0, 0.78, 40.0
OPTIONS = MatchOptions(corners=225)
"""The thesis' thresholds; its pictures have 227 and 220 corners."""

SAME_PX = 3.0
"""A corner's counterpart lies this near to where the true homography puts it."""

TESTED = 70
"""Corners with known counterparts in an experiment (thesis 3.3.1)."""

TRIAL_SCENES = ((0, 10), (0, 20), (0, 30), (0, 40), (1, 40), (2, 30), (2, 40), (3, 40), (4, 40))
"""Obstacles and degrees of turn; the more of them, the smaller a."""

GREY = np.array([0.299, 0.587, 0.114])

PUBLISHED = np.array(
    [
        (12, 116, 32, 19, 2),
        (23, 57, 86, 62, 7),
        (30, 117, 53, 109, 12),
        (40, 112, 58, 151, 11),
        (55, 48, 116, 196, 8),
        (68, 112, 32, 263, 9),
        (75, 116, 48, 393, 14),
        (80, 81, 64, 350, 23),
        (134, 116, 50, 1193, 113),
        (172, 104, 66, 1741, 205),
    ],
    dtype=np.float64,
)
"""Table 3.1: length of the segment, n_p, n_q, segments of that length, of these alike."""

PUBLISHED_TRIALS = (227 / 110, 5.0)
"""Section 3.5.2: 1/a, and iterations that it took on average."""


@dataclass(frozen=True)
class Pair:
    """Two views of a carpet with the truth about their corners.

    Attributes
    ----------
    features : (Features, Features)
    distance, within : (N, M), (N, N) float64
        Distances of the invariant vectors between the views and inside the first.
    counterpart : (N,) int64
        Corner of the second view that is the same spot of the carpet, or -1.
    greys, rasters : pair of (h, w) uint8, pair of (3, 3) float64
        Overhead views and their pixels from ground metres.
    motion : (3,) float64
        Yaw, x, y of the first robot in the frame of the second.
    """

    features: tuple[Features, Features]
    distance: Float
    within: Float
    counterpart: NDArray[np.int64]
    greys: tuple[NDArray[np.uint8], NDArray[np.uint8]]
    rasters: tuple[Float, Float]
    motion: Float

    @property
    def common(self) -> float:
        """Share of the first view's corners that the second has too: a of the thesis."""
        return float((self.counterpart >= 0).mean())


def carpet_pair(seed: int, obstacles: int, yaw_deg: float = YAW_DEG) -> Pair:
    """Photograph a carpet with boxes on it from two places, the same spot in both centres."""
    rng = np.random.default_rng(seed)
    boxes = []
    for _ in range(obstacles):
        (x, y), side = rng.uniform((0.5, -0.4), (1.2, 0.4)), rng.uniform(0.06, 0.16)
        boxes.append(Box((x, y, 0.0), (x + side, y + side, 0.8 * side), texture(rng, 256)))
    scene = Scene(texture(rng, 1024), extent=2.6, boxes=tuple(boxes))
    away, yaw = HEIGHT / np.tan(np.radians(TILT_DEG)), np.radians(yaw_deg)
    x, y = away * (1.0 - np.cos(yaw)), -away * np.sin(yaw)
    (view_i, pose_i), (view_j, pose_j) = (
        view_at(scene, *place, TILT_DEG, HEIGHT, camera=CAMERA, noise=2.0, rng=rng, samples=2)
        for place in ((0.0, 0.0, 0.0), (x, y, yaw_deg))
    )
    c, s = np.cos(yaw), np.sin(yaw)
    motion = np.array([-yaw, -c * x - s * y, s * x - c * y])
    return _pair(view_i, view_j, true_homography(pose_i, pose_j, CAMERA, CAMERA), motion)


def _pair(view_i: View, view_j: View, true: Float, motion: Float) -> Pair:
    """Find the corners, describe them and look up which are the same."""
    scale = overhead_scale(view_i.camera, view_i.mount)
    features = extract_invariants(view_i, OPTIONS), extract_invariants(view_j, OPTIONS)
    vectors_i, vectors_j = (np.asarray(f.descriptors, dtype=np.float64) for f in features)
    away = distances(apply(true, features[0].pixels), features[1].pixels)
    nearest = away.argmin(axis=1)
    overheads = [invariant_overhead(v, scale, OPTIONS.max_range) for v in (view_i, view_j)]
    grey_i, grey_j = (cv2.cvtColor(o, cv2.COLOR_RGB2GRAY).astype(np.uint8) for o, _ in overheads)
    raster_i, raster_j = (grid.overhead_from_ground for _, grid in overheads)
    return Pair(
        features=features,
        distance=distances(vectors_i, vectors_j),
        within=distances(vectors_i, vectors_i),
        counterpart=np.where(away.min(axis=1) < SAME_PX, nearest, -1),
        greys=(grey_i, grey_j),
        rasters=(raster_i, raster_j),
        motion=motion,
    )


def candidates(pairs: list[Pair], thresholds: Float) -> dict[str, tuple[Float, Float]]:
    """N_av and N_match of each invariant at each threshold, means over pairs (fig. 3.6)."""
    takes = {
        "grey": lambda v: v[:, :3] @ GREY[:, None],
        "colour": lambda v: v[:, :3],
        "colour and gradients": lambda v: v,
    }
    found = {}
    for name, take in takes.items():
        average, matched = np.zeros(len(thresholds)), np.zeros(len(thresholds))
        for pair in pairs:
            tested = np.flatnonzero(pair.counterpart >= 0)[:TESTED]
            vectors_i, vectors_j = (take(np.asarray(f.descriptors)) for f in pair.features)
            away = distances(vectors_i[tested], vectors_j)
            own = away[np.arange(len(tested)), pair.counterpart[tested]]
            average += (away[..., None] < thresholds).sum(axis=1).mean(axis=0)
            matched += (own[:, None] < thresholds).sum(axis=0)
        found[name] = average / len(pairs), matched / len(pairs)
    return found


def draw_segment(pair: Pair, rng: np.random.Generator) -> tuple[int, int] | None:
    """Draw two corners that look unlike, as the matcher does (thesis 3.5, step 1)."""
    p = int(rng.integers(len(pair.within)))
    unlike = np.flatnonzero(pair.within[p] > 2 * OPTIONS.min_colour)
    return (p, int(unlike[rng.integers(len(unlike))])) if len(unlike) else None


def try_segment(pair: Pair, p: int, q: int) -> tuple[Float, NDArray[np.int64]]:
    """Compare a segment with all of the second view: the best isometry and the counts."""
    (grey_i, grey_j), (raster_i, raster_j) = pair.greys, pair.rasters
    ground_i, ground_j = (f.ground for f in pair.features)
    near_j = corner_windows(apply(raster_j, ground_j), grey_j.shape, OPTIONS.window_px)
    gates = OPTIONS.min_colour, OPTIONS.max_stretch, OPTIONS.min_correlation
    rasters = grey_i, raster_i, grey_j, raster_j, near_j
    return segment_trial(p, q, ground_i, ground_j, pair.distance, *rasters, *gates)


def segment_counts(pairs: list[Pair], draws: int) -> Float:
    """Rows as of Table 3.1 for segments of about its lengths, means over draws and pairs."""
    rng = np.random.default_rng(1)
    rows: list[list[tuple[float, ...]]] = [[] for _ in PUBLISHED]
    for pair in pairs:
        like = pair.distance < OPTIONS.min_colour
        pixels = apply(pair.rasters[0], pair.features[0].ground)
        for _ in range(draws):
            segment = draw_segment(pair, rng)
            if segment is None:
                continue
            p, q = segment
            length = float(np.hypot(*(pixels[p] - pixels[q])))
            k = int(np.abs(np.log(PUBLISHED[:, 0] / length)).argmin())
            if abs(np.log(PUBLISHED[k, 0] / length)) > 0.1 or len(rows[k]) >= draws // 4:
                continue
            _, (segments, alike) = try_segment(pair, p, q)
            rows[k].append((length, like[p].sum(), like[q].sum(), segments, alike))
    return np.array([np.mean(row, axis=0) for row in rows if row])


def trials(pair: Pair, draws: int) -> tuple[float, float, float]:
    """1/a^2; mean draws until both corners are common; until the isometry is right (3.5.2)."""
    rng = np.random.default_rng(2)
    drawn = common = right = 0
    for _ in range(draws):
        segment = draw_segment(pair, rng)
        if segment is None:
            continue
        drawn += 1
        common += int((pair.counterpart[list(segment)] >= 0).all())
        (support, yaw, x, y), _ = try_segment(pair, *segment)
        off = np.abs(np.array([yaw, x, y]) - pair.motion)
        right += int(support > 0 and (off < (np.radians(3.0), 0.03, 0.03)).all())
    return 1.0 / pair.common**2, drawn / max(common, 1), drawn / max(right, 1)


def candidate_panels(found: dict[str, tuple[Float, Float]], thresholds: Float) -> Iterator[Panel]:
    """Panels as of fig. 3.6, and one that does without thresholds."""
    for k, (name, (average, matched)) in enumerate(found.items()):
        curves = [
            Curve(f"N_match, of {TESTED}", thresholds, matched, k),
            Curve("N_av, candidates", thresholds, average, k, "pale"),
        ]
        high = (0.0, float(thresholds[-1]))
        yield Panel(name, "threshold, grey levels", high, (0, 120), curves)
    curves = [Curve(name, *found[name], k) for k, name in enumerate(found)]
    yield Panel("N_match over N_av", "N_av", (0, 120), (0, TESTED), curves, low_legend=True)


def segment_panel(rows: Float) -> Panel:
    """Share of the corner pairs that have the segment's length."""
    share, published = (r[:, 3] / np.maximum(r[:, 1] * r[:, 2], 1) for r in (rows, PUBLISHED))
    curves = [
        Curve("these carpets", rows[share > 0, 0], share[share > 0], 0),
        Curve("thesis, Table 3.1", PUBLISHED[:, 0], published, 1, "dots"),
    ]
    title = "Equal segments / (n_p n_q)"
    return Panel(title, "|pq|, pixels", (10, 300), (0.001, 1), curves, log=True, low_legend=True)


def trials_panel(rows: list[tuple[float, float, float]]) -> Panel:
    """Trials over 1/a^2."""
    x, common, right = np.array(rows).T
    line = np.array([1.0, 100.0])
    published = np.array([PUBLISHED_TRIALS[0] ** 2]), np.array([PUBLISHED_TRIALS[1]])
    curves = [
        Curve("1/a²", line, line, 5, "pale"),
        Curve("until both corners are common", x, common, 0, "dots"),
        Curve("until the isometry is right", x, right, 2, "dots"),
        Curve("thesis, 3.5.2", *published, 1, "dots"),
    ]
    return Panel("Trials", "1/a²", (1, 100), (1, 100), curves, log=True)


def main() -> None:
    """Run the three experiments."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default=Path("docs/img"))
    folder: Path = parser.parse_args().folder
    say = print
    pairs = [carpet_pair(seed, obstacles=2) for seed in range(4)]
    for pair in pairs:
        n, m = (len(f.pixels) for f in pair.features)
        say(f"{n} and {m} corners, {(pair.counterpart >= 0).sum()} common: a = {pair.common:.3f}")

    thresholds = np.linspace(0.0, 100.0, 51)
    found = candidates(pairs, thresholds)
    say("\ninvariant | N_av at N_match 35 | at 50 | at 60")
    say("--- | --- | --- | ---")
    for name, (average, matched) in found.items():
        cells = [f"{np.interp(n, matched, average):.0f}" for n in (35, 50, 60)]
        say(" | ".join([name, *cells]))
    panels = list(candidate_panels(found, thresholds))
    (folder / "candidates.svg").write_text(draw("Candidates of three invariants", panels))

    rows = segment_counts(pairs, draws=2000)
    say("\n|pq| | n_p | n_q | segments | alike | thesis: segments | alike")
    say("--- | --- | --- | --- | --- | --- | ---")
    for ours, theirs in zip(rows, PUBLISHED, strict=True):
        say(" | ".join(f"{v:.0f}" for v in (*ours, *theirs[3:])))

    obstacles = [(seed, n, yaw) for seed, (n, yaw) in enumerate(TRIAL_SCENES)]
    waits = [trials(carpet_pair(100 + seed, n, yaw), draws=300) for seed, n, yaw in obstacles]
    say("\n1/a² | until both corners are common | until the isometry is right")
    say("--- | --- | ---")
    for row in sorted(waits):
        say(" | ".join(f"{v:.1f}" for v in row))
    panels = [segment_panel(rows), trials_panel(waits)]
    (folder / "segments.svg").write_text(draw("Segments and trials", panels))


if __name__ == "__main__":
    main()
