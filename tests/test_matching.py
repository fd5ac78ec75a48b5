"""Matching two views of synthetic grounds whose homography is known."""

import pickle
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from gvpipe.core.geometry.homography import transfer_errors
from gvpipe.core.matching.features import MatchOptions
from gvpipe.core.matching.matchers import EXTRACTORS, MATCHERS, extract, match_views
from gvpipe.core.matching.rivals import distinctness
from gvpipe.core.types import Camera, Float, PairMatch, Pose, Rejected, View
from tests.synthetic import Box, Scene, common_ground, texture, tiles, true_homography, view_at

Shot = tuple[View, Pose]


@cache
def floor() -> Scene:
    return Scene(texture(np.random.default_rng(3)))


def match(a: Shot, b: Shot, features: str) -> PairMatch | Rejected:
    options = MatchOptions(features=features)
    return match_views(
        a[0],
        b[0],
        extract(a[0], options),
        extract(b[0], options),
        options,
        np.random.default_rng(0),
    )


def mean_error(found: PairMatch | Rejected, a: Shot, b: Shot) -> float:
    assert isinstance(found, PairMatch), found
    true = true_homography(a[1], b[1], a[0].camera, b[0].camera)
    points: Float = common_ground(true, a[1], a[0].camera, b[0].camera)
    assert len(points) > 30
    one = np.column_stack([points, np.ones(len(points))]) @ true.T
    return float(transfer_errors(found.homography, points, one[:, :2] / one[:, 2:]).mean())


def test_every_method_has_its_features() -> None:
    assert set(EXTRACTORS) == set(MATCHERS)


@pytest.mark.parametrize("features", sorted(MATCHERS))
def test_finds_the_homography_of_a_moderate_motion(features: str) -> None:
    a = view_at(floor(), 0.0, 0.0, 0.0, 45.0, hint_deg=44.0)
    b = view_at(floor(), 0.15, -0.1, 25.0, 44.0, hint_deg=45.0)
    found = match(a, b, features)
    assert mean_error(found, a, b) < 0.5
    assert isinstance(found, PairMatch)
    assert found.tilt_i == pytest.approx(np.radians(45.0), abs=np.radians(0.5))
    assert found.tilt_j == pytest.approx(np.radians(44.0), abs=np.radians(0.5))


LARGE = Camera(width=400, height=300, fx=500.0, fy=500.0, cx=199.5, cy=149.5)

HARD: dict[str, Callable[[Scene], tuple[Shot, Shot]]] = {
    "tilts told 8 degrees too low": lambda s: (
        view_at(s, 0, 0, 0, 40, hint_deg=32),
        view_at(s, 0.3, 0.2, 40, 42, hint_deg=34),
    ),
    "tilts told 8 degrees too high": lambda s: (
        view_at(s, 0, 0, 0, 40, hint_deg=48),
        view_at(s, 0.3, 0.2, 40, 42, hint_deg=50),
    ),
    "rolls nobody told": lambda s: (
        view_at(s, 0, 0, 0, 40, roll_deg=10),
        view_at(s, 0.3, 0.2, 40, 42, roll_deg=-8),
    ),
    "twice the height": lambda s: (
        view_at(s, 0, 0, 0, 40, height=0.4),
        view_at(s, -0.3, -0.2, -30, 42, height=0.8),
    ),
    "facing each other": lambda s: (
        view_at(s, 0, 0, 0, 40),
        view_at(s, 1.6, 0.2, 180, 42),
    ),
    "horizon in view": lambda s: (
        view_at(s, 0, 0, 0, 20),
        view_at(s, 0.3, 0.3, 20, 20),
    ),
    "two cameras": lambda s: (
        view_at(s, 0, 0, 0, 40),
        view_at(s, 0.1, -0.1, 20, 42, camera=LARGE),
    ),
    "half the light and noise": lambda s: (
        view_at(s, 0, 0, 0, 40),
        view_at(s, 0.1, -0.1, 20, 42, gain=0.5, noise=4.0, rng=np.random.default_rng(0)),
    ),
}


@pytest.mark.parametrize("case", sorted(HARD))
def test_default_survives(case: str) -> None:
    a, b = HARD[case](floor())
    found = match(a, b, "sift")
    assert mean_error(found, a, b) < 0.1
    assert isinstance(found, PairMatch)
    assert found.error_px < 0.5
    assert found.probability > 0.99


@pytest.mark.parametrize("tilt_deg", [22.0, 45.0, 70.0])
def test_default_finds_an_unknown_tilt(tilt_deg: float) -> None:
    a, b = (
        (replace(v, mount=replace(v.mount, tilt=np.radians(45.0), tilt_known=False)), pose)
        for v, pose in (
            view_at(floor(), 0, 0, 0, tilt_deg),
            view_at(floor(), 0.15, 0.1, 30, tilt_deg + 3.0),
        )
    )
    found = match(a, b, "sift")
    assert mean_error(found, a, b) < 0.1
    assert isinstance(found, PairMatch)
    assert np.degrees(found.tilt_i) == pytest.approx(tilt_deg, abs=0.1)


