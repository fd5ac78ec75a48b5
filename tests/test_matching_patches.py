"""Patch alignment against shifts that are known exactly, and the verdict drawn from it."""

from dataclasses import replace

import numpy as np
import pytest

from gvpipe.core.geometry.ground import pixel_from_ground
from gvpipe.core.geometry.twoview import PairFit, PairPrior, two_views
from gvpipe.core.kernels.patches import BLANK, LEAVES, align_patches
from gvpipe.core.matching.features import MatchOptions
from gvpipe.core.matching.patches import Aligned, grey_pyramid
from gvpipe.core.matching.verdict import Evidence, objection, weigh
from gvpipe.core.types import Float
from tests.synthetic import CAMERA, Scene, texture, view_at

SHIFT = np.array([0.004, -0.003])  # metres: a bit more than a pixel


def aligned(gain: float = 1.0, noise: float = 0.0) -> tuple[Float, Float, Float, Float]:
    scene = Scene(texture(np.random.default_rng(3)))
    rng = np.random.default_rng(7)
    a, _ = view_at(scene, 0.0, 0.0, 0.0, 50.0)
    b, _ = view_at(scene, *SHIFT, 0.0, 50.0, gain=gain, noise=noise, rng=rng)
    x, y = np.meshgrid(np.linspace(0.25, 0.9, 14), np.linspace(-0.2, 0.2, 14))
    ground = np.column_stack([x.ravel(), y.ravel()])
    h = pixel_from_ground(CAMERA, a.mount)
    shift, correlation, covariance = align_patches(
        grey_pyramid(a.pixels), grey_pyramid(b.pixels), h, h, ground, 1.0, 4.0, 12
    )
    return ground, shift, correlation, covariance


@pytest.mark.parametrize("gain", [1.0, 0.6])
def test_finds_a_shift_of_the_ground(gain: float) -> None:
    _, shift, correlation, _ = aligned(gain)
    good = correlation > 0.9
    assert good.sum() > 100
    # the ground lies back and to the right of a robot that moved ahead and left
    np.testing.assert_allclose(np.median(shift[good], axis=0), -SHIFT, atol=1e-4)


def test_covariance_tells_the_scatter() -> None:
    _, shift, correlation, covariance = aligned(noise=6.0)
    good = correlation > 0.5
    off = shift[good] + SHIFT
    square = np.einsum("na,nab,nb->n", off, np.linalg.inv(covariance[good]), off)
    assert 0.3 < np.median(square) / 1.386 < 4.0  # the median of chi-square with two freedoms


def test_says_why_a_patch_cannot_be_aligned() -> None:
    grey = grey_pyramid(np.full((240, 320, 3), 90, np.uint8))
    mount = view_at(Scene(texture(np.random.default_rng(3))), 0, 0, 0, 50.0)[0].mount
    h = pixel_from_ground(CAMERA, mount)
    ground = np.array([[0.5, 0.0], [0.5, 9.0], [-5.0, 0.0]])
    _, correlation, _ = align_patches(grey, grey, h, h, ground, 1.0, 4.0, 12)
    assert correlation.tolist() == [BLANK, LEAVES, LEAVES]


def test_verdict_names_numbers_and_thresholds() -> None:
    options = MatchOptions()
    sound = Evidence(
        inliers=80,
        tested=200,
        log10_odds=60.0,
        uncertainty_px=0.1,
        drift=0.05,
        tilt_i=0.6,
        tilt_j=0.7,
    )
    assert objection(sound, options) is None
    assert sound.probability == pytest.approx(0.999)
    chance = replace(sound, inliers=6, log10_odds=-1.0)
    assert "6 of 200" in str(objection(chance, options))
    few = replace(sound, inliers=15, log10_odds=2.2)
    assert "odds of 160 to 1 against chance, 10000 to 1 needed" in str(objection(few, options))
    assert chance.probability < 1e-4
    steep = replace(sound, drift=0.5)
    assert "29 degrees" in str(objection(steep, options))
    assert "34 and 40 degrees" in str(objection(steep, options))
    loose = replace(sound, uncertainty_px=9.0)
    assert "9.0 px" in str(objection(loose, options))
    assert loose.probability < 0.2


def test_a_plane_far_from_the_configured_tilts_needs_more_patches() -> None:
    view, _ = view_at(Scene(texture(np.random.default_rng(3))), 0, 0, 0, 40)
    expected, prior = two_views(view, view), PairPrior(*np.radians([3.0, 3.0, 3.0]), 0.03)
    points, agrees = np.full((100, 2), 150.0), np.arange(100) < 16
    odds = []
    for off_deg in (0.0, 3.0, 12.0):
        turned = expected.parameters + np.radians(off_deg) * (np.arange(8) == 6)
        fit = PairFit(expected.with_parameters(turned), 0.0, np.eye(8))
        found = Aligned(fit, points, points, np.ones(100), np.zeros((100, 2, 2)), agrees)
        odds.append(weigh(found, np.zeros((9, 9)), expected, prior).log10_odds)
    np.testing.assert_allclose(odds[0] - np.array(odds), np.log10(np.exp([0.0, 0.5, 8.0])))
