"""Error measures against formulas written out here, and the commands against known answers."""

import json
import os
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from gvpipe.cli import run
from gvpipe.commands.trajectories import Trajectory, associate, read_trajectory
from gvpipe.core.evaluation.homography_error import (
    LOST_PX,
    ground_homography,
    homography_errors,
)
from gvpipe.core.evaluation.homography_error import common_ground as shared_pixels
from gvpipe.core.evaluation.mesh_error import Surface, sample_surface, surface_errors, volume_iou
from gvpipe.core.evaluation.trajectory_error import (
    Alignment,
    Similarity,
    absolute_errors,
    align,
    path_length,
    relative_errors,
    statistics,
)
from gvpipe.core.geometry.ground import pixel_from_plane
from gvpipe.core.geometry.homography import apply, transfer_errors
from gvpipe.core.geometry.pose import planar_pose
from gvpipe.core.synthesis.solids import Solid
from gvpipe.core.types import Mount, Pose, Rejected
from gvpipe.errors import InputError
from gvpipe.formats.calibration import Calibration
from gvpipe.formats.colmap import (
    PosedImage,
    format_cameras,
    format_images,
    read_cameras,
    read_images,
)
from gvpipe.formats.kitti import format_kitti, read_kitti
from gvpipe.formats.ply import read_mesh
from gvpipe.formats.tum import format_tum
from tests.conftest import TinySet
from tests.synthetic import CAMERA, common_ground, true_homography


def walk(seed: int, count: int = 30) -> list[Pose]:
    rng = np.random.default_rng(seed)
    turns = Rotation.from_rotvec(np.cumsum(rng.normal(scale=0.1, size=(count, 3)), axis=0))
    places = np.cumsum(rng.normal(scale=0.3, size=(count, 3)), axis=0)
    return [Pose(r, t) for r, t in zip(turns.as_matrix(), places, strict=True)]


def disturbed(poses: list[Pose], seed: int) -> list[Pose]:
    rng = np.random.default_rng(seed)
    return [
        Pose(
            p.rotation @ Rotation.from_rotvec(rng.normal(scale=0.02, size=3)).as_matrix(),
            p.translation + rng.normal(scale=0.05, size=3),
        )
        for p in poses
    ]


def matrices(poses: list[Pose]) -> np.ndarray:
    out = np.tile(np.eye(4), (len(poses), 1, 1))
    for m, p in zip(out, poses, strict=True):
        m[:3, :3], m[:3, 3] = p.rotation, p.translation
    return out


def angles(rotations: np.ndarray) -> np.ndarray:
    trace = np.trace(rotations, axis1=-2, axis2=-1)
    return np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))


def test_absolute_errors_are_evos() -> None:
    true = walk(1)
    found = disturbed(true, 2)
    q, p = matrices(true), matrices(found)
    e = np.linalg.inv(q) @ p  # E_i = Q_i^-1 P_i
    errors = absolute_errors(found, true)
    assert errors.translation_m == pytest.approx(np.linalg.norm(e[:, :3, 3], axis=1))
    assert errors.rotation_deg == pytest.approx(angles(e[:, :3, :3]), abs=1e-6)


@pytest.mark.parametrize(("delta", "all_pairs"), [(1, False), (4, False), (4, True)])
def test_relative_errors_are_evos(delta: int, all_pairs: bool) -> None:
    true = walk(3)
    found = disturbed(true, 4)
    q, p = matrices(true), matrices(found)
    starts = np.arange(0, 30 - delta, 1 if all_pairs else delta)
    motion_q = np.linalg.inv(q[starts]) @ q[starts + delta]
    motion_p = np.linalg.inv(p[starts]) @ p[starts + delta]
    e = np.linalg.inv(motion_q) @ motion_p
    errors = relative_errors(found, true, delta, all_pairs=all_pairs)
    assert errors.translation_m == pytest.approx(np.linalg.norm(e[:, :3, 3], axis=1))
    assert errors.rotation_deg == pytest.approx(angles(e[:, :3, :3]), abs=1e-6)


