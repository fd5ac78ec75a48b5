"""Datasets: which images there are, what became of the others, and their pixels."""

import hashlib
import json
import os
import pickle
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from urllib.parse import unquote

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gvpipe.config import AUTO_TILT_DEG
from gvpipe.configfile import load_config
from gvpipe.core.geometry.undistortion import undistort, undistortion
from gvpipe.core.types import Camera
from gvpipe.dataset import open_dataset
from gvpipe.errors import ConfigError, InputError
from gvpipe.filelist import list_files
from gvpipe.names import escape, natural_key
from gvpipe.pixels import PixelSource, PixelStore

CAMERAS = """cameras:
  small: {width: 64, height: 48, fx: 60, fy: 60, cx: 31.5, cy: 23.5}
  other: {width: 80, height: 60, fx: 70, fy: 70, cx: 39.5, cy: 29.5}
"""


def unescape(name: str) -> str:
    """The file name that an escaped one stands for, by somebody else's decoder."""
    return unquote(name, errors="surrogateescape")


def png(value=0, size=(64, 48)):
    return cv2.imencode(".png", np.full((size[1], size[0], 3), value, np.uint8))[1].tobytes()


@pytest.fixture
def make(tmp_path):
    """Write images and a configuration; give back the configuration."""

    def _make(files, robots="A: {images: a, camera: small, height: 0.5, tilt: 30}", rest=""):
        for name, raw in files.items():
            path = tmp_path / os.fsdecode(name)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(raw)
        text = CAMERAS + "robots:\n" + "".join(f"  {r}\n" for r in robots.splitlines()) + rest
        (tmp_path / "run.yaml").write_text(text)
        return load_config(tmp_path / "run.yaml")

    return _make


def ids(dataset):
    return [entry.image_id for entry in dataset.entries]


def test_images_come_in_natural_order_with_their_facts(make):
    names = ["img1.png", "img2.png", "img10.png", "IMG3.png"]
    dataset = open_dataset(make({f"a/{name}": png(k) for k, name in enumerate(names)}))
    assert ids(dataset) == ["A/IMG3.png", "A/img1.png", "A/img2.png", "A/img10.png"]
    entry = dataset.entry("A/img2.png")
    assert entry.size_bytes == len(png(1))
    assert entry.camera == Camera(64, 48, 60, 60, 31.5, 23.5)
    assert entry.mount.tilt == pytest.approx(np.pi / 6)
    assert entry.mount.tilt_known
    view = dataset.view("A/img2.png")
    assert view.pixels.shape == (48, 64, 3)
    assert (view.pixels == 1).all()
    assert view.mount == entry.mount
    with pytest.raises(KeyError):
        dataset.view("A/none.png")


def test_overrides_and_auto_tilt(make):
    robots = (
        "A: {images: a, camera: small, height: 0.5, tilt: auto, roll: 2, overrides: "
        "{1.png: {tilt: 20, height: 0.7, camera: other, roll: -3}, 2.png: {roll: 1}}}"
    )
    dataset = open_dataset(
        make({"a/0.png": png(), "a/1.png": png(0, (80, 60))} | {"a/2.png": png()}, robots)
    )
    zero, one, two = dataset.entries
    assert zero.mount.tilt == pytest.approx(np.radians(AUTO_TILT_DEG))
    assert not zero.mount.tilt_known
    assert one.mount.tilt_known
    assert np.degrees([one.mount.tilt, one.mount.roll]) == pytest.approx([20, -3])
    assert (one.mount.height, one.camera.width) == (0.7, 80)
    assert np.degrees(two.mount.roll) == pytest.approx(1)
    assert two.mount.height == 0.5


