"""A camera's intrinsics from photographs of the ground it is carried over."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from gvpipe.commands.photos import Photo, evenly, read_photo, shrink
from gvpipe.core.calibration.common_plane import ground_pairs
from gvpipe.core.calibration.raw_matching import PlanePair, match_planes, raw_features
from gvpipe.core.calibration.self_calibration import EXPECTED_FOCAL, SelfCalibration, self_calibrate
from gvpipe.core.matching.features import Features
from gvpipe.core.types import Camera, Rejected
from gvpipe.formats.calibration import Calibration
from gvpipe.report import Reporter, log

MOST_PICTURES = 24
"""Pictures used for self-calibration, evenly chosen."""

MOST_PAIRS = 110
"""Pairs of them that are matched: some ten seconds."""

NEAR = 3
"""Pictures at most this far apart in their order are matched first."""

WORKING_PIXELS = 1_000_000
"""Features are found on pictures of at most this size."""

LEAST_K2_GAIN = 2e-3
"""Distortion below this, as a share of the radius at the corner, is not written."""


@dataclass(frozen=True)
class GroundCalibration:
    """Outcome of self-calibration.

    Attributes
    ----------
    calibration : Calibration
        Intrinsics of the pictures.
    solution : SelfCalibration
        Focal length with its uncertainty; tilts, rolls and heights by number.
    photos : tuple of Photo
        The pictures by number.
    """

    calibration: Calibration
    solution: SelfCalibration
    photos: tuple[Photo, ...]


def from_ground(
    photos: Sequence[Photo],
    reporter: Reporter,
    *,
    jobs: int,
    focal_px: float | None = None,
    seed: int = 0,
) -> GroundCalibration | Rejected:
    """Self-calibrate from pictures of the ground.

    Parameters
    ----------
    photos : sequence of Photo
        Of one size, by one camera.
    reporter : Reporter
        Progress.
    jobs : int
        Threads; the result does not depend on them.
    focal_px : float, optional
        Where the search begins, for example by EXIF.
    seed : int
        For the choice of matches.

    Returns
    -------
    outcome : GroundCalibration or Rejected
    """
    chosen = evenly(photos, MOST_PICTURES)
    with (
        reporter.progress("features", len(chosen)) as ticker,
        ThreadPoolExecutor(max_workers=jobs) as pool,
    ):
        features: list[Features | Rejected] = []
        for found in pool.map(_features, chosen):
            features.append(found)
            ticker.advance()
    usable = [k for k, found in enumerate(features) if not isinstance(found, Rejected)]
    for photo, found in zip(chosen, features, strict=True):
        if isinstance(found, Rejected):
            log.warning("%s: %s", photo.name, found.reason)
    width, height = chosen[0].width, chosen[0].height
    couples = _couples(usable)
    scale = max(width, height) / 1000

    def match(couple: tuple[int, int]) -> list[PlanePair] | Rejected:
        first, second = features[couple[0]], features[couple[1]]
        assert isinstance(first, Features)
        assert isinstance(second, Features)
        return match_planes(*couple, first, second, scale)

    pairs: list[PlanePair] = []
    with (
        reporter.progress("planes", len(couples)) as ticker,
        ThreadPoolExecutor(max_workers=jobs) as pool,
    ):
        for planes in pool.map(match, couples):
            pairs += [] if isinstance(planes, Rejected) else planes
            ticker.advance()
    focal = focal_px or EXPECTED_FOCAL * width
    guess = Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    solution = self_calibrate(
        ground_pairs(pairs, guess),
        len(chosen),
        (width, height),
        np.random.default_rng(seed),
        expected_px=focal_px,
    )
    if isinstance(solution, Rejected):
        return solution
    return GroundCalibration(_calibration(solution, width, height), solution, tuple(chosen))


def _couples(pictures: Sequence[int]) -> list[tuple[int, int]]:
    """Choose pairs: all neighbours, and of the others as many as may be, evenly."""
    places = list(combinations(range(len(pictures)), 2))
    near = [(a, b) for a, b in places if b - a <= NEAR][:MOST_PAIRS]
    far = [(a, b) for a, b in places if b - a > NEAR]
    room = min(MOST_PAIRS - len(near), len(far))
    chosen = sorted({int(k) for k in np.linspace(0, len(far) - 1, room)}) if room > 0 else []
    return [(pictures[a], pictures[b]) for a, b in sorted(near + [far[k] for k in chosen])]


def _calibration(solution: SelfCalibration, width: int, height: int) -> Calibration:
    """Put a solution into a file's terms; distortion that moves nothing is left out."""
    f = solution.focal_px
    corner = float(np.hypot(width, height)) / 2 / f
    bend = abs(solution.k1) * corner**2 + abs(solution.k2) * corner**4
    lens = (solution.k1, solution.k2, 0.0, 0.0) if bend > LEAST_K2_GAIN else ()
    return Calibration(width, height, f, f, (width - 1) / 2, (height - 1) / 2, 0.0, lens)


def _features(photo: Photo) -> Features | Rejected:
    """Keypoints of a picture in pixels of its full size."""
    pixels = read_photo(photo)
    if isinstance(pixels, Rejected):
        return pixels
    smaller, scale = shrink(pixels, WORKING_PIXELS)
    found = raw_features(smaller)
    full = (found.pixels + 0.5) * scale - 0.5
    return replace(found, pixels=full, ground=full)