def test_statistics() -> None:
    shown = statistics(np.array([3.0, 4.0, 5.0]))
    assert shown == pytest.approx(
        {
            "rmse": np.sqrt(50 / 3),
            "mean": 4,
            "median": 4,
            "std": np.sqrt(2 / 3),
            "min": 3,
            "max": 5,
            "sse": 50,
        }
    )
    straight = [Pose(np.eye(3), np.array([x, 0.0, 0.0])) for x in (0, 3, 1)]
    assert path_length(straight) == pytest.approx(5.0)


FITS = {
    "none": Similarity(1.0, np.eye(3), np.zeros(3)),
    "yaw": Similarity(1.0, Rotation.from_euler("z", 0.7).as_matrix(), np.array([1.0, -2, 0.5])),
    "origin": Similarity(
        1.0, Rotation.from_rotvec([0.3, 0.2, -1]).as_matrix(), np.array([1.0, -2, 0.5])
    ),
    "se3": Similarity(
        1.0, Rotation.from_rotvec([0.3, 0.2, -1]).as_matrix(), np.array([1.0, -2, 0.5])
    ),
    "sim3": Similarity(
        1.7, Rotation.from_rotvec([0.3, 0.2, -1]).as_matrix(), np.array([1.0, -2, 0.5])
    ),
}


@pytest.mark.parametrize("how", get_args(Alignment))
def test_alignment_undoes_what_it_may(how: str) -> None:
    found = walk(5)
    true = [FITS[how].pose(pose) for pose in found]
    fit = align(found, true, how)  # type: ignore[arg-type]
    assert isinstance(fit, Similarity)
    errors = absolute_errors([fit.pose(pose) for pose in found], true)
    assert errors.translation_m.max() < 1e-9
    assert errors.rotation_deg.max() < 1e-5
    assert fit.scale == pytest.approx(FITS[how].scale)


@pytest.mark.parametrize("how", ["yaw", "se3", "sim3"])
def test_alignment_is_a_minimum(how: str) -> None:
    true = walk(6)
    found = disturbed(true, 7)
    fit = align(found, true, how)  # type: ignore[arg-type]
    assert isinstance(fit, Similarity)

    def cost(f: Similarity) -> float:
        gaps = [f.pose(a).translation - b.translation for a, b in zip(found, true, strict=True)]
        return float((np.array(gaps) ** 2).sum())

    best = cost(fit)
    for k in range(3):
        for step in (-1e-3, 1e-3):
            move = step * np.eye(3)[k]
            turn = Rotation.from_rotvec(move if how != "yaw" else [0, 0, step]).as_matrix()
            assert cost(Similarity(fit.scale, fit.rotation, fit.translation + move)) > best
            middle = fit.points(np.array([p.translation for p in found])).mean(axis=0)
            about = turn @ (fit.translation - middle) + middle
            assert cost(Similarity(fit.scale, turn @ fit.rotation, about)) > best


def test_a_line_leaves_the_rotation_open_but_not_the_heading() -> None:
    straight = [Pose(np.eye(3), np.array([x, 2 * x, 0.0])) for x in range(5)]
    assert isinstance(align(straight, straight, "se3"), Rejected)
    assert isinstance(align(straight, straight, "yaw"), Similarity)
    still = [straight[0]] * 4
    assert isinstance(align(still, still, "yaw"), Rejected)


def test_times_are_paired_once_and_nearest() -> None:
    here = walk(1, 4)
    a = Trajectory("a", tuple(here), stamps=(0.0, 1.0, 2.0, 2.004))
    b = Trajectory("b", tuple(here), stamps=(2.003, 0.005, 3.0, 1.001))
    assert associate(a, b, 0.01) == [(0, 1), (1, 3), (3, 0)]