def test_bad_images_are_skipped_with_their_reasons(make, tmp_path):
    good = png()
    config = make(
        {
            "a/0.png": good,
            "a/1.png": good[:-20],
            "a/2.jpg": b"",
            "a/3.png": png(0, (80, 60)),
            "a/4.jpg": b"no image at all",
            "a/notes.txt": b"a file among images",
            "a/clip.mp4": b"video",
            "a/.hidden.png": good,
            "a/sub/9.png": good,
            "a/7.dat": good,
        }
    )
    os.mkfifo(tmp_path / "a/5.png")
    (tmp_path / "a/6.png").symlink_to("6.png")
    (tmp_path / "a/loop").symlink_to(tmp_path / "a")
    dataset = open_dataset(config, jobs=2)
    assert ids(dataset) == ["A/0.png", "A/7.dat"]
    reasons = {s.image: s.reason for s in dataset.skipped}
    assert reasons.keys() == {
        *("A/1.png", "A/2.jpg", "A/3.png", "A/4.jpg", "A/5.png", "A/6.png"),
        *("A/clip.mp4", "A/notes.txt"),
    }
    assert reasons["A/1.png"] == "PNG data are truncated or corrupt"
    assert reasons["A/2.jpg"] == "is empty"
    assert reasons["A/3.png"] == "is 80x60, but camera small is 64x48"
    assert reasons["A/5.png"] == "is not a regular file"
    assert "name it in `images:`" in reasons["A/clip.mp4"]


def test_hostile_names_become_printable_unique_ids(make):
    names = [b"\xff.png", b"a\nb.png", "\U0001f697 \u202e.png".encode(), b"-rf.png", b"%41.png"]
    names += [b"\x1b[31m.png", b"x" * 250 + b".png"]
    dataset = open_dataset(make({b"a/" + name: png(k) for k, name in enumerate(names)}))
    assert not dataset.skipped
    assert len(set(ids(dataset))) == len(names)
    for image_id in ids(dataset):
        assert image_id.isprintable()
        assert json.loads(json.dumps(image_id, ensure_ascii=False)) == image_id
        image_id.encode("utf-8")
    found = {os.fsencode(unescape(image_id.removeprefix("A/"))) for image_id in ids(dataset)}
    assert found == set(names)
    assert {int(dataset.view(i).pixels[0, 0, 0]) for i in ids(dataset)} == set(range(len(names)))


@given(st.text(st.characters(exclude_characters="/\0", exclude_categories=["Cs"]), max_size=20))
def test_escaped_names_are_printable_and_come_back(name):
    assert unescape(escape(name)) == name
    assert all(c not in escape(name) for c in "\n\r\t\x1b\x7f\x85\u2028\u202e")


@given(st.binary(max_size=12))
def test_escaped_bytes_come_back(raw):
    name = os.fsdecode(raw)
    assert os.fsencode(unescape(escape(name))) == raw
    escape(name).encode("utf-8")


def test_natural_order():
    names = ["a10", "a9", "a09", "b", "a", "10", "9", "a9b", "a9a"]
    expected = ["9", "10", "a", "a09", "a9", "a9a", "a9b", "a10", "b"]
    assert sorted(names, key=natural_key) == expected


def test_globs_folders_and_single_files(tmp_path):
    base = tmp_path / "[x]*"  # a folder that looks like a glob is taken as it is
    for name in ("a/1.png", "a/2.jpg", "b/3.png", "b/c/4.png", ".h/5.png", "b/[1].png"):
        (base / name).parent.mkdir(parents=True, exist_ok=True)
        (base / name).write_bytes(b"")
    (base / "b/loop").symlink_to(base)

    def names(pattern):
        return [str(p.relative_to(base)) for p in list_files(base / pattern)]

    assert names("a") == ["a/1.png", "a/2.jpg"]
    assert names("a/*.png") == ["a/1.png"]
    assert names("*/?.png") == ["a/1.png", "b/3.png"]
    assert names("**/*.png") == ["a/1.png", "b/3.png", "b/c/4.png", "b/[1].png"]
    assert names("b/[1].png") == ["b/[1].png"]
    assert names("b") == ["b/3.png", "b/[1].png"]
    for missing in ("none", "a/none.png"):
        with pytest.raises(InputError, match="no such file or folder"):
            names(missing)
    assert names("a/*.tif") == []


