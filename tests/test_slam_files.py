"""The map in other programs' formats, read back by parsers that share no code with the writers."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from gvpipe.core.geometry.distortion import photographed, undistorted
from gvpipe.core.geometry.pose import rotation_vector
from gvpipe.core.types import Camera, Float, Pose
from gvpipe.dataset import Dataset, ImageEntry
from gvpipe.errors import InputError
from gvpipe.formats.colmap import (
    PosedImage,
    SparsePoints,
    format_images,
    format_points,
    read_images,
)
from gvpipe.formats.g2o import RelativeEdge
from gvpipe.formats.kitti import read_kitti
from gvpipe.formats.tum import read_tum
from gvpipe.knownposes import known_poses
from gvpipe.pixels import PixelSource
from gvpipe.stages.slam_files import SlamEvidence, _pose_graph
from tests.conftest import TinySet
from tests.slam_scene import arc_path, make_scene


def matrix(quaternion: Float) -> Float:
    """Rotation of a quaternion (w, x, y, z), written out."""
    w, x, y, z = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def colmap_errors_px(folder: Path) -> Float:
    """Reproject a COLMAP text model of pinhole cameras by its definition."""
    rows = {
        name: [x.split() for x in (folder / name).read_text().splitlines() if x[:1] != "#"]
        for name in ("cameras.txt", "images.txt", "points3D.txt")
    }
    cameras = {r[0]: np.array(r[4:], float) for r in rows["cameras.txt"]}
    points = {r[0]: np.array(r[1:4], float) for r in rows["points3D.txt"]}
    errors, seen = [], set()
    for head, features in zip(rows["images.txt"][::2], rows["images.txt"][1::2], strict=True):
        q, t = np.array(head[1:5], float), np.array(head[5:8], float)
        fx, fy, cx, cy = cameras[head[8]]
        for k, (u, v, point) in enumerate(np.array(features).reshape(-1, 3)):
            x, y, z = matrix(q) @ points[point] + t
            errors.append([fx * x / z + cx - float(u), fy * y / z + cy - float(v)])
            seen.add((point, head[0], str(k)))
    listed = {
        (r[0], image, k)
        for r in rows["points3D.txt"]
        for image, k in zip(r[8::2], r[9::2], strict=True)
    }
    assert listed == seen
    return np.array(errors)


def test_the_colmap_model_reprojects(chain: TinySet) -> None:
    errors = colmap_errors_px(chain.out() / "slam")
    assert len(errors) > 1000
    assert np.median(np.abs(errors)) < 0.3
    assert np.abs(np.median(errors, axis=0)).max() < 0.05  # half a pixel off would show here


def test_colmap_reads_the_model(chain: TinySet) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    model = pycolmap.Reconstruction(str(chain.out() / "slam"))
    assert model.num_reg_images() == len(chain.poses)
    assert model.compute_mean_reprojection_error() < 1.0
    document = chain.document("slam")
    rows = {row["image"]: row for row in document["poses"]}  # type: ignore[attr-defined]
    for image in model.images.values():
        centre = image.projection_center()
        np.testing.assert_allclose(centre, rows[image.name]["t"], atol=1e-9)
    # the same errors as by our own parser
    ours = np.linalg.norm(colmap_errors_px(chain.out() / "slam"), axis=1)
    theirs = [
        np.linalg.norm(image.project_point(model.points3D[feature.point3D_id].xyz) - feature.xy)
        for image in model.images.values()
        for feature in image.points2D
    ]
    assert np.mean(theirs) == pytest.approx(ours.mean(), rel=1e-6)


def read_g2o(path: Path) -> tuple[dict[int, Pose], list[RelativeEdge]]:
    """Vertices and edges of a sound pose graph."""
    vertices: dict[int, Pose] = {}
    edges = []
    for kind, *words in map(str.split, path.read_text().splitlines()):
        keys = {"VERTEX_SE3:QUAT": 1, "EDGE_SE3:QUAT": 2}[kind]
        ids, values = [int(word) for word in words[:keys]], np.array(words[keys:], dtype=float)
        pose = Pose(matrix(values[[6, 3, 4, 5]]), values[:3])
        if keys == 1:
            vertices[ids[0]] = pose
        else:
            upper = np.zeros((6, 6))
            upper[np.triu_indices(6)] = values[7:]
            edges.append(RelativeEdge(*ids, pose, upper + np.triu(upper, 1).T))
    return vertices, edges


def test_all_trajectories_say_the_same(chain: TinySet) -> None:
    folder = chain.out() / "slam"
    vertices, edges = read_g2o(folder / "map.g2o")
    document = chain.document("slam")
    rows = list(document["poses"])  # type: ignore[call-overload]
    tum = [pose for robot in "AB" for _, pose in read_tum(folder / f"{robot}.tum")]
    kitti = [pose for robot in "AB" for pose in read_kitti(folder / f"{robot}.kitti.txt")]
    colmap = [image.map_from_camera for image in read_images(folder / "images.txt")]
    for poses in (list(vertices.values()), tum, kitti, colmap):
        for row, pose in zip(rows, poses, strict=True):
            np.testing.assert_allclose(pose.rotation, row["R"], atol=1e-12)
            np.testing.assert_allclose(pose.translation, row["t"], atol=1e-12)
    assert len(edges) == len(document["edges"])  # type: ignore[arg-type]
    for edge in edges:
        expected = vertices[edge.i].inverse() @ vertices[edge.j]
        assert np.linalg.norm(edge.i_from_j.translation - expected.translation) < 0.03
        assert (np.linalg.eigvalsh(edge.information) > 0).all()


def test_the_information_of_the_pose_graph_is_honest(tmp_path: Path) -> None:
    squares = []
    for seed in range(6):
        scene = make_scene({"A": arc_path(6)}, np.random.default_rng(seed), density=50.0)
        entries = tuple(
            ImageEntry(
                image, "A", camera, scene.mounts[image], "", 0, None,
                PixelSource(Path(image), None, "", camera, ()),
            )
            for image, camera in scene.cameras.items()
        )  # fmt: skip
        path = tmp_path / "map.g2o"
        path.write_text(
            _pose_graph(scene.poses, SlamEvidence(Dataset(entries), tuple(scene.links)))
        )
        vertices, edges = read_g2o(path)
        for edge in edges:
            error = edge.i_from_j.inverse() @ vertices[edge.i].inverse() @ vertices[edge.j]
            e = np.append(error.translation, np.sin(rotation_vector(error.rotation) / 2))
            squares.append(e @ edge.information @ e / 6)
    assert 0.8 < np.mean(squares) < 1.3


def test_known_poses_come_from_a_colmap_model(tmp_path: Path) -> None:
    poses = list(make_scene({"A": arc_path(3)}, np.random.default_rng(1)).poses.values())
    ids = ["A/1.jpg", "A/2.jpg", "A/3.jpg"]
    for names in (["x/3.jpg", "x/1.jpg", "x/2.jpg"], ["A/3.jpg", "A/1.jpg", "A/2.jpg"]):
        order = [poses[2], poses[0], poses[1]]
        images = [PosedImage(n, 1, p) for n, p in zip(names, order, strict=True)]
        (tmp_path / "images.txt").write_text(format_images(images))
        for source in (tmp_path, tmp_path / "images.txt"):
            heights = dict(zip(ids, (pose.translation[2] for pose in poses), strict=True))
            known = known_poses(source, tmp_path, heights)
            for image_id, pose in zip(ids, poses, strict=True):
                np.testing.assert_allclose(
                    known[image_id].translation, pose.translation, atol=1e-12
                )
    with pytest.raises(InputError, match=r"images\.txt: no pose of A/4\.jpg"):
        known_poses(tmp_path, tmp_path, {"A/4.jpg": 1.0})


def test_points_name_their_features(tmp_path: Path) -> None:
    points = SparsePoints(
        position=np.array([[1.0, 2.0, 0.0], [3.0, 4.0, 0.0]]),
        error_px=np.array([0.1, 0.2]),
        start=np.array([0, 2, 4]),
        image=np.array([0, 1, 0, 1]),
        pixel=np.array([[0.0, 0.0], [1.0, 1.0], [2.0, 2.0], [3.0, 3.0]]),
    )
    still = Pose(np.eye(3), np.zeros(3))
    images = [PosedImage("a.jpg", 1, still), PosedImage("b.jpg", 1, still)]
    lines = format_images(images, points).splitlines()
    assert lines[2] == "0.5 0.5 1 2.5 2.5 2"
    rows = format_points(points).splitlines()[1:]
    assert rows[1] == "2 3.0 4.0 0.0 128 128 128 0.2 1 1 2 1"


def test_distortion_is_that_of_opencv() -> None:
    camera = Camera(640, 480, 500.0, 510.0, 321.0, 238.0)
    distortion = (-0.2, 0.05, 0.001, -0.002, 0.01)
    u, v = cv2.initUndistortRectifyMap(
        camera.matrix, np.array(distortion), np.eye(3), camera.matrix, (640, 480), cv2.CV_32FC1
    )
    pixels = np.array([[0.0, 0.0], [639.0, 0.0], [320.0, 240.0], [100.0, 479.0]])
    x, y = pixels.astype(int).T
    there = photographed(pixels, camera, distortion)
    np.testing.assert_allclose(there, np.column_stack([u[y, x], v[y, x]]), atol=1e-3)
    np.testing.assert_allclose(undistorted(there, camera, distortion), pixels, atol=1e-6)
    skewed = Camera(640, 480, 500.0, 510.0, 321.0, 238.0, 3.0)
    there = photographed(pixels, skewed, distortion)
    np.testing.assert_allclose(undistorted(there, skewed, distortion), pixels, atol=1e-6)
