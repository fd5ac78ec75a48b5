"""Files beside `slam.json`: the same map in the formats of other programs."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gvpipe.core.geometry.distortion import photographed
from gvpipe.core.geometry.ground import pixel_from_plane, plane_normal
from gvpipe.core.geometry.homography import apply
from gvpipe.core.geometry.pose import mount_of
from gvpipe.core.geometry.relative_pose import choose, decompose, ground_motion, motion_covariance
from gvpipe.core.slam.correlation import judged_links, shared_errors
from gvpipe.core.slam.links import Link
from gvpipe.core.slam.location_graph import SeenGround
from gvpipe.core.types import Float, Pose
from gvpipe.dataset import Dataset
from gvpipe.formats.calibration import Calibration
from gvpipe.formats.colmap import (
    PosedImage,
    SparsePoints,
    format_cameras,
    format_images,
    format_points,
)
from gvpipe.formats.g2o import RelativeEdge, format_g2o
from gvpipe.formats.kitti import format_kitti
from gvpipe.formats.location_graph import GraphEdge, GraphNode, draw
from gvpipe.formats.tum import format_tum
from gvpipe.records import SlamBody
from gvpipe.stages.contract import main_component

LEAST_SIGMA = 1e-5
"""Uncertainty below which nothing is measured, metres and radians: keeps information finite."""


@dataclass(frozen=True)
class SlamEvidence:
    """What the map was made from.

    Attributes
    ----------
    dataset : Dataset
        The images.
    links : tuple of Link
        Links the map rests on.
    ground : tuple of SeenGround
        Ground points of each component.
    """

    dataset: Dataset
    links: tuple[Link, ...] = ()
    ground: tuple[SeenGround, ...] = ()


def write_files(body: SlamBody, evidence: SlamEvidence, folder: Path) -> None:
    """Write trajectories of every robot, and pose graph, COLMAP model and drawing of the map."""
    poses = {row.image: Pose(row.R, row.t) for row in body.poses}
    files = {}
    for robot, entries in evidence.dataset.robots.items():
        stamped = [
            (float(k), poses[entry.image_id])
            for k, entry in enumerate(entries)
            if entry.image_id in poses
        ]
        files[f"{robot}.tum"] = format_tum(stamped)
        files[f"{robot}.kitti.txt"] = format_kitti(pose for _, pose in stamped)
    if poses:
        main = main_component(body)
        own = {row.image: poses[row.image] for row in body.poses if row.component == main}
        files["location_graph.svg"] = _drawn(body)
        files["map.g2o"] = _pose_graph(own, evidence)
        files |= _colmap(own, evidence)
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8")


def _drawn(body: SlamBody) -> str:
    """Draw the location graph."""
    nodes = [
        GraphNode(
            image=row.image,
            robot=row.robot,
            label=Path(row.image).with_suffix("").as_posix(),
            component=row.component,
            x=row.x,
            y=row.y,
            yaw=float(np.radians(row.yaw_deg)),
            covariance=row.covariance[3:5, 3:5],
        )
        for row in body.poses
    ]
    return draw(nodes, [GraphEdge(row.image_i, row.image_j, row.kind) for row in body.edges])


def _pose_graph(poses: dict[str, Pose], evidence: SlamEvidence) -> str:
    """Write what each link alone says about its two cameras, beside the poses of the map."""
    number = {image: k for k, image in enumerate(poses)}
    links = [x for x in evidence.links if x.image_i in poses and x.image_j in poses]
    some = links[judged_links(len(links))]
    shared = shared_errors((x.homography, x.points_i, x.points_j) for x in some)
    edges = []
    for link in links:
        i, j = number[link.image_i], number[link.image_j]
        i_from_j, covariance = _measured(link, poses[link.image_i], evidence)
        spread = shared * covariance + LEAST_SIGMA**2 * np.eye(6)
        edges.append(RelativeEdge(i, j, i_from_j, np.asarray(np.linalg.inv(spread))))
    return format_g2o(list(poses.values()), edges)


def _measured(link: Link, pose_i: Pose, evidence: SlamEvidence) -> tuple[Pose, Float]:
    """Pose of camera j in camera i by the link's homography, and its covariance as in g2o."""
    camera_i, camera_j = (
        evidence.dataset.entry(image).camera for image in (link.image_i, link.image_j)
    )
    mount = mount_of(pose_i)
    motion = ground_motion(link.homography, camera_i, camera_j)
    relative = choose(decompose(motion, mount.height), plane_normal(mount))
    covariance = motion_covariance(
        relative, mount.height, camera_i, camera_j, link.points_i, link.points_j
    )
    x, y, z = relative.j_from_i.translation
    lever = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    # the error of the opposite motion in the axes of camera j: translation, half rotation vector
    change = np.block([[-lever, -np.eye(3)], [-0.5 * np.eye(3), np.zeros((3, 3))]])
    return relative.j_from_i.inverse(), np.asarray(change @ covariance @ change.T)


def _colmap(poses: dict[str, Pose], evidence: SlamEvidence) -> dict[str, str]:
    """Write the map as a COLMAP model of the photographs; empty if a camera has skew."""
    keys: dict[Calibration, int] = {}
    images = []
    for image, pose in poses.items():
        calibration = _calibration(evidence.dataset, image)
        key = keys.setdefault(calibration, len(keys) + 1)
        images.append(PosedImage(image, key, pose))
    if any(calibration.skew for calibration in keys):
        return {}
    ground = [g for g in evidence.ground if set(g.images) == set(poses)]
    points = _sparse(ground[0], poses, evidence.dataset) if ground else _NO_POINTS
    return {
        "cameras.txt": format_cameras({key: calibration for calibration, key in keys.items()}),
        "images.txt": format_images(images, points),
        "points3D.txt": format_points(points),
    }


_NO_POINTS = SparsePoints(
    position=np.empty((0, 3)),
    error_px=np.empty(0),
    start=np.zeros(1, dtype=np.int64),
    image=np.empty(0, dtype=np.int64),
    pixel=np.empty((0, 2)),
)


def _calibration(dataset: Dataset, image: str) -> Calibration:
    entry = dataset.entry(image)
    c = entry.camera
    return Calibration(
        c.width, c.height, c.fx, c.fy, c.cx, c.cy, c.skew, tuple(entry.source.distortion)
    )


def _sparse(ground: SeenGround, poses: dict[str, Pose], dataset: Dataset) -> SparsePoints:
    """List the ground points with their pixels in the photographs."""
    number = {image: k for k, image in enumerate(poses)}
    tracks, point = ground.tracks, ground.tracks.point
    pixel, error = np.empty_like(tracks.pixel), np.empty(len(tracks.pixel))
    by_camera = np.argsort(tracks.camera, kind="stable")
    first = np.searchsorted(tracks.camera[by_camera], np.arange(len(ground.images) + 1))
    for k, image in enumerate(ground.images):
        seen = by_camera[first[k] : first[k + 1]]
        entry = dataset.entry(image)
        expected = apply(pixel_from_plane(entry.camera, poses[image]), ground.points[point[seen]])
        error[seen] = np.linalg.norm(expected - tracks.pixel[seen], axis=1)
        pixel[seen] = photographed(tracks.pixel[seen], entry.camera, entry.source.distortion)
    return SparsePoints(
        position=np.column_stack([ground.points, np.zeros(len(ground.points))]),
        error_px=np.bincount(point, error) / np.maximum(np.diff(tracks.start), 1),
        start=tracks.start,
        image=np.array([number[image] for image in ground.images])[tracks.camera],
        pixel=pixel,
    )