@pytest.mark.parametrize(
    ("files", "images", "expected"),
    [
        ({}, "a", r"robots.A.images: .*/a: no such file or folder"),
        ({"a/notes.txt": b"x"}, "a", r"robots.A.images: .*/a: no usable image; 1 skipped, the"),
        ({"a/1.png": png()}, "a/*.jpg", r"robots.A.images: .*/a/\*.jpg: no usable image$"),
        ({"a/1.png": b""}, "a/1.png", r"no usable image; 1 skipped, the first is A/1.png: is em"),
        ({"a/1.png": png(), "b/1.png": png()}, "*/1.png", r"are both called A/1.png"),
    ],
)
def test_a_robot_without_images_is_an_input_error(files, images, expected, make):
    config = make(files, f"A: {{images: '{images}', camera: small, height: 0.5, tilt: 30}}")
    with pytest.raises(InputError, match=expected):
        open_dataset(config)


@pytest.mark.parametrize(
    ("overrides", "rest", "expected"),
    [
        ("{2.png: {tilt: 3}}", "", r"robots.A.overrides.2.png: no such image in .*mean 1.png\?"),
        ("{}", "slam: {reference: A/01.png}\n", r"slam.reference: A/01.png: no such image \(did"),
        (
            "{}",
            "match: {pairs: [[A/1.png, A/7.png]]}\n",
            r"match.pairs.0: A/7.png: no such image",
        ),
    ],
)
def test_images_named_in_the_configuration_must_exist(overrides, rest, expected, make):
    robots = f"A: {{images: a, camera: small, height: 1, tilt: 30, overrides: {overrides}}}"
    with pytest.raises(ConfigError, match=expected):
        open_dataset(make({"a/1.png": png()}, robots, rest))


def test_a_skipped_image_may_be_named(make):
    rest = "match: {pairs: [[A/1.png, A/2.png]]}\n"
    dataset = open_dataset(make({"a/1.png": png(), "a/2.png": b""}, rest=rest))
    assert [s.image for s in dataset.skipped] == ["A/2.png"]


ROBOT_WITH_POSES = "A: {images: a, camera: small, height: 0.5, tilt: 30, poses: p.tum}"


def test_known_poses_count_bad_images_but_not_other_files(make):
    files = {"a/1.png": png(), "a/2.png": b"", "a/10.png": png(), "a/readme.md": b"#"}
    poses = "".join(f"{k} {k} 0 0.5 0 0 0 1\n" for k in range(3))
    dataset = open_dataset(make(files | {"p.tum": poses.encode()}, ROBOT_WITH_POSES))
    assert list(dataset.poses) == ["A/1.png", "A/10.png"]
    np.testing.assert_array_equal(dataset.poses["A/10.png"].translation, [2, 0, 0.5])
    assert set(dataset.pose_files) == {"A"}


@pytest.mark.parametrize(
    ("poses", "expected"),
    [
        ("0 0 0 1 0 0 0 1\n", r"p.tum: 1 poses; expected 2, one line for each image in"),
        ("0 0 0 1 0 0 0 1\n0 0 0 1 0 0 1 1\n", r"p.tum:2: the quaternion's norm is 1.414"),
        ("0 0 0 1 0 0 0 1\n0 0 0 -1 0 0 0 1\n", r"the camera of A/2.png is -1 m above the gro"),
        (
            "# in millimetres\n0 0 0 400 0 0 0 1\n1 0 0 500 0 0 0 1\n",
            r"p.tum:3: the camera of A/2.png is 500 m above .* but robots.A.height says 0.5 m; exp",
        ),
        ("0 0 0 0.1 0 0 0 1\n1 0 0 0.12 0 0 0 1\n", r"p.tum:1: the camera of A/1.png is 0.1 m "),
    ],
)
def test_poses_that_do_not_fit_are_refused(poses, expected, make):
    files = {"a/1.png": png(), "a/2.png": png(), "p.tum": poses.encode()}
    with pytest.raises(InputError, match=expected):
        open_dataset(make(files, ROBOT_WITH_POSES))


