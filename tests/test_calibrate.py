"""Calibration against cameras that are known: by boards, by the ground, and through files."""

from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import pytest

from gvpipe.cli import run
from gvpipe.core.calibration.board import Board, BoardView, calibrate_board, find_board
from gvpipe.core.calibration.circular_points import metric_residuals, spanning_tree
from gvpipe.core.calibration.common_plane import ground_pairs
from gvpipe.core.calibration.plane_cameras import (
    FARTHEST,
    GLOBALS,
    Matches,
    distort,
    jacobian,
    ray_from_ground,
    undistort,
)
from gvpipe.core.calibration.raw_matching import PlanePair, match_planes, raw_features
from gvpipe.core.calibration.self_calibration import SelfCalibration, self_calibrate
from gvpipe.core.geometry.ground import pixel_from_plane
from gvpipe.core.geometry.pose import planar_pose
from gvpipe.core.types import Camera, Float, Image, Mount, Pose, Rejected
from gvpipe.formats.calibration import Calibration, read_calibration
from gvpipe.formats.calibration_writers import WRITERS
from gvpipe.formats.colmap import read_cameras
from gvpipe.formats.jpeg import jpeg_bytes
from tests.synthetic import Scene, texture, true_homography

WIDTH, HEIGHT, FOCAL = 640, 480, 610.0
CAMERA = Camera(WIDTH, HEIGHT, FOCAL, FOCAL, 319.5, 239.5)
UNIT = Camera(2, 2, 1.0, 1.0, 0.0, 0.0)


def carried(count: int, rng: np.random.Generator, turn: float = 40.0) -> list[tuple[Pose, Mount]]:
    """Cameras held by hand round a place they look at."""
    cameras = []
    for k in range(count):
        tilt, roll = np.radians(45 + rng.normal(scale=5)), np.radians(rng.normal(scale=4))
        mount = Mount(float(tilt), float(roll), float(0.6 * np.exp(rng.normal(scale=0.05))))
        yaw = np.radians(turn * k)
        pose = planar_pose(-0.6 * np.cos(yaw), -0.6 * np.sin(yaw), float(yaw), mount)
        cameras.append((pose, mount))
    return cameras


def seen(points: Float, pose: Pose, lens: tuple[float, float] = (0.0, 0.0)) -> Float:
    """Pixels of map points (N, 3), projected by OpenCV."""
    there = pose.inverse()
    turn = cv2.Rodrigues(there.rotation)[0]
    lens4 = np.array([*lens, 0.0, 0.0])
    return cv2.projectPoints(points, turn, there.translation, CAMERA.matrix, lens4)[0][:, 0]


def ground_matches(
    poses: list[Pose], rng: np.random.Generator, lens: tuple[float, float], noise_px: float = 0.4
) -> list[PlanePair]:
    points = np.column_stack([rng.uniform(-0.7, 0.7, (300, 2)), np.zeros(300)])
    pixels = [seen(points, pose, lens) for pose in poses]
    inside = [((p > 0) & (p < [WIDTH, HEIGHT])).all(axis=1) for p in pixels]
    pairs = []
    for i, j in combinations(range(len(poses)), 2):
        both = inside[i] & inside[j]
        if both.sum() < 20:
            continue
        p, q = (
            v[both] + rng.normal(scale=noise_px, size=(both.sum(), 2))
            for v in (pixels[i], pixels[j])
        )
        homography = cv2.findHomography(p, q, cv2.RANSAC, 6.0)[0]
        pairs.append(PlanePair(i, j, np.asarray(homography), p, q))
    return pairs


def test_plane_cameras_agree_with_the_projection_of_the_chain() -> None:
    x, y, yaw, height, tilt, roll = 0.3, -0.2, 0.7, 0.6, 0.8, 0.1
    rows = np.array([[x, y, yaw, np.log(height), tilt, roll]])
    wanted = pixel_from_plane(UNIT, planar_pose(x, y, yaw, Mount(tilt, roll, height)))
    assert np.allclose(ray_from_ground(rows)[0], wanted)


