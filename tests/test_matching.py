"""Matching two views of synthetic grounds whose homography is known."""

import pickle
from functools import cache

import numpy as np
import pytest

from gvpipe.core.features import MatchOptions
from gvpipe.core.homography import transfer_errors
from gvpipe.core.matching import EXTRACTORS, MATCHERS, extract, match_views
from gvpipe.core.types import Float, PairMatch, Pose, Rejected, View
from tests.synthetic import Scene, common_ground, texture, true_homography, view_at

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
