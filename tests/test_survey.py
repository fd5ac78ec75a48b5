"""The survey: exposure, vignetting and obstacles of known views of a painted floor."""

import numpy as np
import pytest

from gvpipe.core.geometry.ground import pixel_from_plane
from gvpipe.core.geometry.homography import apply
from gvpipe.core.geometry.pose import planar_pose
from gvpipe.core.kernels.survey import likeness, successive, vote
from gvpipe.core.mosaic.blend import BLENDS
from gvpipe.core.mosaic.compose import compose
from gvpipe.core.mosaic.exposure import Spots, balance
from gvpipe.core.mosaic.raster import Picture, plan_raster
from gvpipe.core.mosaic.survey import survey
from gvpipe.core.types import Camera, Mount, Pose, PosedView

CAMERA = Camera(200, 150, 170.0, 165.0, 98.0, 76.0)
RESOLUTION = 0.01
POST = (0.0, 0.0, 0.08, 0.35)  # x, y, half side, height
FALLOFF = -0.15


def floor(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Colours of the ground: grey-green waves, nothing red."""
    waves = [np.sin(3 * x + y), np.cos(2 * y - x), np.sin(2 * x - 3 * y + 1)]
    return np.stack([90 + 15 * waves[0], 120 + 30 * waves[1], 100 + 20 * waves[2]], axis=-1)


def gravel(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Grey ground with a grain of some centimetres, no colour of its own."""
    grain = np.sin(61 * x + 23 * y) + np.sin(17 * x - 57 * y) + np.sin(43 * x + 41 * y)
    return np.repeat((110 + 25 * grain)[:, None], 3, axis=1)


def picture(
    pose: Pose,
    gain: float,
    falloff: float,
    post: bool,
    ground_colours=floor,
    post_colour=(200, 20, 20),
    post_at=POST,
) -> np.ndarray:
    """Floor, and a post that hides what is behind it; exposure and vignetting applied."""
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    pixels = np.column_stack([u.ravel(), v.ravel()]).astype(float)
    ground = apply(np.linalg.inv(pixel_from_plane(CAMERA, pose)), pixels)
    colours = ground_colours(ground[:, 0], ground[:, 1])
    if post:
        x, y, side, height = post_at
        centre = pose.translation
        # fractions of the sight line between which it is inside the post's walls and below its top
        delta = ground - centre[:2]
        with np.errstate(divide="ignore"):
            low = (np.array([x, y]) - side - centre[:2]) / delta
            high = (np.array([x, y]) + side - centre[:2]) / delta
        enter = np.minimum(low, high).max(axis=1)
        leave = np.minimum(np.maximum(low, high).min(axis=1), 1.0)
        below = 1.0 - height / centre[2]
        colours[np.maximum(enter, below) < leave] = post_colour
    r2 = ((pixels - (CAMERA.cx, CAMERA.cy)) ** 2).sum(axis=1) / (CAMERA.width / 2) ** 2
    lit = colours * np.exp(gain + falloff * r2)[:, None]
    return np.rint(lit).clip(0, 255).astype(np.uint8).reshape(CAMERA.height, CAMERA.width, 3)


def ring(gains, falloff: float = 0.0, post: bool = True, **scene) -> list[PosedView]:
    """Cameras around the origin, looking inwards."""
    views = []
    for k, gain in enumerate(gains):
        a = 2 * np.pi * k / len(gains)
        pose = planar_pose(-np.cos(a), -np.sin(a), a, Mount(np.radians(40), 0.0, 0.7))
        views.append(PosedView(f"A/{k}", picture(pose, gain, falloff, post, **scene), CAMERA, pose))
    return views


def ground_at(raster, x, y):
    """Pixels of map points."""
    back = np.linalg.inv(raster.map_from_pixel)
    uv = np.rint(apply(back, np.column_stack([x, y]).astype(float))).astype(int)
    return uv[:, 1], uv[:, 0]


def test_balance_recovers_exposures_and_vignetting():
    rng = np.random.default_rng(0)
    gains, falloff = rng.normal(0, 0.05, 6), np.array([-0.1, -0.2])
    gains -= gains.mean()
    camera_of = np.array([0, 0, 0, 1, 1, 1])
    i, j = rng.integers(0, 6, 3000), rng.integers(0, 6, 3000)
    i, j = i[i != j], j[i != j]
    radii = rng.uniform(0, 1.5, (len(i), 2))
    ratio = gains[i] - gains[j] + falloff[camera_of[i]] * radii[:, 0]
    ratio -= falloff[camera_of[j]] * radii[:, 1]
    ratio += rng.normal(0, 0.02, len(i))
    ratio[::10] += rng.choice([-1.0, 1.0], len(ratio[::10]))  # obstacles
    found = balance(Spots(np.column_stack([i, j]), ratio, radii, np.ones(len(i))), camera_of)
    np.testing.assert_allclose(found.log_gain, gains, atol=0.01)
    np.testing.assert_allclose(found.falloff, falloff[camera_of], atol=0.02)


def test_balance_without_spots_changes_nothing():
    found = balance(Spots.joined([]), np.zeros(3, np.intp))
    np.testing.assert_array_equal(found.log_gain, np.zeros(3))


def test_survey_finds_exposures_of_pictures():
    gains = np.array([0.1, -0.08, 0.0, 0.05, -0.07, 0.0])
    views = ring(gains, FALLOFF)
    found = survey(views, plan_raster(views, RESOLUTION)).exposure
    np.testing.assert_allclose(found.log_gain - found.log_gain.mean(), gains, atol=0.02)
    np.testing.assert_allclose(found.falloff, FALLOFF, atol=0.05)


def test_spots_pair_each_view_with_the_next_that_sees_the_cell():
    """Four views of two by three cells; the third view is blind to all but the first cell."""
    rng = np.random.default_rng(3)
    light = rng.uniform(20, 200, (2, 3, 4))
    light[..., 1] = (1 + light[..., 0]) * 1.3 - 1  # the same grain at another exposure
    radii = rng.uniform(0, 1, (2, 3, 4)).astype(np.float32)
    radii[:, 1:, 2] = -1
    colours = np.repeat(light[..., None], 3, axis=3).astype(np.float32)
    pairs, ratio, both, weight = successive(colours, radii, 1, 0.02)
    assert pairs.tolist() == 2 * [[0, 1], [1, 3], [3, 0]]
    expected = np.log1p(light[0, :2][:, [0, 1, 3]]) - np.log1p(light[0, :2][:, [1, 3, 0]])
    np.testing.assert_allclose(ratio, expected.ravel(), atol=1e-5)
    np.testing.assert_array_equal(both[0], radii[0, 0, :2])
    np.testing.assert_allclose(weight[::3], 1.0, atol=1e-3)
    assert (weight[[1, 2, 4, 5]] < 0.1).all()


def test_what_hides_most_of_the_ground_does_not_pass_for_an_exposure():
    """On grainy ground, a plain dark wall through most of what two views share stays a wall."""
    rng = np.random.default_rng(4)
    grain = rng.uniform(60, 180, (60, 60))
    light = np.stack([grain, grain, 0.9 * grain], axis=2) + rng.normal(0, 0.5, (60, 60, 3))
    light[:, :35, 0] = 30 + rng.normal(0, 0.5, (60, 35))
    colours = np.repeat(light[..., None], 3, axis=3).astype(np.float32)
    spots = Spots(*successive(colours, np.zeros((60, 60, 3), np.float32), 1, 0.02))
    gains = balance(spots, np.zeros(3, np.intp)).log_gain
    np.testing.assert_allclose(gains - gains[0], [0.0, 0.0, np.log(0.9)], atol=0.02)


def test_clean_maps_tell_ground_from_the_post():
    views = ring(np.zeros(6))
    found = survey(views, plan_raster(views, RESOLUTION))
    # behind the post, seen from the first camera at (-1, 0), and beside it
    back = np.linalg.inv(found.raster.map_from_pixel)
    for x, y, ground in ((0.3, 0.0, False), (0.3, 0.35, True), (-0.3, 0.0, True)):
        u, v = np.rint(apply(back, np.array([[x, y]]))[0]).astype(int)
        there = found.clean[0]
        assert (there.weights[v - there.row, u - there.column] > 127) is np.bool_(ground)


def test_robust_mosaic_shows_the_ground_behind_the_post():
    views = ring([0.08, -0.06, 0.0, 0.05, -0.07, 0.0], FALLOFF)
    raster = plan_raster(views, RESOLUTION)
    mosaic = compose(views, raster, BLENDS["robust"])
    angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    rows, columns = ground_at(raster, 0.3 * np.cos(angle), 0.3 * np.sin(angle))
    shown = mosaic.rgba[rows, columns].astype(float)
    assert (shown[:, 0] < shown[:, 1]).all()  # green, not red


def test_likeness_of_colours_and_grain():
    grey, red = np.full(3, 100, np.float32), np.array([130, 100, 100], np.float32)
    plain, up, down = np.float32(0), np.float32(40), np.float32(-40)
    for d, s, t, expected in (
        (grey, plain, plain, 1.0),
        (grey, up, plain, 1.0),
        (grey, up, up, 1 + 3 * 3200 / 3250),
        (grey, up, down, 1 - 3 * 3200 / 3250),
        (red, plain, plain, np.exp(-2.0)),
    ):
        assert likeness(grey, d, s, t, 15.0, 5.0, 3.0) == pytest.approx(expected, rel=1e-5)


def test_a_tie_goes_to_the_side_whose_views_share_the_grain():
    """Two views from the west agree in colour, two from the east as well, and show another."""
    cameras = np.array([[-1.0, 0, 0.7], [-1.5, 0, 0.7], [1.0, 0, 0.7], [1.5, 0, 0.7]])
    colours = np.repeat(np.array([60, 60, 120, 120], np.float32)[:, None], 3, axis=1)
    slopes = np.array([30, 28, 30, -4], np.float32)
    support = {}
    for grain in (0.0, 3.0):
        weights, backed = np.empty((2, 1, 1, 4), np.float32)
        radii = np.zeros((1, 1, 4), np.float32)
        vote(
            colours[None, None],
            slopes[None, None],
            radii,
            cameras,
            *(0.0, 0.0, 0.02, 4.0, 15.0, 5.0, grain),
            weights,
            backed,
        )
        support[grain] = backed[0, 0]
    west, east = support[0.0].reshape(2, 2)
    np.testing.assert_allclose(west, east, rtol=1e-3)
    assert support[3.0][:2].min() > 1.5 * support[3.0][2:].max()


def test_a_tall_plain_post_does_not_outvote_grainy_ground():
    """Higher than the cameras and dark, it looks alike from all sides; exposures stay equal."""
    scene = {"ground_colours": gravel, "post_colour": (45, 45, 45), "post_at": (0, 0, 0.15, 0.9)}
    views = ring(np.zeros(10), **scene)
    raster = plan_raster(views, RESOLUTION)
    mosaic = compose(views, raster, BLENDS["robust"])
    np.testing.assert_allclose(survey(views, raster).exposure.log_gain, 0.0, atol=0.03)
    angle = np.linspace(0, 2 * np.pi, 90, endpoint=False)
    for radius in (0.4, 0.6, 0.8, 1.0):
        x, y = radius * np.cos(angle), radius * np.sin(angle)
        shown = mosaic.rgba[ground_at(raster, x, y)][:, :3].astype(float)
        assert (np.abs(shown - gravel(x, y)).mean(axis=1) > 40).mean() < 0.02


def test_no_seams_where_exposures_differ():
    """Steps between neighbouring pixels stay those of the floor, but for a grey level or two."""
    views = ring([0.1, -0.1, 0.1, -0.1, 0.1, -0.1], FALLOFF, post=False)
    raster = plan_raster(views, RESOLUTION)
    steps = {}
    for name in ("robust", "best"):
        mosaic = compose(views, raster, BLENDS[name])
        seen = (mosaic.views[:, 1:] > 1) & (mosaic.views[:, :-1] > 1)
        step = np.abs(np.diff(mosaic.rgba[..., :3].astype(int), axis=1)).max(axis=2)
        steps[name] = np.percentile(step[seen], 99.9)
    assert steps["robust"] <= 4
    assert steps["best"] >= 2 * steps["robust"]


def test_evidence_marks_the_post_and_frees_the_floor():
    views = ring(np.zeros(6))
    raster = plan_raster(views, RESOLUTION)
    mosaic = compose(views, raster, BLENDS["robust"])
    rows, columns = ground_at(raster, [0.35, -0.35, 0.0], [0.35, 0.3, -0.4])
    assert (mosaic.log_odds[rows, columns] < 0).all()
    assert (mosaic.log_odds[mosaic.views == 0] == 0).mean() > 0.95


def test_survey_of_views_that_share_nothing():
    pose = planar_pose(50.0, 0.0, 0.0, Mount(np.radians(40), 0.0, 0.7))
    views = [*ring([0.0]), PosedView("A/far", picture(pose, 0.3, 0.0, False), CAMERA, pose)]
    found = survey(views, plan_raster(views, 0.05))
    np.testing.assert_array_equal(found.exposure.log_gain, [0.0, 0.0])


def test_survey_reads_each_picture_once_and_does_not_depend_on_threads():
    views = ring([0.05, 0.0, -0.05])
    raster = plan_raster(views, RESOLUTION)
    reads = []

    def lazily(view: PosedView) -> Picture:
        def read() -> np.ndarray:
            reads.append(view.image_id)
            return view.pixels

        return Picture(view.camera, view.map_from_camera, read)

    one = survey([lazily(v) for v in views], raster)
    assert set(reads) == {v.image_id for v in views}
    assert len(reads) <= 2 * len(views)  # once for the border, once for the cells, in one go
    three = survey(views, raster, jobs=3)
    np.testing.assert_array_equal(one.log_odds, three.log_odds)
    for a, b in zip(one.clean, three.clean, strict=True):
        np.testing.assert_array_equal(a.weights, b.weights)