def test_lens_distortion_is_opencvs_and_can_be_undone() -> None:
    rays = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 2))
    k = (-0.2, 0.05)
    points = np.column_stack([rays, np.ones(50)])
    zero, lens = np.zeros(3), np.array([*k, 0.0, 0.0])
    wanted = cv2.projectPoints(points, zero, zero, np.eye(3), lens)[0][:, 0]
    assert np.allclose(distort(rays, *k), wanted)
    assert np.allclose(undistort(distort(rays, *k), *k), rays, atol=1e-9)


@pytest.mark.parametrize("size", [1e3, 1e200])
@pytest.mark.parametrize("unknown", range(GLOBALS + 4))
def test_steps_gone_astray_cost_all_they_can_and_nothing_overflows(
    unknown: int, size: float
) -> None:
    rng = np.random.default_rng(5)
    held = np.array([0.0, 0.0, 0.0, 0.0, 0.8, 0.0])
    points = rng.uniform(-0.4, 0.4, (2, 30, 2))
    cameras = np.zeros(30, np.int64)
    matches = Matches(points[0], points[1], cameras, cameras + 1)
    for sign in (-1.0, 1.0):
        shared, poses = np.zeros(GLOBALS), np.stack([held, held])
        if unknown < GLOBALS:
            shared[unknown] = sign * size
        else:
            poses[1, unknown - GLOBALS] = sign * size
        error, *derivatives = jacobian(shared, poses, matches)
        assert (np.abs(error) <= FARTHEST).all()
        assert all(np.isfinite(part).all() for part in derivatives)


def test_true_cameras_have_no_residual() -> None:
    rng = np.random.default_rng(1)
    cameras = carried(5, rng)
    hs = np.array([true_homography(cameras[0][0], pose, CAMERA, CAMERA) for pose, _ in cameras])
    mount = cameras[0][1]
    truth = np.array([np.log(FOCAL / WIDTH), mount.tilt, mount.roll])
    assert np.abs(metric_residuals(truth, hs, (319.5, 239.5), WIDTH)).max() < 1e-9
    wrong = truth + np.array([0.1, 0.0, 0.0])
    assert np.abs(metric_residuals(wrong, hs, (319.5, 239.5), WIDTH)).max() > 1e-2


@pytest.mark.parametrize(("lens", "seed"), [((0.0, 0.0), 0), ((-0.2, 0.05), 1), ((0.25, -0.8), 2)])
def test_the_ground_gives_focal_length_lens_and_tilts(lens: tuple[float, float], seed: int) -> None:
    rng = np.random.default_rng(seed)
    cameras = carried(8, rng)
    pairs = ground_matches([pose for pose, _ in cameras], rng, lens)
    found = self_calibrate(pairs, 8, (WIDTH, HEIGHT), np.random.default_rng(0))
    assert isinstance(found, SelfCalibration)
    assert found.focal_px == pytest.approx(FOCAL, rel=0.02)
    assert abs(found.focal_px - FOCAL) < 4 * found.focal_sigma_px
    assert found.error_px < 1.0
    heights = np.array([mount.height for _, mount in cameras])
    for k, (_, mount) in enumerate(cameras):
        assert np.degrees(found.tilt[k] - mount.tilt) == pytest.approx(0, abs=0.7)
        assert np.degrees(found.roll[k] - mount.roll) == pytest.approx(0, abs=0.7)
        assert found.height[k] == pytest.approx(mount.height / np.median(heights), rel=0.02)
    r = 0.5  # towards the corner
    bend = found.k1 * r**2 + found.k2 * r**4
    assert bend == pytest.approx(lens[0] * r**2 + lens[1] * r**4, abs=0.01)


