"""The mosaic against a painted floor seen by known cameras."""

import io
import struct
import zlib

import cv2
import numpy as np
import pytest

from gvpipe.commands import report_pictures
from gvpipe.core.geometry.ground import pixel_from_plane
from gvpipe.core.geometry.homography import apply, local_jacobian
from gvpipe.core.geometry.pose import planar_pose
from gvpipe.core.mosaic.blend import BLENDS, Samples
from gvpipe.core.mosaic.compose import BAND, Composition, compose
from gvpipe.core.mosaic.raster import MosaicRaster, max_depth, outline, plan_raster
from gvpipe.core.types import Camera, Mount, PosedView
from gvpipe.errors import InputError
from gvpipe.formats.raster import PngWriter, png_bytes, read_png, world_file

CAMERA = Camera(200, 150, 170.0, 165.0, 98.0, 76.0)
RESOLUTION = 0.01


def floor(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Smooth colours of the ground at map points: waves much longer than a pixel."""
    waves = [np.sin(3 * x + y), np.cos(2 * y - x), np.sin(2 * x - 3 * y + 1)]
    return np.stack([128 + 90 * w for w in waves], axis=-1)


def picture(camera: Camera, pose, block=None) -> np.ndarray:
    """What the camera sees of the floor; `block` = (x, y, side, colour) is painted flat on it."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    plane_from_pixel = np.linalg.inv(pixel_from_plane(camera, pose))
    x, y = apply(plane_from_pixel, np.column_stack([u.ravel(), v.ravel()]).astype(float)).T
    colours = floor(x, y)
    if block is not None:
        bx, by, side, colour = block
        colours[(abs(x - bx) < side / 2) & (abs(y - by) < side / 2)] = colour
    return np.rint(colours).clip(0, 255).astype(np.uint8).reshape(camera.height, camera.width, 3)


def posed(name: str, x: float, y: float, yaw_deg: float, tilt_deg: float = 45, block=None):
    pose = planar_pose(x, y, np.radians(yaw_deg), Mount(np.radians(tilt_deg), 0.05, 0.7))
    return PosedView(name, picture(CAMERA, pose, block), CAMERA, pose)


@pytest.fixture(scope="module")
def ring():
    """Six cameras around the origin, looking inwards."""
    angles = np.radians(np.arange(0, 360, 60))
    return [
        posed(f"A/{k}", -np.cos(a), -np.sin(a), np.degrees(a), 40 + 3 * k)
        for k, a in enumerate(angles)
    ]


def truth(raster: MosaicRaster) -> np.ndarray:
    u, v = np.meshgrid(np.arange(raster.width), np.arange(raster.height))
    x, y = apply(raster.map_from_pixel, np.column_stack([u.ravel(), v.ravel()]).astype(float)).T
    return floor(x, y).reshape(raster.height, raster.width, 3)


@pytest.mark.parametrize("name", BLENDS)
def test_mosaic_shows_the_floor(ring, name):
    raster = plan_raster(ring, RESOLUTION)
    mosaic = compose(ring, raster, BLENDS[name])
    seen = mosaic.rgba[..., 3] == 255
    assert set(np.unique(mosaic.rgba[..., 3])) == {0, 255}
    assert (seen == (mosaic.views > 0)).all()
    error = np.abs(mosaic.rgba[..., :3].astype(float) - truth(raster))[seen]
    assert seen.mean() > 0.5
    assert np.median(error) < 1.0
    assert np.percentile(error, 99) < 8.0


def test_mosaic_has_map_x_to_the_right_and_y_up(ring):
    raster = plan_raster(ring, RESOLUTION)
    top_left = apply(raster.map_from_pixel, np.zeros((1, 2)))[0]
    corner = np.array([[raster.width - 1.0, raster.height - 1.0]])
    bottom_right = apply(raster.map_from_pixel, corner)[0]
    assert top_left[0] < bottom_right[0]
    assert top_left[1] > bottom_right[1]


@pytest.mark.parametrize("name", BLENDS)
def test_threads_do_not_change_a_byte(ring, name):
    raster = plan_raster(ring, RESOLUTION)
    one, three = (compose(ring, raster, BLENDS[name], jobs) for jobs in (1, 3))
    np.testing.assert_array_equal(one.rgba, three.rgba)
    np.testing.assert_array_equal(one.views, three.views)
    np.testing.assert_array_equal(one.log_odds, three.log_odds)


@pytest.mark.parametrize("name", ["half", "best"])
def test_tiles_leave_no_trace(ring, name):
    raster = plan_raster(ring, RESOLUTION)
    whole = compose(ring, raster, BLENDS[name])
    shifted = MosaicRaster(
        raster.width - 50,
        raster.height - 30,
        RESOLUTION,
        raster.x_min + 50 * RESOLUTION,
        raster.y_max - 30 * RESOLUTION,
    )
    part = compose(ring, shifted, BLENDS[name])
    # the same ground pixel through other tiles: rounding may differ in the last bit
    assert np.abs(part.rgba.astype(int) - whole.rgba[30:, 50:]).max() <= 1


def test_bands_follow_each_other(ring):
    raster = plan_raster(ring, RESOLUTION / 4)
    bands = list(Composition(ring, raster, BLENDS["best"], jobs=2).bands())
    assert len(bands) > 1
    assert [band.row for band in bands] == list(range(0, raster.height, BAND))
    assert sum(len(band.rgba) for band in bands) == raster.height
    whole = compose(ring, raster, BLENDS["best"])
    np.testing.assert_array_equal(np.concatenate([b.rgba for b in bands]), whole.rgba)
    np.testing.assert_array_equal(np.concatenate([b.error for b in bands]), whole.error)
    np.testing.assert_array_equal(whole.error == 255, whole.views == 0)


def test_many_views_that_agree_leave_less_doubt(ring):
    mosaic = compose(ring, plan_raster(ring, RESOLUTION), BLENDS["robust"])
    one, many = mosaic.error[mosaic.views == 1], mosaic.error[mosaic.views >= 5]
    assert set(one) == {80}  # ten grey levels, in eighths
    assert np.percentile(many, 90) < 40


@pytest.mark.parametrize("name", ["robust", "half"])
def test_what_few_views_see_is_dropped(ring, name):
    """Two of six views carry a red patch where the others see floor."""
    block = (0.0, 0.0, 0.3, (255, 0, 0))
    angles = np.radians(np.arange(0, 360, 60))
    views = list(ring)
    for k in (1, 4):
        a = angles[k]
        views[k] = posed("A/x", -np.cos(a), -np.sin(a), np.degrees(a), 40 + 3 * k, block)
    raster = plan_raster(views, RESOLUTION)
    u, v = -raster.x_min / RESOLUTION, raster.y_max / RESOLUTION
    window = np.s_[round(v) - 12 : round(v) + 12, round(u) - 12 : round(u) + 12]
    mosaic = compose(views, raster, BLENDS[name])
    assert mosaic.views[window].min() >= 5
    error = np.abs(mosaic.rgba[window][..., :3] - truth(raster)[window])
    assert error.max() < 6.0


def test_half_is_the_printed_rule():
    """One pixel recomputed by hand: drop the farthest from the mean until ceil(n / 2) remain."""
    rng = np.random.default_rng(0)
    for n in (1, 2, 3, 4, 5, 8, 11):
        samples = rng.uniform(0, 255, (1, 1, n, 3)).astype(np.float32)
        density = rng.uniform(1, 2, (1, 1, n)).astype(np.float32)
        rest = list(range(n))
        while len(rest) > (n + 1) // 2:
            far = [np.linalg.norm(samples[0, 0, k] - samples[0, 0, rest].mean(0)) for k in rest]
            if len(rest) == 2:
                rest.remove(min(rest, key=lambda k: density[0, 0, k]))
            else:
                rest.pop(int(np.argmax(far)))
        expected = samples[0, 0, rest].mean(axis=0)
        rgba = np.zeros((1, 1, 4), np.uint8)
        room = Samples.empty(1, 1, n)
        count = np.full((1, 1), n, np.int16)
        kernel = BLENDS["half"].kernel
        error = np.zeros((1, 1), np.uint8)
        kernel(
            samples.copy(),
            density.copy(),
            room.clean,
            np.ones((1, 1), np.float32),
            count,
            rgba,
            error,
        )
        np.testing.assert_allclose(rgba[0, 0, :3], expected, atol=0.51)


def test_best_takes_the_view_with_the_highest_density():
    here, there = posed("A/here", 0.0, 0.0, 0), posed("A/there", 1.5, 0.1, 180, tilt_deg=35)
    here = PosedView("A/here", np.full_like(here.pixels, 200), CAMERA, here.map_from_camera)
    there = PosedView("A/there", np.full_like(there.pixels, 100), CAMERA, there.map_from_camera)
    raster = plan_raster([here, there], RESOLUTION)
    mosaic = compose([there, here], raster, BLENDS["best"])
    places = np.argwhere(mosaic.views == 2)[::97]
    ground = apply(raster.map_from_pixel, places[:, ::-1].astype(float))
    density = [
        np.abs(np.linalg.det(local_jacobian(pixel_from_plane(CAMERA, w.map_from_camera), ground)))
        for w in (here, there)
    ]
    taken = mosaic.rgba[*places.T, 0]
    np.testing.assert_array_equal(taken, np.where(density[0] > density[1], 200, 100))
    assert {100, 200} == set(taken.tolist())


def test_nothing_is_seen_beyond_the_depth_limit():
    view = posed("A/low", 0.0, 0.0, 0, tilt_deg=12)  # the horizon is in the picture
    raster = plan_raster([view], RESOLUTION)
    mosaic = compose([view], raster, BLENDS["best"])
    v, u = np.nonzero(mosaic.rgba[..., 3])
    ground = apply(raster.map_from_pixel, np.column_stack([u, v]).astype(float))
    points = np.column_stack([ground, np.zeros(len(ground))])
    back = view.map_from_camera.inverse()
    depth = points @ back.rotation[2] + back.translation[2]
    limit = max_depth(view, RESOLUTION)
    assert depth.max() <= limit + 1e-9
    assert depth.max() > 0.95 * limit
    assert outline(view, RESOLUTION)[:, 0].max() >= ground[:, 0].max()


@pytest.mark.parametrize("name", BLENDS)
def test_the_black_border_of_undistortion_is_not_ground(ring, name):
    views = []
    for k, view in enumerate(ring):
        pixels = view.pixels.copy()
        pixels[:, : 9 + k] = pixels[140:] = pixels[:20, 170:] = 0
        views.append(PosedView(view.image_id, pixels, CAMERA, view.map_from_camera))
    raster = plan_raster(views, RESOLUTION)
    mosaic = compose(views, raster, BLENDS[name])
    seen = mosaic.views > 0
    error = np.abs(mosaic.rgba[..., :3].astype(float) - truth(raster))[seen]
    assert error.max() < 16.0
    assert seen.sum() < (compose(ring, raster, BLENDS[name]).views > 0).sum()


def test_absurd_rasters_are_refused(ring):
    with pytest.raises(ValueError, match="coarser resolution"):
        plan_raster(ring, 1e-6)
    with pytest.raises(ValueError, match="no view"):
        plan_raster([], RESOLUTION)
    lost = planar_pose(np.nan, 0.0, 0.0, Mount(0.7, 0.0, 0.7))
    with pytest.raises(ValueError, match="finite"):
        plan_raster([PosedView("A/0", ring[0].pixels, CAMERA, lost)], RESOLUTION)


def test_png_of_strips_decodes_to_the_picture():
    rng = np.random.default_rng(1)
    for channels in (1, 3, 4):
        pixels = rng.integers(0, 256, (37, 23, channels), dtype=np.uint8)
        stream = io.BytesIO()
        writer = PngWriter(stream, 23, 37, channels)
        for k in range(0, 37, 10):
            writer.write(pixels[k : k + 10])
        writer.close()
        data = stream.getvalue()
        decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        decoded = decoded.reshape(37, 23, channels)
        order = {1: [0], 3: [2, 1, 0], 4: [2, 1, 0, 3]}[channels]
        np.testing.assert_array_equal(decoded[..., order], pixels)
        assert png_bytes(pixels)[16:24] == struct.pack(">II", 23, 37)


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_pictures_are_read_back_at_any_size(channels, tmp_path, monkeypatch):
    monkeypatch.setattr("PIL.Image.MAX_IMAGE_PIXELS", 10)  # from twice as many on Pillow refuses
    pixels = np.random.default_rng(0).integers(0, 256, (7, 5, channels), dtype=np.uint8)
    path = tmp_path / "a.png"
    path.write_bytes(sound := png_bytes(pixels))
    assert np.array_equal(read_png(path), pixels)
    assert report_pictures.picture(path).startswith("data:image/webp;base64,")
    for damaged in (b"", sound[:-1], sound[:40] + b"?" + sound[41:]):
        path.write_bytes(damaged)
        with pytest.raises(InputError, match=r"a\.png"):
            read_png(path)


def test_png_refuses_strips_that_do_not_fit():
    writer = PngWriter(io.BytesIO(), 4, 9, 3)
    with pytest.raises(ValueError, match="strip"):
        writer.write(np.zeros((9, 5, 3), np.uint8))
    writer.write(np.zeros((8, 4, 3), np.uint8))
    with pytest.raises(ValueError, match="rows"):
        writer.close()
    assert zlib.crc32(b"IEND") == 0xAE426082  # the checksum every PNG ends with
    assert png_bytes(np.zeros((1, 1, 3), np.uint8)).endswith(b"IEND\xaeB`\x82")


def test_world_file_places_the_picture(ring):
    matrix = plan_raster(ring, RESOLUTION).map_from_pixel
    text = world_file(matrix)
    lines = [float(v) for v in text.split()]
    assert lines[0] == RESOLUTION
    assert lines[3] == -RESOLUTION
    np.testing.assert_array_equal(np.array(lines).reshape(3, 2).T, matrix[:2])
    with pytest.raises(ValueError, match="affine"):
        world_file(np.array([[1, 0, 0], [0, 1, 0], [0.1, 0, 1.0]]))
