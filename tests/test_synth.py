"""Made-up scenes against projections and formulas that do not use the ray tracer."""

import hashlib
import json
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from gvpipe.cli import run
from gvpipe.configfile import load_config
from gvpipe.core.geometry.pose import mount_of, planar_pose
from gvpipe.core.synthesis.camera_path import (
    circle,
    ground_sampling,
    line,
    mower,
    poses,
    shared_ground,
)
from gvpipe.core.synthesis.scene import Scene, make_scene, photograph
from gvpipe.core.synthesis.solids import Solid
from gvpipe.core.synthesis.texture import TEXTURES, stone
from gvpipe.core.types import Camera, Float, Mount, Pose
from gvpipe.dataset import open_dataset
from gvpipe.formats.tum import read_tum
from tests.synthetic import true_homography

CAMERA = Camera(200, 150, 170.0, 170.0, 99.5, 74.5)
DISTORTION = (-0.2, 0.05, 0.001, -0.002, 0.0)
MOUNT = Mount(np.radians(38.0), np.radians(4.0), 0.6)
SOLIDS = (
    Solid("box", 0.0, -0.15, (0.3, 0.2, 0.25), 0.4),
    Solid("cylinder", 0.1, 0.25, (0.16, 0.16, 0.3)),
    Solid("sphere", -0.25, 0.05, (0.2, 0.2, 0.2)),
)


@pytest.fixture(scope="module")
def scene() -> Scene:
    rng = np.random.default_rng(5)
    return make_scene(stone(rng), SOLIDS, rng=rng)


@pytest.mark.parametrize(
    ("solid", "volume", "area"),
    [
        (Solid("box", 1, 2, (2, 3, 4), 0.3), 24.0, 52.0),
        (Solid("cylinder", 1, 2, (2, 2, 3)), 3 * np.pi, 8 * np.pi),
        (Solid("sphere", 1, 2, (2, 2, 2)), 4 / 3 * np.pi, 4 * np.pi),
    ],
    ids=lambda value: getattr(value, "kind", ""),
)
def test_surfaces_are_closed_and_measure_what_they_should(
    solid: Solid, volume: float, area: float
) -> None:
    surface = solid.surface
    peer = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    assert peer.is_watertight
    assert peer.is_winding_consistent
    assert peer.volume == pytest.approx(volume, rel=0.005)
    assert peer.area == pytest.approx(area, rel=0.005)
    assert surface.vertices[:, 2].min() == pytest.approx(0.0, abs=1e-12)
    assert np.allclose(peer.bounds.mean(axis=0)[:2], (1, 2), atol=0.01)


@pytest.mark.parametrize("distortion", [(), DISTORTION], ids=["straight", "distorted"])
def test_silhouettes_are_where_the_surfaces_project(
    scene: Scene, distortion: tuple[float, ...]
) -> None:
    pose = planar_pose(-1.0, 0.05, 0.03, MOUNT)
    picture = photograph(scene, CAMERA, pose, distortion, samples=1, light_samples=1)
    camera_from_map = pose.inverse()
    turn = cv2.Rodrigues(camera_from_map.rotation)[0]
    for number, solid in enumerate(SOLIDS):
        surface = solid.surface
        pixels = cv2.projectPoints(
            surface.vertices, turn, camera_from_map.translation, CAMERA.matrix, np.array(distortion)
        )[0][:, 0]
        drawn = np.zeros(picture.solids.shape, np.uint8)
        for face in surface.faces:
            cv2.fillConvexPoly(drawn, np.rint(pixels[face] * 16).astype(np.int32), 1, shift=4)
        seen = picture.solids == number
        assert seen.sum() > 200
        # a solid may be hidden in part, but never be seen where it does not project
        assert (seen & (drawn == 0)).sum() <= 0.02 * seen.sum()
        assert (seen & (drawn == 1)).sum() >= 0.8 * drawn.sum()