def test_the_same_seed_gives_the_same_calibration() -> None:
    rng = np.random.default_rng(3)
    pairs = ground_matches([pose for pose, _ in carried(6, rng)], rng, (0.0, 0.0))
    runs = [self_calibrate(pairs, 6, (WIDTH, HEIGHT), np.random.default_rng(5)) for _ in range(2)]
    assert runs[0] == runs[1]


def straight(count: int) -> list[Pose]:
    mount = Mount(np.radians(40), 0.0, 0.6)
    return [planar_pose(-0.9 + 0.06 * k, 0.0, 0.0, mount) for k in range(count)]


def straight_down(count: int) -> list[Pose]:
    mount = Mount(np.radians(90), 0.0, 0.8)
    return [planar_pose(0.02 * k, 0.0, 0.4 * k, mount) for k in range(count)]


@pytest.mark.parametrize("motion", [straight, straight_down])
def test_motions_that_leave_the_focal_length_open_are_refused(motion: object) -> None:
    rng = np.random.default_rng(2)
    pairs = ground_matches(motion(6), rng, (0.0, 0.0))  # type: ignore[operator]
    found = self_calibrate(pairs, 6, (WIDTH, HEIGHT), np.random.default_rng(0))
    assert isinstance(found, Rejected)
    assert "focal length" in found.reason


def test_two_pictures_are_too_few() -> None:
    rng = np.random.default_rng(2)
    pairs = ground_matches([pose for pose, _ in carried(2, rng)], rng, (0.0, 0.0))
    found = self_calibrate(pairs, 2, (WIDTH, HEIGHT), np.random.default_rng(0))
    assert isinstance(found, Rejected)
    assert isinstance(self_calibrate([], 2, (WIDTH, HEIGHT), rng), Rejected)


def test_the_ground_is_told_from_walls() -> None:
    rng = np.random.default_rng(4)
    poses = [pose for pose, _ in carried(6, rng, turn=25.0)]
    ground = ground_matches(poses, rng, (0.0, 0.0))
    wall = np.column_stack(
        [np.full(200, 0.5), rng.uniform(-0.6, 0.6, 200), rng.uniform(0, 0.8, 200)]
    )
    walls = []
    for pair in ground:
        p, q = seen(wall, poses[pair.i]), seen(wall, poses[pair.j])
        homography = np.asarray(cv2.findHomography(p, q)[0])
        # more matches on the wall than on the ground
        walls.append(PlanePair(pair.i, pair.j, homography, np.tile(p, (3, 1)), np.tile(q, (3, 1))))
    both = [plane for couple in zip(walls, ground, strict=True) for plane in couple]
    guess = Camera(WIDTH, HEIGHT, 0.87 * WIDTH, 0.87 * WIDTH, 319.5, 239.5)
    kept = ground_pairs(both, guess)
    assert len(kept) >= 0.8 * len(ground)
    assert sum(any(plane is pair for pair in ground) for plane in kept) >= 0.9 * len(kept)
    assert ground_pairs([], guess) == []


def test_pictures_match_without_any_calibration() -> None:
    rng = np.random.default_rng(6)
    scene = Scene(texture(rng, 768), extent=3.0)
    camera = Camera(320, 240, 300.0, 300.0, 159.5, 119.5)
    mount = Mount(np.radians(45), 0.0, 0.6)
    poses = [planar_pose(0, 0, 0, mount), planar_pose(0.1, 0.05, 0.3, mount)]
    features = [raw_features(scene.photograph(pose, camera, samples=2)) for pose in poses]
    planes = match_planes(0, 1, features[0], features[1], 0.32)
    assert isinstance(planes, list)
    h = true_homography(*poses, camera, camera)
    p = planes[0].points_i
    q = cv2.perspectiveTransform(p[:, None], h)[:, 0]
    assert np.median(np.linalg.norm(q - planes[0].points_j, axis=1)) < 0.5
    nothing = raw_features(np.full((64, 64, 3), 128, np.uint8))
    assert isinstance(match_planes(0, 1, nothing, features[0]), Rejected)


