"""Confidence of obstacles from silhouettes that are known to be right, wrong or missing."""

import numpy as np
import pytest

from gvpipe.core.reconstruct.agreement import agreement
from gvpipe.core.reconstruct.grid import VoxelGrid
from gvpipe.core.reconstruct.mesh import Mesh, surface
from tests.test_carving import CENTRE, RADIUS, ball_view

SHOTS = [ball_view(k * 2 * np.pi / 5) for k in range(5)]
VIEWS, MASKS = [v for v, _ in SHOTS], [m for _, m in SHOTS]


def ball(radius: float, shift: float = 0.0) -> Mesh:
    grid = VoxelGrid.over(np.array([-0.2, -0.2, 0.0]), np.array([0.2, 0.2, 0.3]), (80, 80, 60))
    distance = np.linalg.norm(grid.centres() - CENTRE - [shift, 0, 0], axis=-1)
    return surface((radius - distance).astype(np.float32), grid)


def test_the_true_shape_is_believed_and_wrong_ones_are_not() -> None:
    true, small, beside = (
        agreement([mesh], VIEWS, MASKS)[0].confidence
        for mesh in (ball(RADIUS), ball(0.6 * RADIUS), ball(RADIUS, 0.06))
    )
    assert true > 0.97
    # the surroundings reach a tenth of its size beyond the small ball's outline: 1 / 1.3
    assert 0.5 < small < 0.85
    assert 0.4 < beside < 0.85


def test_an_obstacle_that_no_view_shows_has_no_confidence() -> None:
    empty = [np.zeros_like(m) for m in MASKS]
    (found,) = agreement([ball(RADIUS)], VIEWS, empty)
    assert (found.confidence, found.views) == (0.0, 5)


def test_views_that_know_nothing_have_no_say() -> None:
    masks = [MASKS[0], *[np.full_like(m, np.nan) for m in MASKS[1:]]]
    (found,) = agreement([ball(RADIUS)], VIEWS, masks)
    assert found.views == 1
    assert found.confidence == pytest.approx(
        agreement([ball(RADIUS)], VIEWS[:1], MASKS[:1])[0].confidence
    )
    (nothing,) = agreement([ball(RADIUS)], VIEWS[1:], masks[1:])
    assert (nothing.confidence, nothing.views) == (0.0, 0)


def test_one_obstacle_does_not_answer_for_another() -> None:
    halves = [ball(RADIUS, -0.01), ball(RADIUS, 0.01)]
    both = agreement(halves, VIEWS, MASKS)
    assert min(a.confidence for a in both) > 0.85
    assert agreement([], VIEWS, MASKS) == []


def test_the_span_tells_views_on_one_side_from_views_all_round() -> None:
    ball_ = [ball(RADIUS)]
    (round_,) = agreement(ball_, VIEWS, MASKS)
    assert np.degrees(round_.azimuth_span) == pytest.approx(288, abs=1)
    for chosen, span in ((slice(0, 2), 72), (slice(0, 5, 4), 72), (slice(0, 1), 0)):
        (some,) = agreement(ball_, VIEWS[chosen], MASKS[chosen])
        assert np.degrees(some.azimuth_span) == pytest.approx(span, abs=1)
    (nothing,) = agreement(ball_, VIEWS[:1], [np.full_like(MASKS[0], np.nan)])
    assert nothing.azimuth_span == 0
