"""Obstacle evidence on scenes whose obstacles, cameras and light are known."""

import cv2
import numpy as np
import pytest

from gvpipe.core.geometry.ground import pixel_from_plane
from gvpipe.core.geometry.pose import planar_pose
from gvpipe.core.kernels.segmentation import cut
from gvpipe.core.reconstruct.background import (
    GroundModel,
    GroundWitnesses,
    reduced,
    rendered_background,
)
from gvpipe.core.reconstruct.evidence import data_terms, find_regions, hull_probability
from gvpipe.core.reconstruct.evidence_options import EvidenceOptions
from gvpipe.core.reconstruct.grid import VoxelGrid
from gvpipe.core.reconstruct.hull import down_to_ground, pixel_from_map, render_mask, standing
from gvpipe.core.reconstruct.likeness import difference, features, learn_noise
from gvpipe.core.reconstruct.photometry import levelled
from gvpipe.core.reconstruct.segmentation import colour_gain, segment, without_specks
from gvpipe.core.reconstruct.silhouette import silhouettes
from gvpipe.core.types import Camera, Mount, Pose, PosedView
from tests.synthetic import Box, Scene, texture

CAMERA = Camera(200, 150, 170.0, 170.0, 99.5, 74.5)
LOW, HIGH = (-0.15, -0.1, 0.0), (0.15, 0.1, 0.22)
NO_GROUND = GroundModel(np.zeros((2, 2, 4), np.uint8), np.eye(3))


def ring(count: int) -> list[Pose]:
    """Cameras all round the origin, looking at it from above."""
    poses = []
    for angle in 2 * np.pi * np.arange(count) / count:
        mount = Mount(np.radians(38.0), 0.0, 0.7)
        poses.append(planar_pose(np.cos(angle), np.sin(angle), angle + np.pi, mount))
    return poses


def true_mask(pose: Pose) -> np.ndarray:
    """Outline of the box, a convex body: the convex hull of its projected corners."""
    corners = np.array([[x, y, z, 1.0] for x, y, z in np.ndindex(2, 2, 2)])
    corners[:, :3] = np.where(corners[:, :3] > 0, HIGH, LOW)
    p = corners @ pixel_from_map(PosedView("", np.zeros((1, 1, 3), np.uint8), CAMERA, pose)).T
    outline = cv2.convexHull(np.rint(p[:, :2] / p[:, 2:]).astype(np.int32))
    mask = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
    return np.asarray(cv2.fillConvexPoly(mask, outline, 1)) > 0


@pytest.fixture(scope="module")
def scene() -> Scene:
    rng = np.random.default_rng(3)
    faces = 255 - texture(rng, 512) // 2
    return Scene(texture(rng, 1024), boxes=(Box(LOW, HIGH, faces),))


@pytest.fixture(scope="module")
def views(scene: Scene) -> list[PosedView]:
    rng = np.random.default_rng(4)
    gains = (1.0, 0.85, 1.1)
    return [
        PosedView(
            f"A/{k}",
            scene.photograph(pose, CAMERA, 2, gain=gains[k % 3], noise=2.0, rng=rng),
            CAMERA,
            pose,
        )
        for k, pose in enumerate(ring(9))
    ]


@pytest.fixture(scope="module")
def shapes(views: list[PosedView]) -> list[np.ndarray]:
    return silhouettes(views, NO_GROUND, EvidenceOptions())


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


def test_silhouettes_match_the_true_outlines(views, shapes):
    scores = [
        iou(np.nan_to_num(s) > 0.5, true_mask(v.map_from_camera))
        for v, s in zip(views, shapes, strict=True)
    ]
    assert np.mean(scores) > 0.9
    assert min(scores) > 0.8


def test_silhouettes_do_not_depend_on_threads(views, shapes):
    again = silhouettes(views, NO_GROUND, EvidenceOptions(), threads=1)
    for a, b in zip(shapes, again, strict=True):
        np.testing.assert_array_equal(a, b)


def test_one_region_holds_the_box(views, shapes):
    regions = find_regions(views, shapes, EvidenceOptions())
    assert len(regions) == 1
    assert (regions[0].lower <= np.array(LOW)).all()
    assert (regions[0].upper >= np.array(HIGH)).all()
    assert (regions[0].upper - regions[0].lower < 0.8).all()