def test_the_tree_reaches_what_is_linked() -> None:
    rng = np.random.default_rng(7)
    pairs = ground_matches([pose for pose, _ in carried(5, rng)], rng, (0.0, 0.0), 0.0)
    pairs = [pair for pair in pairs if 4 not in (pair.i, pair.j)]
    reference, found = spanning_tree(pairs, 5)
    assert sorted(found) == [0, 1, 2, 3]
    assert np.allclose(found[reference], np.eye(3))


BOARD = Board(8, 6, 0.03)


def board_pictures(pattern: Image, size_m: tuple[float, float], turns: list[float]) -> list[Image]:
    """Photographs of a flat picture through CAMERA."""
    pictures = []
    h, w = pattern.shape[:2]
    place = np.diag([size_m[0] / w, size_m[1] / h, 1.0])
    place[:2, 2] = -np.array(size_m) / 2
    for k, turn in enumerate(turns):
        axis = np.array([np.cos(2.4 * k), np.sin(2.4 * k), 0.2])
        r = cv2.Rodrigues(axis * np.radians(turn))[0]
        t = np.array([0.03 * np.cos(k), 0.02 * np.sin(k), 0.45])
        pixel = CAMERA.matrix @ np.column_stack([r[:, :2], t]) @ place
        picture = cv2.warpPerspective(
            cv2.GaussianBlur(pattern, (0, 0), 1.5), pixel, (WIDTH, HEIGHT), borderValue=200
        )
        pictures.append(np.repeat(picture[..., None], 3, axis=2))
    return pictures


def chessboard() -> Image:
    squares = np.indices((BOARD.rows + 1, BOARD.columns + 1)).sum(axis=0) % 2
    picture = np.kron(squares, np.ones((80, 80))) * 200 + 20
    return np.pad(picture, 60, constant_values=220).astype(np.uint8)


def test_chessboards() -> None:
    scale = BOARD.square_m / 80
    pattern = chessboard()
    size = (pattern.shape[1] * scale, pattern.shape[0] * scale)
    pictures = board_pictures(pattern, size, [15, 25, 30, 20, 28])
    views = [find_board(picture, BOARD) for picture in pictures]
    assert all(isinstance(view, BoardView) for view in views)
    found = calibrate_board(views, (WIDTH, HEIGHT))  # type: ignore[arg-type]
    assert not isinstance(found, Rejected)
    assert found.matrix[0, 0] == pytest.approx(FOCAL, rel=0.01)
    assert found.matrix[1, 1] == pytest.approx(FOCAL, rel=0.01)
    assert found.matrix[:2, 2] == pytest.approx([319.5, 239.5], abs=4)
    assert found.error_px < 0.3
    flat = [find_board(p, BOARD) for p in board_pictures(pattern, size, [0.5, 0.4, 0.3])]
    assert isinstance(calibrate_board(flat, (WIDTH, HEIGHT)), Rejected)  # type: ignore[arg-type]
    assert isinstance(calibrate_board(views[:2], (WIDTH, HEIGHT)), Rejected)  # type: ignore[arg-type]
    assert isinstance(find_board(np.full((200, 200, 3), 90, np.uint8), BOARD), Rejected)


def test_charuco_boards_from_the_command_line(tmp_path: Path) -> None:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_250)
    pattern = cv2.aruco.CharucoBoard((8, 6), 0.03, 0.022, dictionary).generateImage((960, 720))
    photos = tmp_path / "photos"
    photos.mkdir()
    pictures = board_pictures(np.asarray(pattern), (0.24, 0.18), [15, 25, 30, 20, 28])
    for k, picture in enumerate(pictures):
        (photos / f"{k}.jpg").write_bytes(jpeg_bytes(picture))
    (photos / "note.txt").write_text("not a picture")
    arguments = ["--board", "8x6", "--square", "0.03", "--marker", "0.022"]
    out = tmp_path / "cam.yaml"
    assert run(["calibrate", "board", str(photos), *arguments, "--out", str(out), "-q"]) == 0
    assert read_calibration(out).fx == pytest.approx(FOCAL, rel=0.01)
    assert run(["calibrate", "board", str(photos), "--board", "9x9", "--square", "0.03"]) == 5
    assert run(["calibrate", "board", str(photos), "--board", "9", "--square", "0.03"]) == 2
    assert run(["calibrate", "board", str(tmp_path / "no"), *arguments]) == 4


