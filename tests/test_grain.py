"""The ground's texture is missed where it is not, and only where it could be seen."""

import numpy as np
import pytest

from gvpipe.core.reconstruct.grain import GrainNoise, grain, learn_grain_noise, missing
from tests.synthetic import texture

SIDE = 11
ODDS = 8.0
WHOLE = np.ones((120, 160), bool)
HIDDEN = np.s_[40:80, 60:110]
WITHIN = np.s_[50:70, 70:100]


def scene(contrast, gain=1.0, offset=0.0, noise=1.0):
    """Ground seen by others, and a picture of it with a plain obstacle of its mean colour."""
    rng = np.random.default_rng(4)
    pattern = texture(rng, 160)[:120].astype(np.float64)
    ground = 120.0 + contrast * (pattern - pattern.mean()) / pattern.std()
    picture = gain * ground + offset
    picture[HIDDEN] = picture.mean(axis=(0, 1))
    picture = np.clip(picture + noise * rng.normal(size=picture.shape), 0, 255)
    return picture.round().astype(np.uint8), ground.astype(np.float32)


def lacking(picture, ground, weight=None):
    weight = np.ones(WHOLE.shape, np.float32) if weight is None else weight
    g = grain(picture, ground, weight, SIDE)
    return missing(g, learn_grain_noise([(g, WHOLE)]), ODDS)


@pytest.mark.parametrize("contrast", [5.0, 15.0])
def test_a_plain_area_of_the_grounds_colour_lacks_its_texture(contrast):
    lacks = lacking(*scene(contrast))
    assert (lacks[WITHIN] > ODDS).mean() > 0.9
    bare = lacks.copy()
    bare[20:100, 40:130] = 0  # windows of the outline see both
    assert not bare.any()


def test_a_gap_in_the_texture_of_the_ground_is_closed_and_its_outline_kept():
    picture, ground = scene(15.0)
    plain = np.s_[50:70, 82:86]
    ground[plain] = ground.mean(axis=(0, 1))
    lacks = lacking(picture, ground) > ODDS
    assert lacks[plain].mean() > 0.9
    # less than half a window beyond it, where windows show more of the obstacle than of ground
    beyond = lacks.copy()
    beyond[40 - SIDE // 2 : 80 + SIDE // 2, 60 - SIDE // 2 : 110 + SIDE // 2] = False
    assert not beyond.any()


def test_light_does_not_take_the_texture_away():
    lacks = lacking(*scene(10.0, gain=0.8, offset=15.0))
    lacks[20:100, 40:130] = 0
    assert not lacks.any()


def test_a_floor_without_texture_has_none_to_lack():
    assert not lacking(*scene(0.3)).any()


def test_unknown_ground_is_not_asked():
    weight = np.ones(WHOLE.shape, np.float32)
    weight[30:90, 50:120] = 0
    assert not lacking(*scene(10.0), weight)[WITHIN].any()


def test_what_lacks_on_the_ground_itself_is_learnt():
    quiet, loud = (
        learn_grain_noise(
            [(grain(*scene(8.0, noise=n), np.ones(WHOLE.shape, np.float32), SIDE), WHOLE)]
        )
        for n in (1.0, 12.0)
    )
    assert loud.other > 10.0 * quiet.other
    g = grain(*scene(8.0), np.ones(WHOLE.shape, np.float32), SIDE)
    assert learn_grain_noise([(g, ~WHOLE)]) == GrainNoise(0.0, 1.0, 0.0)
