"""Voxel carving of a rendered ball: the octree is exact, colours carve what silhouettes cannot."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from gvpipe.core.geometry.pose import planar_pose
from gvpipe.core.reconstruct.carving import level_set_of, space_carving, visual_hull, voxel_coloring
from gvpipe.core.reconstruct.evidence_options import Silhouette
from gvpipe.core.reconstruct.grid import VoxelGrid
from gvpipe.core.types import Camera, Mount, PosedView

CENTRE, RADIUS = np.array([0.0, 0.0, 0.15]), 0.12
CAMERA = Camera(width=160, height=120, fx=150.0, fy=150.0, cx=79.5, cy=59.5)


def texture(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Smooth colours that differ a few centimetres apart, (..., 3) in 0..255."""
    x, y, z = np.moveaxis(points, -1, 0)
    return 127.5 + 120 * np.stack(
        [np.sin(40 * x + 25 * z), np.sin(35 * y - 30 * z), np.cos(30 * (x + y))], axis=-1
    )


def ball_view(azimuth: float, tilt: float = 0.75) -> tuple[PosedView, Silhouette]:
    """Picture and silhouette of the ball on a textured ground, seen from one side."""
    mount = Mount(tilt=tilt, roll=0.0, height=0.7)
    reach = (0.7 - CENTRE[2]) / np.tan(tilt)
    pose = planar_pose(-reach * np.cos(azimuth), -reach * np.sin(azimuth), azimuth, mount)
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width].astype(float)
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(u)], -1)
    rays = rays @ pose.rotation.T
    away = pose.translation - CENTRE
    a, b = (rays**2).sum(-1), rays @ away
    square = b * b - a * (away @ away - RADIUS**2)
    hit = square > 0
    length = (-b - np.sqrt(np.maximum(square, 0))) / a
    ground = -pose.translation[2] / rays[..., 2]
    points = pose.translation + rays * np.where(hit, length, ground)[..., None]
    pixels = np.where(hit[..., None], texture(points), texture(1.3 * points + 5.0))
    view = PosedView(f"A/{azimuth:.2f}.png", pixels.astype(np.uint8), CAMERA, pose)
    return view, hit.astype(np.float32)


@pytest.fixture(scope="module")
def scene() -> tuple[list[PosedView], list[Silhouette]]:
    shots = [ball_view(k * 2 * np.pi / 7) for k in range(7)]
    return [v for v, _ in shots], [m for _, m in shots]


GRID = VoxelGrid.over(np.array([-0.2, -0.2, 0.0]), np.array([0.2, 0.2, 0.35]), (50, 50, 44))
BALL = np.linalg.norm(GRID.centres() - CENTRE, axis=-1) < RADIUS


def carve_one_by_one(
    views: list[PosedView], masks: list[Silhouette], least: int
) -> NDArray[np.bool_]:
    """Visual hull by its definition: every voxel centre in every mask."""
    centres = GRID.centres().reshape(-1, 3)
    background, seen = np.zeros(len(centres), dtype=bool), np.zeros(len(centres), dtype=int)
    for view, mask in zip(views, masks, strict=True):
        camera_from_map = view.map_from_camera.inverse()
        q = (centres @ camera_from_map.rotation.T + camera_from_map.translation) @ CAMERA.matrix.T
        u, v = np.rint(q[:, :2] / q[:, 2:]).astype(int).T
        inside = (q[:, 2] > 0) & (u >= 0) & (v >= 0) & (u < CAMERA.width) & (v < CAMERA.height)
        value = np.where(inside, mask[v * inside, u * inside], -1)
        known = value >= 0
        seen += known
        background |= known & (value < 0.5)
    return (~background & (seen >= least)).reshape(GRID.shape)


@pytest.mark.parametrize("least", [1, 2, 5])
def test_the_octree_equals_voxel_by_voxel_carving(
    scene: tuple[list[PosedView], list[Silhouette]], least: int
) -> None:
    views, masks = scene
    rng = np.random.default_rng(3)
    holes = []
    for mask in masks:
        ragged = np.where(rng.random(mask.shape) < 0.01, np.float32(np.nan), mask)
        ragged[:, :60] = -1
        holes.append(ragged)
    for silhouettes in (masks, holes):
        expected = carve_one_by_one(views, silhouettes, least)
        assert expected.any()
        assert (visual_hull(views, silhouettes, GRID, least_views=least) == expected).all()


def test_the_hull_holds_the_ball_and_little_more(
    scene: tuple[list[PosedView], list[Silhouette]],
) -> None:
    hull = visual_hull(*scene, GRID)
    assert (hull & BALL).sum() > 0.97 * BALL.sum()
    assert hull.sum() < 1.6 * BALL.sum()


@pytest.mark.parametrize("carve", [voxel_coloring, space_carving])
def test_colours_carve_what_silhouettes_leave(scene, carve) -> None:  # type: ignore[no-untyped-def]
    views, masks = scene
    loose = [ndimage.binary_dilation(m > 0.5, iterations=6).astype(np.float32) for m in masks]
    hull = visual_hull(views, loose, GRID)
    carved = carve(views, loose, GRID)
    assert not (carved & ~hull).any()
    kept = np.linalg.norm(GRID.centres() - CENTRE, axis=-1) < RADIUS - 0.02
    assert (carved & kept).sum() > 0.98 * kept.sum()
    outside = np.linalg.norm(GRID.centres() - CENTRE, axis=-1) > RADIUS + 0.01
    assert (carved & outside).sum() < 0.6 * (hull & outside).sum()


def test_one_colour_everywhere_leaves_the_hull(
    scene: tuple[list[PosedView], list[Silhouette]],
) -> None:
    views, masks = scene
    plain = [
        PosedView(v.image_id, np.full_like(v.pixels, 90), v.camera, v.map_from_camera)
        for v in views
    ]
    hull = visual_hull(views, masks, GRID)
    assert (voxel_coloring(plain, masks, GRID) == hull).all()
    assert (space_carving(plain, masks, GRID) == hull).all()


def test_masks_have_to_fit_their_views(scene: tuple[list[PosedView], list[Silhouette]]) -> None:
    views, masks = scene
    with pytest.raises(ValueError, match="masks for"):
        visual_hull(views, masks[1:], GRID)
    with pytest.raises(ValueError, match="mask"):
        visual_hull(views, [m[1:] for m in masks], GRID)


def test_the_level_set_of_an_occupancy_has_its_size() -> None:
    u = level_set_of(BALL, GRID)
    assert (u > 0).sum() == pytest.approx(BALL.sum(), rel=0.02)
    slopes = np.gradient(u, *GRID.spacing)
    near = np.abs(u) < 0.3 * GRID.spacing.min()
    assert np.linalg.norm(slopes, axis=0)[near].mean() == pytest.approx(1.0, abs=0.2)