LENSES = [(), (0.1, -0.2, 0.001, -0.002), (0.1, -0.2, 0.001, -0.002, 0.03)]


@pytest.mark.parametrize("lens", LENSES, ids=len)
@pytest.mark.parametrize("style", ["opencv", "ros", "kalibr", "colmap"])
def test_calibrations_come_back(tmp_path: Path, style: str, lens: tuple[float, ...]) -> None:
    camera = Calibration(640, 480, 500.123456789, 510.5, 319.5, 239.25, 0.0, lens)
    path = tmp_path / ("cameras.txt" if style == "colmap" else f"{style}.yaml")
    if style == "kalibr" and len(lens) > 4:
        with pytest.raises(ValueError, match="Kalibr"):
            WRITERS[style](camera, "cam0")
        return
    path.write_text(WRITERS[style](camera, "cam0"))
    back = read_cameras(path)[1] if style == "colmap" else read_calibration(path, "cam0")
    assert (back.width, back.height, back.fx, back.fy) == (640, 480, 500.123456789, 510.5)
    assert (back.cx, back.cy) == (319.5, 239.25)
    assert list(back.distortion)[: len(lens)] == list(lens)
    assert not any(back.distortion[len(lens) :])


def test_opencv_reads_what_is_written_for_it(tmp_path: Path) -> None:
    camera = Calibration(640, 480, 500.0, 510.5, 319.5, 239.25, 0.5, LENSES[2])
    path = tmp_path / "cam.yaml"
    path.write_text(WRITERS["opencv"](camera, "cam"))
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    k = storage.getNode("camera_matrix").mat()
    assert k.tolist() == [[500.0, 0.5, 319.5], [0.0, 510.5, 239.25], [0.0, 0.0, 1.0]]
    assert storage.getNode("distortion_coefficients").mat().ravel().tolist() == list(LENSES[2])
    assert storage.getNode("image_width").real() == 640
    storage.release()


def test_without_a_file_the_format_asked_for_is_printed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    camera = Calibration(640, 480, 500.0, 510.0, 319.5, 239.5, 0.0, LENSES[1])
    (tmp_path / "cameras.txt").write_text(WRITERS["colmap"](camera, ""))
    command = ["calibrate", "convert", str(tmp_path / "cameras.txt")]
    for style in WRITERS:
        assert run([*command, "--format", style]) == 0
        name = "cam0" if style == "kalibr" else "cam"
        assert WRITERS[style](camera, name).strip() in capsys.readouterr().out
    assert run(command) == 0
    assert WRITERS["gvpipe"](camera, "cam").strip() in capsys.readouterr().out


def test_conversion_from_the_command_line(tmp_path: Path) -> None:
    camera = Calibration(640, 480, 500.0, 510.0, 319.5, 239.5, 0.0, LENSES[1])
    first, second = tmp_path / "cameras.txt", tmp_path / "ros.yaml"
    first.write_text(WRITERS["colmap"](camera, ""))
    arguments = ["--format", "ros", "--out", str(second), "-q"]
    assert run(["calibrate", "convert", str(first), *arguments]) == 0
    assert read_calibration(second).fx == 500.0
    assert run(["calibrate", "convert", str(first), "--name", "7", "-q"]) == 3
    assert run(["calibrate", "convert", str(tmp_path / "none.yaml"), "-q"]) == 3