def test_one_picture_from_a_ladder_is_no_other_unit(make):
    poses = "".join(f"{k} {k} 0 {z} 0 0 0 1\n" for k, z in enumerate((0.5, 0.6, 2.5)))
    files = {"p.tum": poses.encode()} | {f"a/{k}.png": png() for k in range(3)}
    assert len(open_dataset(make(files, ROBOT_WITH_POSES)).poses) == 3


def write_video(path, count=5):
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10, (64, 48))
    for k in range(count):
        writer.write(np.full((48, 64, 3), 40 * k, np.uint8))
    writer.release()


def test_every_frame_of_a_video_is_an_image(make, tmp_path):
    write_video(tmp_path / "v/walk.avi")
    robots = (
        "A: {images: v/walk.avi, camera: small, height: 0.5, tilt: 30, "
        "overrides: {'walk.avi#000002': {tilt: 40}}}\n"
        "B: {images: 'v/*.avi', camera: small, height: 0.5, tilt: 30}"
    )
    dataset = open_dataset(make({}, robots))
    assert ids(dataset)[:5] == [f"A/walk.avi#{k:06d}" for k in range(5)]
    assert len(dataset.robots["B"]) == 5
    assert np.degrees(dataset.entries[2].mount.tilt) == pytest.approx(40)
    copy = pickle.loads(pickle.dumps(dataset))
    for data in (dataset, copy):
        for k in (0, 3, 1, 4):
            grey = data.view(f"A/walk.avi#{k:06d}").pixels.mean()
            assert abs(grey - 40 * k) < 4


def test_a_video_with_another_size_is_skipped(make, tmp_path):
    write_video(tmp_path / "walk.avi")
    with pytest.raises(InputError, match="is 64x48, but camera other is 80x60"):
        open_dataset(make({}, "A: {images: walk.avi, camera: other, height: 1, tilt: 30}"))


def test_a_file_that_changed_or_went_is_an_input_error(make, tmp_path):
    dataset = open_dataset(make({"a/1.png": png(), "a/2.png": png()}))
    (tmp_path / "a/1.png").write_bytes(png(9))
    (tmp_path / "a/2.png").unlink()
    with pytest.raises(InputError, match=r"1.png: changed while gvpipe was running"):
        dataset.view("A/1.png")
    with pytest.raises(InputError, match=r"2.png: cannot be read"):
        dataset.view("A/2.png")


def test_the_dataset_is_the_same_for_any_number_of_jobs(make):
    config = make({f"a/{k}.png": png(k) for k in range(12)} | {"a/x.png": b""})
    assert open_dataset(config, jobs=1) == open_dataset(config, jobs=4)


def source(path, **changes):
    camera = Camera(64, 48, 60, 60, 31.5, 23.5)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    return PixelSource(
        **(
            {"path": path, "frame": None, "sha256": digest, "camera": camera}
            | {"distortion": ()}
            | changes
        )
    )


def test_the_cache_stays_within_its_size_and_under_threads(tmp_path):
    paths = [tmp_path / f"{k}.png" for k in range(6)]
    for k, path in enumerate(paths):
        path.write_bytes(png(k))
    store = PixelStore(cache_bytes=2 * 48 * 64 * 3)
    sources = [source(path) for path in paths]
    with ThreadPoolExecutor(4) as pool:
        values = list(pool.map(lambda s: int(store.read(s)[0, 0, 0]), sources * 20))
    assert values == list(range(6)) * 20
    assert store.read(sources[0]) is store.read(sources[0])
    first = store.read(sources[0])
    for other in sources[1:4]:
        store.read(other)
    assert store.read(sources[0]) is not first  # long gone
    assert PixelStore(0).read(sources[0]) is not None