def test_ground_moves_by_its_homography(scene: Scene) -> None:
    empty = make_scene(stone(np.random.default_rng(5)), rng=np.random.default_rng(1))
    pose_i, pose_j = planar_pose(-0.6, 0.0, 0.0, MOUNT), planar_pose(-0.5, 0.1, 0.35, MOUNT)
    first, second = (photograph(empty, CAMERA, p, samples=3).pixels for p in (pose_i, pose_j))
    h = true_homography(pose_i, pose_j, CAMERA, CAMERA)
    moved = cv2.warpPerspective(first, h, (200, 150), flags=cv2.INTER_LINEAR)
    inside = cv2.warpPerspective(np.ones((150, 200), np.uint8), h, (200, 150)) > 0
    inside[:60] = False  # far ground is blurred differently
    difference = np.abs(moved.astype(float) - second)[inside].mean()
    apart = np.abs(first.astype(float) - second)[inside].mean()
    assert difference < 6.0 < 0.4 * apart


def test_solids_cast_soft_shadows(scene: Scene) -> None:
    pose = planar_pose(-1.0, 0.05, 0.03, MOUNT)
    lit = photograph(
        make_scene(stone(np.random.default_rng(5)), rng=np.random.default_rng(1)), CAMERA, pose
    )
    shaded = photograph(scene, CAMERA, pose)
    ground = shaded.solids == -1
    ratio = shaded.pixels[ground].mean(axis=1) / np.maximum(lit.pixels[ground].mean(axis=1), 1)
    assert np.median(ratio) > 0.9
    assert np.percentile(ratio, 1) < 0.6


def test_paths_have_their_spacing() -> None:
    ring = circle(8, 1.5)
    assert [np.hypot(s.x, s.y) for s in ring] == pytest.approx([1.5] * 8)
    for stop in ring:  # each looks at the middle
        assert stop.x + 1.5 * np.cos(stop.yaw) == pytest.approx(0, abs=1e-12)
        assert stop.y + 1.5 * np.sin(stop.yaw) == pytest.approx(0, abs=1e-12)
    assert np.diff([s.x for s in line(5, 0.3)]) == pytest.approx([0.3] * 4)
    field = mower(9, 0.2, 3)
    steps = [np.hypot(b.x - a.x, b.y - a.y) for a, b in pairwise(field)]
    assert steps == pytest.approx([0.2] * 8)
    assert len({round(s.y, 9) for s in field}) == 3


def test_shaking_varies_as_much_as_it_says() -> None:
    rng = np.random.default_rng(3)
    held = [mount_of(p) for p in poses(line(400, 0.1), MOUNT, np.radians(2.0), rng)]
    assert np.degrees(np.std([m.tilt for m in held])) == pytest.approx(2.0, abs=0.3)
    assert np.degrees(np.std([m.roll for m in held])) == pytest.approx(2.0, abs=0.3)
    assert np.std([m.height for m in held]) == pytest.approx(0.6 * np.radians(2.0), rel=0.2)


def test_shared_ground_and_sampling() -> None:
    down = Mount(np.pi / 2, 0.0, 1.0)
    here = planar_pose(0, 0, 0, down)
    assert shared_ground(CAMERA, here, here) == 1.0
    # straight down the picture is 150 / 170 m long: a third of that is a third less
    ahead = planar_pose(50 / 170, 0, 0, down)
    assert shared_ground(CAMERA, here, ahead) == pytest.approx(2 / 3, abs=0.05)
    assert shared_ground(CAMERA, here, planar_pose(5, 0, 0, down)) == 0.0
    assert ground_sampling(CAMERA, down) == pytest.approx((1 / 170, 1 / 170))


@pytest.mark.parametrize("name", TEXTURES)
def test_textures_are_periodic_and_have_contrast(name: str) -> None:
    texture = TEXTURES[name](np.random.default_rng(0)).astype(float)
    assert texture.std() > 12
    seam = np.abs(texture[:, 0] - texture[:, -1]).mean()
    inner = np.abs(np.diff(texture, axis=1)).mean(axis=(0, 2)).max()  # joints are edges too
    assert seam < 1.5 * inner