def test_names_are_paired_by_what_makes_them_unique() -> None:
    here = tuple(walk(1, 2))
    a = Trajectory("a", here, names=("A/0.jpg", "B/0.jpg"))
    b = Trajectory("b", here, names=("set/images/B/0.jpg", "set/images/A/0.jpg"))
    assert associate(a, b, 0.0) == [(0, 1), (1, 0)]
    with pytest.raises(InputError, match=r"\(A/0\.jpg and x begin them\); expected the same names"):
        associate(a, Trajectory("c", here, names=("x", "y")), 0.0)
    timed = [Trajectory(names[0], here, stamps=(0.0, 1.0), names=names) for names in ("pq", "xy")]
    assert associate(*timed, 0.01) == [(0, 0), (1, 1)]


def test_robots_called_otherwise_are_paired_in_their_order() -> None:
    here = tuple(walk(1, 3))
    a = Trajectory("a", here, names=("A/0.jpg", "B/0.jpg", "B/1.jpg"))
    b = Trajectory("b", here, names=("left/0.jpg", "right/1.jpg", "right/0.jpg"))
    assert associate(a, b, 0.0) == [(0, 0), (1, 2), (2, 1)]
    one = Trajectory("c", here[:2], names=("left/0.jpg", "left/1.jpg"))
    with pytest.raises(InputError, match=r"A/0\.jpg and left/0\.jpg begin them"):
        associate(a, one, 0.0)


def test_times_far_apart_are_named() -> None:
    here = tuple(walk(1, 2))
    a, b = (Trajectory("x", here, stamps=(start, start + 1)) for start in (0.0, 100.0))
    with pytest.raises(InputError, match=r"within 0\.01 s of each other; 0\.0 and 100\.0 s begin"):
        associate(a, b, 0.01)