def test_data_terms_are_negative_inside_and_positive_outside(views, shapes):
    grid = VoxelGrid.over(np.array([-0.4, -0.4, 0.0]), np.array([0.4, 0.4, 0.4]), (40, 40, 20))
    f, g = data_terms(views, shapes, grid, EvidenceOptions())
    centres = grid.centres()
    margin = 0.03
    inside = ((centres > np.array(LOW) + margin) & (centres < np.array(HIGH) - margin)).all(-1)
    outside = (np.abs(centres[..., :2]) > 0.3).any(-1)
    assert (f[inside] < 0).mean() > 0.99
    assert (f[outside] > 0).mean() > 0.99
    assert f.dtype == g.dtype == np.float32
    assert g.min() > 0


def test_a_point_too_few_views_see_is_free(views):
    everywhere = [np.ones(v.pixels.shape[:2], np.float32) for v in views]
    grid = VoxelGrid.over(np.array([-9.0, -9.0, 0.0]), np.array([9.0, 9.0, 0.2]), (30, 30, 2))
    options = EvidenceOptions(min_views=len(views) + 1)
    assert hull_probability(views, everywhere, grid, options).max() == 0.0


def test_unknown_pixels_leave_a_view_out(views):
    shapes = [np.ones(v.pixels.shape[:2], np.float32) for v in views]
    grid = VoxelGrid.over(np.array([-0.1, -0.1, 0.1]), np.array([0.1, 0.1, 0.2]), (4, 4, 2))
    shapes[0][:] = np.nan
    assert hull_probability(views, shapes, grid, EvidenceOptions()).min() > 0.99
    shapes[0][:] = 0.0  # the floor of one factor
    p = hull_probability(views, shapes, grid, EvidenceOptions(view_floor=0.05))
    np.testing.assert_allclose(p, 0.05, rtol=1e-4)


def test_ground_behind_an_obstacle_is_seen_by_the_others(views, scene):
    bare = Scene(scene.ground, extent=scene.extent)
    witnesses = GroundWitnesses(
        [reduced(v, p, 1) for v, p in zip(views, levelled(views), strict=True)]
    )
    masks = [true_mask(v.map_from_camera) for v in views]
    witnesses.hide([m.astype(np.uint8) * 255 for m in masks])
    seen = witnesses.behind(0, 20.0)
    expected = bare.photograph(views[0].map_from_camera, CAMERA, 2).astype(np.float32)
    behind = masks[0] & (seen.open_weight > 1.0)
    assert behind.sum() > 200
    gain = np.median(seen.colour[behind] / np.maximum(expected[behind], 1))
    off = np.abs(seen.colour[behind] / gain - expected[behind]).mean(axis=-1)
    assert np.median(off) < 8


def test_the_mosaic_is_rendered_where_the_view_sees_it(views, scene):
    s = scene.ground.shape[0] / scene.extent
    rgba = np.dstack([scene.ground, np.full(scene.ground.shape[:2], 255, np.uint8)])
    background = rendered_background(views[0], GroundModel(rgba, np.diag([1 / s, 1 / s, 1.0])))
    h = pixel_from_plane(CAMERA, views[0].map_from_camera)
    point = np.array([0.5, 0.4, 1.0])
    u, v, w = h @ point
    if 0 < u / w < CAMERA.width - 1 and 0 < v / w < CAMERA.height - 1:
        expected = scene.ground[round(point[1] * s), round(point[0] * s)].astype(float)
        got = background.colour[round(v / w), round(u / w)]
        assert np.abs(got - expected).mean() < 40
    assert not background.known[:, :].all()  # ground at negative coordinates is not in the raster


def test_exposure_is_levelled(views):
    before = [float(v.pixels.mean()) for v in views]
    after = [float(p.mean()) for p in levelled(views)]
    assert np.std(after) < 0.4 * np.std(before)