def synth(folder: Path, *arguments: str) -> int:
    small = ("--size", "96x72", "--images", "4", "-q")
    return run(["synth", str(folder), *small, *arguments])


def digest(folder: Path) -> dict[str, str]:
    return {
        str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in sorted(folder.rglob("*"))
        if p.is_file()
    }


def test_the_seed_fixes_every_byte(tmp_path: Path) -> None:
    for name, seed in (("a", "1"), ("b", "1"), ("c", "2")):
        assert synth(tmp_path / name, "--seed", seed, "--shake", "1") == 0
    same, other = digest(tmp_path / "b"), digest(tmp_path / "c")
    assert digest(tmp_path / "a") == same
    assert same["images/A/0000.jpg"] != other["images/A/0000.jpg"]
    assert same["A.tum"] != other["A.tum"]


def test_configuration_and_truth_belong_together(tmp_path: Path) -> None:
    folder = tmp_path / "set"
    arguments = ("--robots", "2", "--roll", "5", "--shake", "1", "--distortion=-0.1,0.01,0,0")
    assert synth(folder, *arguments) == 0
    dataset = open_dataset(load_config(folder / "config.yaml"))
    truth = json.loads((folder / "groundtruth.json").read_text())
    assert [e.image_id for e in dataset.entries] == [row["image"] for row in truth["images"]]
    rows = [pose for robot in "AB" for _, pose in read_tum(folder / f"{robot}.tum")]
    for row, pose, entry in zip(truth["images"], rows, dataset.entries, strict=True):
        camera_from_map = Pose(np.array(row["R"]), np.array(row["t"]))
        assert np.allclose(camera_from_map.inverse().rotation, pose.rotation)
        assert np.allclose(row["C"], pose.translation)
        assert np.allclose(row["K"], entry.camera.matrix)
        held = mount_of(pose)
        assert held.tilt == pytest.approx(entry.mount.tilt, abs=np.radians(5))
        assert held.height == pytest.approx(entry.mount.height, rel=0.1)
    low, high = _bounds(truth)
    surface = trimesh.load(folder / "obstacles.ply", process=False)
    assert np.allclose(surface.bounds, (low, high), atol=1e-6)
    assert surface.is_watertight


def _bounds(truth: dict[str, list[dict[str, list[float]]]]) -> tuple[Float, Float]:
    low = np.min([o["bbox_min"] for o in truth["obstacles"]], axis=0)
    return low, np.max([o["bbox_max"] for o in truth["obstacles"]], axis=0)


def test_known_trajectories_are_followed(tmp_path: Path) -> None:
    assert synth(tmp_path / "a", "--path", "mower", "--empty") == 0
    assert synth(tmp_path / "b", "--path", str(tmp_path / "a" / "A.tum"), "--empty") == 0
    led, followed = (read_tum(tmp_path / name / "A.tum") for name in "ab")
    for (_, pose), (_, same) in zip(led, followed, strict=True):
        assert np.allclose(pose.rotation, same.rotation, atol=1e-12)
        assert np.allclose(pose.translation, same.translation, atol=1e-12)
    assert json.loads((tmp_path / "b" / "groundtruth.json").read_text())["obstacles"] == []


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (("--box", "0,0,1"), 2),
        (("--sphere", "0,0,-1"), 2),
        (("--empty", "--sphere", "0,0,1"), 2),
        (("--size", "640"), 2),
        (("--distortion", "0.1"), 2),
        (("--path", "nowhere.tum"), 4),
        (("--ground", "nothing.jpg"), 4),
    ],
)
def test_mistakes_end_with_their_code(
    tmp_path: Path, arguments: tuple[str, ...], code: int
) -> None:
    assert synth(tmp_path / "x", *arguments) == code
    assert not (tmp_path / "x").exists()


def test_a_folder_with_content_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("keep")
    assert synth(tmp_path) == 6
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]