def test_kitti_and_colmap_round_trips(tmp_path: Path) -> None:
    poses = walk(8, 6)
    (tmp_path / "k.txt").write_text(format_kitti(poses))
    images = [PosedImage(f"a b/{k}.jpg", 1, pose) for k, pose in enumerate(poses)]
    (tmp_path / "images.txt").write_text(format_images(images))
    camera = Calibration(640, 480, 500.0, 510.0, 319.5, 239.5, 0.0, (0.1, -0.2, 0.0, 0.001))
    cameras = {1: camera, 2: Calibration(64, 48, 50.0, 51.0, 31.5, 23.5)}
    (tmp_path / "cameras.txt").write_text(format_cameras(cameras))
    assert read_cameras(tmp_path / "cameras.txt") == cameras
    back = read_images(tmp_path / "images.txt")
    assert [i.name for i in back] == [i.name for i in images]
    for again in (read_kitti(tmp_path / "k.txt"), [i.map_from_camera for i in back]):
        for p, q in zip(poses, again, strict=True):
            assert np.allclose(p.rotation, q.rotation)
            assert np.allclose(p.translation, q.translation)
    assert "PINHOLE 64 48 50.0 51.0 32.0 24.0" in (tmp_path / "cameras.txt").read_text()


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("k.txt", "1 0 0 0 0 1 0 0 0 0 1\n"),
        ("k.txt", "1 0 0 0 0 1 0 0 0 0 2 nan\n"),
        ("k.txt", "2 0 0 0 0 1 0 0 0 0 1 0\n"),
        ("images.txt", "1 1 0 0 0 0 0 x 1 a.jpg\n\n"),
        ("images.txt", "1 0 0 0 0 0 0 0 1 a.jpg\n\n"),
        ("slam.json", '{"poses": [{"image": "a"}]}'),
        ("slam.json", "[]"),
        ("slam.json", '{"images": 3}'),
        ("t.tum", ""),
    ],
)
def test_damaged_files_are_named(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    if name == "k.txt":
        with pytest.raises(InputError, match=name):
            read_kitti(tmp_path / name)
    else:
        with pytest.raises(InputError, match=r"slam|images|t\.tum|" + tmp_path.name):
            read_trajectory(tmp_path / name)


def box(x: float, size: float = 1.0) -> Surface:
    surface = Solid("box", x, 0.0, (size, size, size)).surface
    return Surface(surface.vertices, surface.faces)


@pytest.mark.parametrize("name", ["slam.json", "a.txt", "a.ply"])
def test_pipes_are_not_waited_for(tmp_path: Path, name: str) -> None:
    os.mkfifo(tmp_path / name)
    with pytest.raises(InputError, match=f"{name}: is not a regular file"):
        (read_mesh if name == "a.ply" else read_trajectory)(tmp_path / name)


def test_samples_lie_evenly_on_the_surface() -> None:
    points = sample_surface(box(0), 20_000, np.random.default_rng(0))
    on = np.isclose(np.abs(points[:, :2]), 0.5).any(axis=1) | np.isclose(
        points[:, 2] * (1 - points[:, 2]), 0
    )
    assert on.all()
    assert np.isclose(points[:, 2], 1).mean() == pytest.approx(1 / 6, abs=0.01)
    assert points.mean(axis=0) == pytest.approx((0, 0, 0.5), abs=0.01)


def test_surface_errors_of_parallel_planes() -> None:
    g = np.stack(np.meshgrid(np.arange(40.0), np.arange(40.0)), axis=-1).reshape(-1, 2) * 0.01
    truth = np.column_stack([g, np.zeros(len(g))])
    half = np.column_stack([g[: len(g) // 2], np.full(len(g) // 2, 0.004)])
    errors = surface_errors(half, truth, 0.005)
    assert errors.precision == 1.0
    assert errors.recall == pytest.approx(0.5, abs=0.03)
    assert errors.fscore == pytest.approx(2 / 3, abs=0.03)
    assert errors.accuracy_p90_m == pytest.approx(0.004)
    assert surface_errors(half + 10, truth, 0.005).fscore == 0.0


@pytest.mark.parametrize(("shift", "iou"), [(0.0, 1.0), (0.5, 1 / 3), (2.0, 0.0)])
def test_volumes_in_common(shift: float, iou: float) -> None:
    assert volume_iou(box(0), box(shift), 0.02) == pytest.approx(iou, abs=0.02)


def test_overlapping_parts_count_once() -> None:
    a, b = box(0), box(0.5)
    both = Surface(np.concatenate([a.vertices, b.vertices]), np.concatenate([a.faces, b.faces + 8]))
    whole = Solid("box", 0.25, 0.0, (1.5, 1.0, 1.0)).surface
    assert volume_iou(both, Surface(whole.vertices, whole.faces), 0.02) == pytest.approx(
        1, abs=0.02
    )
    with pytest.raises(ValueError, match="cells"):
        volume_iou(a, b, 1e-4)


def test_curved_volumes_agree_with_trimesh() -> None:
    a, b = (trimesh.creation.icosphere(3, r) for r in (0.5, 0.4))
    found = volume_iou(Surface(a.vertices, a.faces), Surface(b.vertices, b.faces), 0.02)
    assert found == pytest.approx(b.volume / a.volume, abs=0.01)


def test_trajectory_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    true = walk(9)
    turned = [FITS["yaw"].pose(pose) for pose in true]
    (tmp_path / "true.tum").write_text(format_tum(enumerate(true)))  # type: ignore[arg-type]
    (tmp_path / "found.txt").write_text(format_kitti(turned))
    arguments = [str(tmp_path / "found.txt"), str(tmp_path / "true.tum")]
    out = ["--json", str(tmp_path / "out.json")]
    assert run(["evaluate", "trajectory", *arguments, *out]) == 0
    document = json.loads((tmp_path / "out.json").read_text())
    assert document["pairs"] == 30
    assert document["ate"]["translation_m"]["rmse"] < 1e-9
    assert document["rpe"]["rotation_deg"]["max"] < 1e-4
    assert "ATE, m" in capsys.readouterr().out
    far = ["--align", "none", "--delta", "12", *out]
    assert run(["evaluate", "trajectory", *arguments, *far]) == 0
    said = capsys.readouterr().out.splitlines()
    assert [line for line in said if line.startswith(("ATE, °", "RPE over 12, °"))]
    # paths are never folded; all else fits a narrow terminal, whatever the errors
    assert max(len(line) for line in said if not line.startswith("wrote")) <= 72
    assert json.loads((tmp_path / "out.json").read_text())["ate"]["translation_m"]["rmse"] > 1
    assert run(["evaluate", "trajectory", str(tmp_path / "nothing"), arguments[1]]) == 4
    assert run(["evaluate", "trajectory", *arguments, "--align", "magic"]) == 2


def test_mesh_command(tmp_path: Path) -> None:
    a = trimesh.Trimesh(box(0).vertices * [1.0, 2.0, 3.0], box(0).faces)
    a.export(tmp_path / "a.ply")
    turn = trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0])
    a.apply_transform(turn).export(tmp_path / "a.glb")  # y up
    out = ["--json", str(tmp_path / "out.json"), "-q"]
    files = [str(tmp_path / "a.ply"), str(tmp_path / "a.glb")]
    assert run(["evaluate", "mesh", *files, "--spacing", "0.05", "--tolerance", "0.05", *out]) == 0
    document = json.loads((tmp_path / "out.json").read_text())
    assert document["fscore"] > 0.99
    assert document["iou"] == pytest.approx(1.0)
    (tmp_path / "bad.ply").write_text("ply\nnonsense")
    assert run(["evaluate", "mesh", str(tmp_path / "bad.ply"), files[0]]) == 4
    assert run(["evaluate", "mesh", *files, "--poses", files[0]]) == 2


def test_homography_errors_are_the_pixels_by_which_the_ground_is_off() -> None:
    i = CAMERA, planar_pose(0.0, 0.0, 0.0, Mount(0.6, 0.05, 0.6))
    j = CAMERA, planar_pose(0.2, 0.1, 0.3, Mount(0.7, -0.02, 0.5))
    pixels = shared_pixels(i, j)
    true = ground_homography(i, j)
    ground = np.linalg.inv(pixel_from_plane(*i))
    np.testing.assert_allclose(
        apply(true, pixels), apply(pixel_from_plane(*j), apply(ground, pixels)), atol=1e-9
    )
    assert homography_errors(true, i, j, pixels).max() < 1e-9
    shift = np.array([[1.0, 0.0, 3.0], [0.0, 1.0, -4.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(homography_errors(shift @ true, i, j, pixels), 5.0, atol=1e-9)
    lost = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    assert (homography_errors(lost, i, j, pixels) == LOST_PX).all()
    # what both see is near, below the horizon and in both pictures
    assert len(pixels) > 400
    seen = apply(true, pixels)
    assert (seen >= 0).all()
    assert (seen <= [CAMERA.width - 1, CAMERA.height - 1]).all()
    behind = CAMERA, planar_pose(-5.0, 0.0, np.pi, Mount(0.7, 0.0, 0.5))
    assert not len(shared_pixels(i, behind))


def test_homography_command(chain: TinySet, tmp_path: Path) -> None:
    k = CAMERA.matrix.tolist()
    rows = []
    for image, pose in chain.poses.items():
        there = pose.inverse()
        rows.append({"image": image, "K": k, "width": CAMERA.width, "height": CAMERA.height})
        rows[-1] |= {"R": there.rotation.tolist(), "t": there.translation.tolist()}
    (tmp_path / "truth.json").write_text(json.dumps({"images": rows}))
    match, out = chain.out() / "match", tmp_path / "out.json"
    arguments = [str(match), str(tmp_path / "truth.json"), "--json", str(out)]
    assert run(["evaluate", "homography", *arguments]) == 0
    document = json.loads(out.read_text())
    matched = json.loads((match / "match.json").read_text())["pairs"]
    assert len(document["pairs"]) == len(matched)
    for row, pair in zip(document["pairs"], matched, strict=True):
        i, j = chain.poses[pair["image_i"]], chain.poses[pair["image_j"]]
        points = common_ground(true_homography(i, j, CAMERA, CAMERA), i, CAMERA, CAMERA)
        wanted = transfer_errors(
            np.array(pair["H"]), points, apply(true_homography(i, j, CAMERA, CAMERA), points)
        )
        assert row["mean_px"] == pytest.approx(wanted.mean(), rel=0.02)