COEFFICIENTS = [
    (-0.2, 0.03, 0.001, -0.002),
    (0.05, -0.02, 0.0003, -0.0002, 0.001),
    (0.1, 0.01, 0.0, 0.001, 0.0, 0.12, 0.02, 0.0),
]


@pytest.mark.parametrize("distortion", COEFFICIENTS)
@pytest.mark.parametrize("skew", [0.0, 4.0])
def test_undistortion_puts_points_where_the_pinhole_camera_sees_them(distortion, skew):
    camera = Camera(640, 480, 520.0, 510.0, 322.0, 236.0, skew)
    # dots drawn where the distorted camera sees points on rays
    rays = np.array([[x, y] for x in np.linspace(-0.45, 0.45, 5) for y in (-0.33, 0, 0.33)])
    k = (*distortion, *[0.0] * (8 - len(distortion)))
    x, y = rays.T
    r2 = x**2 + y**2
    radial = (1 + k[0] * r2 + k[1] * r2**2 + k[4] * r2**3) / (
        1 + k[5] * r2 + k[6] * r2**2 + k[7] * r2**3
    )
    distorted = np.column_stack(
        [
            x * radial + 2 * k[2] * x * y + k[3] * (r2 + 2 * x**2),
            y * radial + k[2] * (r2 + 2 * y**2) + 2 * k[3] * x * y,
            np.ones(len(rays)),
        ]
    )
    seen = (distorted @ camera.matrix.T)[:, :2]
    v, u = np.mgrid[:480, :640]
    blobs = sum(np.exp(-((u - a) ** 2 + (v - b) ** 2) / 18.0) for a, b in seen)
    image = np.repeat(np.round(255 * np.clip(blobs, 0, 1))[:, :, None], 3, 2).astype(np.uint8)
    result = undistort(image, undistortion(camera, distortion))[:, :, 0].astype(float)
    ideal = (np.column_stack([rays, np.ones(len(rays))]) @ camera.matrix.T)[:, :2]
    for a, b in ideal:
        near = result * ((u - a) ** 2 + (v - b) ** 2 < 12**2)
        centre = np.array([(near * u).sum(), (near * v).sum()]) / near.sum()
        assert np.linalg.norm(centre - [a, b]) < 0.25


def test_pincushion_leaves_corners_without_photograph():
    camera = Camera(64, 48, 60, 60, 31.5, 23.5)
    table = undistortion(camera, (0.2, 0.0, 0.0, 0.0))
    assert not table.inside[[0, 0, -1, -1], [0, -1, 0, -1]].any()
    assert table.inside[8:-8, 8:-8].all()
    assert undistortion(camera, (-0.2, 0.0, 0.0, 0.0)).inside.all()
    flat = np.full((48, 64, 3), 77, np.uint8)
    assert (undistort(flat, table) == 77).all()  # the border is continued, not black


def test_views_are_undistorted_and_say_where_the_photograph_is(make):
    base = make({"a/1.png": png(50)})
    assert open_dataset(base).inside("A/1.png") is None
    cameras = {
        "small": base.cameras["small"].model_copy(update={"distortion": (0.2, 0.0, 0.0, 0.0)})
    }
    dataset = open_dataset(base.model_copy(update={"cameras": cameras}))
    inside = dataset.inside("A/1.png")
    assert inside is not None
    assert not inside[0, 0]
    assert (dataset.view("A/1.png").pixels == 50).all()


def test_paths_do_not_matter_to_ids(make, tmp_path):
    config = make({"a/1.png": png()})
    absolute = config.robots["A"].model_copy(update={"images": Path(tmp_path / "a" / "1.png")})
    single = open_dataset(config.model_copy(update={"robots": {"A": absolute}}))
    assert ids(single) == ids(open_dataset(config)) == ["A/1.png"]