def test_ground_is_like_itself_and_unlike_an_obstacle():
    rng = np.random.default_rng(0)
    ground = cv2.GaussianBlur(rng.uniform(0, 255, (120, 120, 3)), (0, 0), 1.5)
    picture = 0.9 * ground + 6 + rng.normal(scale=2, size=ground.shape)
    picture[40:80, 40:80] = (90, 120, 60)
    known = np.ones((120, 120), bool)
    f = features(np.clip(picture, 0, 255).astype(np.uint8), ground.astype(np.float32), known)
    off, recognised = difference(f, learn_noise([f.pick(known)]))
    obstacle = np.zeros_like(known)
    obstacle[45:75, 45:75] = True
    bare = ~cv2.dilate(obstacle.astype(np.uint8), np.ones((21, 21))).astype(bool)
    assert np.quantile(off[obstacle], 0.1) > 3 * np.quantile(off[bare], 0.9)
    assert np.median(recognised[bare]) > 0.5 > np.median(recognised[obstacle])


def test_cut_finds_the_minimal_cut_of_a_noisy_disc():
    y, x = np.mgrid[:80, :80]
    disc = np.hypot(x - 40, y - 38) < 20
    rng = np.random.default_rng(1)
    gain = (np.where(disc, 0.5, -0.5) + rng.normal(scale=0.8, size=disc.shape)).astype(np.float32)
    flat = np.full(disc.shape, 0.7, np.float32)
    region = cut(gain, flat, flat, 300, np.zeros_like(gain)) > 0.5

    def energy(r: np.ndarray) -> float:
        steps = np.abs(np.diff(r.astype(float), axis=0)).sum()
        steps += np.abs(np.diff(r.astype(float), axis=1)).sum()
        return float(0.7 * steps - gain[r].sum())

    assert iou(region, disc) > 0.9
    assert energy(region) <= energy(disc)
    assert energy(region) <= energy(gain > 0)


def test_outlines_snap_to_edges():
    picture = np.full((60, 60, 3), 80, np.uint8)
    picture[:, 33:] = 160
    gain = np.zeros((60, 60), np.float32)
    gain[:, :25], gain[:, 40:] = -1.0, 1.0  # nothing known between
    region = segment(gain, picture, 1.5) > 0.5
    # the edge is two pixels wide once sensor noise is smoothed away
    assert (np.abs(region[5:-5].argmax(axis=1) - 33) <= 1).all()


def test_specks_and_pinholes_are_flipped_but_large_holes_stay():
    region = np.zeros((40, 40), np.float32)
    region[5:35, 5:35] = 1.0
    region[8:10, 8:10] = 0.0
    region[15:30, 15:30] = 0.0
    region[1, 1] = 1.0
    cleaned = without_specks(region, 20)
    assert cleaned[8, 8] == 1.0
    assert cleaned[20, 20] == 0.0
    assert cleaned[1, 1] == 0.0


def test_colours_of_the_region_speak_for_it():
    picture = np.zeros((40, 40, 3), np.uint8)
    picture[:, 20:] = (200, 40, 40)
    region = np.zeros((40, 40), np.float32)
    region[:20, 20:] = 1.0
    gain = colour_gain(picture, region, np.ones((40, 40), bool), 1.5)
    assert (gain[30:, 20:] > 0).all()  # the same red, not in the region yet
    assert (gain[:, :20] < 0).all()


def test_only_parts_on_the_ground_stand():
    inside = np.zeros((20, 20, 20), bool)
    inside[2:8, 2:8, :10] = True
    inside[12:18, 12:18, 10:] = True
    kept = standing(inside)
    assert kept[4, 4, 5]
    assert not kept[14, 14, 14]
    filled = down_to_ground(inside)
    assert filled[14, 14, 0]
    assert not filled[14, 14, :].all() or inside[14, 14, 19]


def test_rendered_voxels_cover_the_true_outline():
    pose = ring(8)[1]
    grid = VoxelGrid.over(np.array([-0.2, -0.2, 0.0]), np.array([0.2, 0.2, 0.3]), (40, 40, 30))
    centres = grid.centres()
    inside = ((centres >= np.array(LOW)) & (centres <= np.array(HIGH))).all(-1)
    view = PosedView("", np.zeros((150, 200, 3), np.uint8), CAMERA, pose)
    assert iou(render_mask(inside, grid, view) > 0, true_mask(pose)) > 0.9