def test_default_prefers_the_ground_to_crates_and_to_their_lids() -> None:
    rng = np.random.default_rng(10)
    crates = [
        Box((x, y, 0.0), (x + 0.3, y + 0.3, 0.25), texture(rng, 512))
        for x, y in ((0.5, -0.35), (0.9, 0.1), (1.3, -0.3))
    ]
    scene = Scene(floor().ground, boxes=tuple(crates))
    a, b = view_at(scene, 0, 0, 0, 40), view_at(scene, 0.1, 0.3, -20, 40)
    assert mean_error(match(a, b, "sift"), a, b) < 0.3
    stage = Box((0.45, -0.45, 0.0), (1.2, 0.3, 0.2), texture(rng, 1024))
    scene = Scene(floor().ground, boxes=(stage,))
    a, b = view_at(scene, 0, 0, 0, 40), view_at(scene, 0.0, 0.35, -20, 40)
    assert mean_error(match(a, b, "sift"), a, b) < 0.3


def test_default_reports_tiles_that_are_all_alike() -> None:
    scene = Scene(tiles(np.random.default_rng(5)))
    found = match(view_at(scene, 0, 0, 0, 40), view_at(scene, 0.5, 0.5, 30, 40), "sift")
    assert isinstance(found, Rejected)
    assert "repeats every 0.3" in found.reason  # 6 m / 16 tiles


def test_default_states_the_error_of_its_homography() -> None:
    a, b = view_at(floor(), 0, 0, 0, 40), view_at(floor(), 0.2, 0.1, 20, 42)
    found = match(a, b, "sift")
    assert isinstance(found, PairMatch)
    assert found.covariance is not None
    assert found.covariance.shape == (9, 9)
    true = true_homography(a[1], b[1], a[0].camera, b[0].camera)
    off = (found.homography - true).ravel()[:8]
    sigma = np.sqrt(np.diag(found.covariance)[:8])
    assert (np.abs(off) < 6 * sigma).all()
    assert np.median(sigma / np.abs(true.ravel()[:8])) < 0.01


def test_featureless_views_are_rejected_in_words() -> None:
    a, b = view_at(floor(), 0, 0, 0, 40), view_at(floor(), 0.2, 0.1, 20, 42)
    for features in MATCHERS:
        plain = replace(b[0], pixels=np.full_like(b[0].pixels, 128)), b[1]
        found = match(a, plain, features)
        assert isinstance(found, Rejected)
        assert any(c.isdigit() for c in found.reason)


@pytest.mark.parametrize("features", sorted(MATCHERS))
def test_same_seed_same_answer(features: str) -> None:
    a = view_at(floor(), 0.0, 0.0, 0.0, 45.0)
    b = view_at(floor(), 0.1, 0.1, -20.0, 45.0)
    first, second = match(a, b, features), match(a, b, features)
    assert pickle.dumps(first) == pickle.dumps(second)


@pytest.mark.parametrize("features", sorted(MATCHERS))
def test_rejects_views_that_share_no_ground(features: str) -> None:
    a = view_at(floor(), 0.0, 0.0, 0.0, 45.0)
    b = view_at(floor(), -1.0, 0.0, 180.0, 45.0)
    found = match(a, b, features)
    assert isinstance(found, Rejected)
    assert any(c.isdigit() for c in found.reason)


@pytest.mark.parametrize("features", sorted(MATCHERS))
def test_features_are_small_and_travel_between_processes(features: str) -> None:
    view, _ = view_at(floor(), 0.0, 0.0, 0.0, 45.0)
    stored = pickle.dumps(extract(view, MatchOptions(features=features)))
    assert len(stored) < 2_000_000
    assert len(pickle.loads(stored).pixels) > 50


def test_default_tells_tiles_apart_by_stains() -> None:
    # the same tiles as above: only stains, fainter than their print, say where one is
    rng = np.random.default_rng(5)
    ground = tiles(rng).astype(np.float64)
    size = ground.shape[0]
    stains = cv2.resize(rng.normal(0.0, 30.0, (size // 16, size // 16)), (size, size))
    scene = Scene(np.clip(ground + stains[..., None], 0, 255).astype(np.uint8))
    a, b = view_at(scene, 0, 0, 0, 40), view_at(scene, 0.15, 0.1, 10, 40)
    found = match(a, b, "sift")
    assert isinstance(found, PairMatch)
    assert mean_error(found, a, b) < 0.3
    apart = match(a, view_at(scene, -2.0, 1.6, 0, 40), "sift")
    assert isinstance(apart, Rejected)


def test_distinctness_is_zero_by_chance_and_one_where_all_patches_tell() -> None:
    rng = np.random.default_rng(6)
    alike = rng.uniform(0.2, 0.9, (4, 4000))
    assert abs(distinctness(alike[0], alike[1:])) < 0.05
    assert distinctness(np.full(50, 0.95), np.full((3, 50), 0.8)) == pytest.approx(1.0)
    assert distinctness(np.full(50, 0.95), np.full((3, 50), 0.94)) < 0.0  # optics do as much
    assert distinctness(np.full(50, -2.0), np.full((3, 50), 0.8)) == 0.0
