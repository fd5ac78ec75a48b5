"""Obstacle evidence on scenes whose obstacles, cameras and light are known."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np
import pytest

from gvpipe.core.geometry.ground import pixel_from_plane
from gvpipe.core.geometry.pose import planar_pose
from gvpipe.core.kernels.segmentation import cut
from gvpipe.core.reconstruct.background import GroundModel, GroundWitnesses, rendered_background
from gvpipe.core.reconstruct.evidence import data_terms, find_regions, hull_probability
from gvpipe.core.reconstruct.evidence_options import EvidenceOptions
from gvpipe.core.reconstruct.ghosts import without_ghosts
from gvpipe.core.reconstruct.grid import VoxelGrid
from gvpipe.core.reconstruct.hiding import bodies_seen, hidden_ground
from gvpipe.core.reconstruct.hull import (
    VoxelSolid,
    down_to_ground,
    entry_depth,
    log_support,
    pixel_from_map,
    regions_of,
    render_mask,
    standing,
)
from gvpipe.core.reconstruct.likeness import difference, features, learn_noise, without_gloss
from gvpipe.core.reconstruct.photometry import levelled
from gvpipe.core.reconstruct.raised import raised_surfaces
from gvpipe.core.reconstruct.segmentation import colour_gain, segment, without_specks
from gvpipe.core.reconstruct.silhouette import count_steps, silhouettes
from gvpipe.core.reconstruct.slabs import thin_slabs
from gvpipe.core.reconstruct.stereo import depth_maps
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
    steps: list[int] = []
    options = EvidenceOptions()
    again = silhouettes(views, NO_GROUND, options, threads=1, on_step=lambda: steps.append(1))
    assert len(steps) == count_steps(views, options)
    for a, b in zip(shapes, again, strict=True):
        np.testing.assert_array_equal(a, b)


def test_one_region_holds_the_box(views, shapes):
    regions = find_regions(views, shapes, EvidenceOptions())
    assert len(regions) == 1
    assert (regions[0].lower <= np.array(LOW)).all()
    assert (regions[0].upper >= np.array(HIGH)).all()
    assert (regions[0].upper - regions[0].lower < 0.8).all()


def test_every_part_of_the_hull_is_in_one_region():
    grid = VoxelGrid.over(np.zeros(3), np.array([6.0, 6.0, 2.0]), (60, 60, 20))
    inside = np.zeros(grid.shape, bool)
    inside[5:40, 5:8, :5] = inside[5:8, 5:40, :5] = True  # an angle, with a post in its corner
    inside[20:24, 20:24, :10] = True
    inside[50:55, 50:55, :5] = inside[51:54, 44:47, 12:15] = True  # apart; what floats beside it
    regions = regions_of(inside, grid, 1)
    points = grid.centres()[inside]
    held = sum(((r.lower < points) & (points < r.upper)).all(axis=-1).astype(int) for r in regions)
    assert len(regions) == 3
    assert (held == 1).all()
    assert all(r.lower[2] == 0 for r in regions)


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


def test_views_are_asked_until_no_more_can_matter(views, shapes):
    grid = VoxelGrid.over(np.array([-0.4, -0.4, 0.0]), np.array([0.4, 0.4, 0.4]), (20, 20, 10))
    matrices = [pixel_from_map(v) for v in views]
    log_sum, count = log_support(matrices, shapes, grid, 0.05)
    options = EvidenceOptions(view_floor=0.05, ground_softness=1e-6)
    expected = np.where(count >= options.min_views, np.exp(log_sum), 0)
    assert (log_sum < -20).any()
    p = hull_probability(views, shapes, grid, options)
    np.testing.assert_allclose(p, expected, rtol=1e-5, atol=1e-8)


def test_more_views_than_a_byte_counts_are_counted(views, shapes):
    grid = VoxelGrid.over(np.array([-0.05, -0.05, 0.05]), np.array([0.05, 0.05, 0.1]), (2, 2, 2))
    matrix = pixel_from_map(views[0])
    _, count = log_support([matrix] * 258, [shapes[0]] * 258, grid, 0.05)
    assert (count == 258).all()


def test_area_weights_are_low_where_colours_agree(views, shapes):
    grid = VoxelGrid.over(np.array([-0.2, -0.2, 0.05]), np.array([0.2, 0.2, 0.25]), (4, 4, 2))
    options = EvidenceOptions()
    _, g = data_terms(views, shapes, grid, options)
    for index in np.ndindex(grid.shape):
        point = np.append(grid.map_from_index(np.array(index)), 1.0)
        colours = []
        for view in views:
            u, v, w = pixel_from_map(view) @ point
            if 0 <= u < w * (CAMERA.width - 1) and 0 <= v < w * (CAMERA.height - 1):
                colours.append(view.pixels[int(v / w + 0.5), int(u / w + 0.5)].astype(float))
        assert len(colours) >= options.min_views
        off = np.linalg.norm(np.array(colours) - np.mean(colours, axis=0), axis=1)
        consent = np.mean(1 / (1 + off / options.consistency_scale))
        assert g[index] == pytest.approx(max(1 - consent, options.area_floor), abs=1e-5)


def test_ground_behind_an_obstacle_is_seen_by_the_others(views, scene):
    bare = Scene(scene.ground, extent=scene.extent)
    witnesses = GroundWitnesses(
        [replace(v, pixels=p) for v, p in zip(views, levelled(views), strict=True)]
    )
    masks = [true_mask(v.map_from_camera) for v in views]
    hidden = [m.astype(np.uint8) * 255 for m in masks]
    witnesses.hide(hidden, hidden)
    seen = witnesses.behind(0, 20.0)
    expected = bare.photograph(views[0].map_from_camera, CAMERA, 2).astype(np.float32)
    behind = masks[0] & (seen.open_weight > 1.0)
    assert behind.sum() > 200
    gain = np.median(seen.colour[behind] / np.maximum(expected[behind], 1))
    off = np.abs(seen.colour[behind] / gain - expected[behind]).mean(axis=-1)
    assert np.median(off) < 8


@pytest.mark.parametrize(
    ("own", "solid", "expected"),
    [(200, 0, 200), (200, 255, 150), (40, 0, 150), (175, 0, 150)],
    ids=["as bright as others see it", "perhaps an obstacle", "too dark for gloss", "seen by none"],
)
def test_the_ground_may_look_as_in_other_views(views, own, solid, expected):
    levels = (150, 150, 150, 150, 150, 200, 200, 200, own)
    flat = [
        replace(v, pixels=np.full_like(v.pixels, level))
        for v, level in zip(views, levels, strict=True)
    ]
    witnesses = GroundWitnesses(flat)
    nothing = np.zeros((2, 2), np.uint8)
    witnesses.hide([nothing] * 9, [nothing] * 8 + [nothing + np.uint8(solid)])
    seen = witnesses.behind(8, 12.0)
    middle = seen.colour[60:90, 80:120]
    np.testing.assert_allclose(middle, expected, atol=1.0)


def test_gloss_on_a_body_is_no_hole(scene):
    floor = Scene(np.full_like(scene.ground, 170), boxes=scene.boxes)
    rng = np.random.default_rng(5)
    views = [
        PosedView(f"A/{k}", floor.photograph(pose, CAMERA, 2, noise=2.0, rng=rng), CAMERA, pose)
        for k, pose in enumerate(ring(18))
    ]
    glossy = views[4].pixels.copy()
    top = np.array([0.0, 0.0, HIGH[2], 1.0])  # the ground behind it is seen from all round
    u, v, w = pixel_from_map(views[4]) @ top
    spot = np.zeros(glossy.shape[:2], np.uint8)
    cv2.circle(spot, (round(u / w), round(v / w)), 6, 1, -1)
    glossy[spot > 0] = np.clip(rng.normal(170, 2, (int(spot.sum()), 3)), 0, 255).astype(np.uint8)
    views[4] = replace(views[4], pixels=glossy)
    found = silhouettes(views, NO_GROUND, EvidenceOptions())[4]
    assert (found[spot > 0] > 0.5).mean() > 0.9  # its rim may be cut off


def test_the_mosaic_is_rendered_where_the_view_sees_it(views, scene):
    s = scene.ground.shape[0] / scene.extent
    rgba = np.dstack([scene.ground, np.full(scene.ground.shape[:2], 255, np.uint8)])
    background = rendered_background(views[0], GroundModel(rgba, np.diag([1 / s, 1 / s, 1.0])))
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width].astype(np.float32)
    ground_from_pixel = np.linalg.inv(pixel_from_plane(CAMERA, views[0].map_from_camera))
    x, y, w = np.moveaxis(np.stack([u, v, np.ones_like(u)], -1) @ ground_from_pixel.T, -1, 0)
    # in raster pixels; ground at negative coordinates is not in the raster
    x, y = (s * x / w).astype(np.float32), (s * y / w).astype(np.float32)
    last = scene.ground.shape[0] - 2
    inside = (w > 0) & (x > 1) & (y > 1) & (x < last) & (y < last)
    assert background.known[inside].all()
    assert not background.known[(x < -1) | (y < -1)].any()
    expected = cv2.remap(scene.ground, x, y, cv2.INTER_LINEAR).astype(float)
    off = np.abs(background.colour[inside] - expected[inside])
    assert inside.sum() > 1000
    assert off.mean() < 1.0  # OpenCV rounds positions to 1/32 of a pixel


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
    assert (gain[:, :19] < 0).all()  # the last one is blurred with its red neighbours


def shaded_floor() -> tuple[np.ndarray, np.ndarray]:
    """Brown floor, lit above and in the shade below, beside a dark blue obstacle; and where that is
    known, in its upper half."""
    lit, shade, obstacle = (180, 140, 90), (58, 44, 27), (34, 40, 54)
    picture = np.empty((60, 60, 3), np.uint8)
    picture[:30, :40], picture[30:, :40], picture[:, 40:] = lit, shade, obstacle
    region = np.zeros((60, 60), np.float32)
    region[:30, 40:] = 1.0
    return picture, region


def test_ground_in_the_shade_keeps_its_hue():
    picture, region = shaded_floor()
    known = np.ones((60, 60), bool)
    known[30:] = False  # only lit ground teaches: by brightness shade would be the obstacle's
    gain = colour_gain(picture, region, known, 1.5)
    assert (gain[33:, 3:37] < -0.5).all()
    assert (gain[33:, 43:] > 0.5).all()


def test_brightness_decides_in_a_grey_world():
    picture, region = shaded_floor()
    grey = np.repeat(picture.max(axis=-1, keepdims=True), 3, axis=-1)
    grey[:, :40] = 140
    gain = colour_gain(grey, region, np.ones((60, 60), bool), 1.5)
    assert (gain[:, 3:37] < -0.1).all()
    assert (gain[:, 43:] > 0.1).all()


def test_the_gain_of_colours_keeps_its_limit():
    rng = np.random.default_rng(4)
    picture = rng.integers(0, 256, (60, 60, 3)).astype(np.uint8)
    picture[:, 30:] //= 3
    region = np.zeros((60, 60), np.float32)
    region[:, 30:] = 1.0
    gain = colour_gain(picture, region, np.ones((60, 60), bool), 1.5)
    assert np.abs(gain).max() <= 1.5


def test_what_hides_the_ground_is_grown_by_two_pixels(views):
    shapes = [np.full((CAMERA.height, CAMERA.width), np.nan, np.float32) for _ in views]
    shapes[0][40:60, 50:80] = 1.0
    grown = np.zeros_like(shapes[0], bool)
    grown[38:62, 48:82] = True
    with ThreadPoolExecutor(1) as pool:
        first, second, *_ = hidden_ground(views, shapes, [], pool)
        behind = hidden_ground(views, shapes, [box_grid()], pool)[1]
    np.testing.assert_array_equal(first, np.where(grown, 255, 0))
    assert not second.any()
    true = true_mask(views[1].map_from_camera)
    assert (behind[true] == 255).all()
    assert (behind == 255).sum() < 1.5 * true.sum()


def test_bodies_are_seen_less_their_edge(views):
    with ThreadPoolExecutor(1) as pool:
        seen = bodies_seen(views, [box_grid()], pool)
    for mask, view in zip(seen, views, strict=True):
        true = true_mask(view.map_from_camera)
        inner = cv2.erode(true.astype(np.uint8), np.ones((11, 11))) > 0
        assert inner.any()
        assert not (mask[~true] > 0).any()
        assert (mask[inner] > 0).all()


def test_only_parts_on_the_ground_stand():
    inside = np.zeros((20, 20, 20), bool)
    inside[2:8, 2:8, :10] = True
    inside[12:18, 12:18, 10:15] = True
    kept = standing(inside)
    assert kept[2:8, 2:8, :10].all()
    assert kept.sum() == 6 * 6 * 10
    filled = down_to_ground(inside)
    assert filled[12:18, 12:18, :15].all()
    assert filled.sum() == 6 * 6 * (10 + 15)


def test_rendered_voxels_cover_the_true_outline():
    pose = ring(8)[1]
    grid = VoxelGrid.over(np.array([-0.2, -0.2, 0.0]), np.array([0.2, 0.2, 0.3]), (40, 40, 30))
    centres = grid.centres()
    inside = ((centres >= np.array(LOW)) & (centres <= np.array(HIGH))).all(-1)
    view = PosedView("", np.zeros((150, 200, 3), np.uint8), CAMERA, pose)
    assert iou(render_mask(inside, grid, view) > 0, true_mask(pose)) > 0.9


def box_grid(grow: float = 0.0, rise: float = 0.0) -> VoxelSolid:
    """Voxels of the box, widened and heightened: what a fat hull would be."""
    grid = VoxelGrid.over(np.array([-0.3, -0.3, 0.0]), np.array([0.3, 0.3, 0.4]), (120, 120, 80))
    centres = grid.centres()
    low, high = (
        np.array(LOW) - np.array([grow, grow, 1.0]),
        np.array(HIGH) + np.array([grow, grow, rise]),
    )
    return VoxelSolid(((centres >= low) & (centres <= high)).all(-1), grid)


def true_depth(pose: Pose) -> np.ndarray:
    """Depth of the box's surface, infinite beside it, from the slabs' entry distances."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(CAMERA.matrix).T @ pose.rotation.T
    a, b = (np.array(LOW) - pose.translation) / rays, (np.array(HIGH) - pose.translation) / rays
    start, end = np.minimum(a, b).max(-1), np.maximum(a, b).min(-1)
    return np.where(start < end, start, np.inf)


def test_rays_enter_voxels_at_the_true_depth(views):
    solid = box_grid()
    found = entry_depth(solid.inside, solid.grid, views[0])
    true = true_depth(views[0].map_from_camera)
    both = np.isfinite(found) & np.isfinite(true)
    assert iou(np.isfinite(found), np.isfinite(true)) > 0.95
    assert np.median(np.abs(found[both] - true[both])) < 0.005


def test_rays_meet_nothing_in_an_empty_grid(views):
    solid = box_grid()
    assert np.isinf(entry_depth(np.zeros_like(solid.inside), solid.grid, views[0])).all()


def test_depths_find_the_surface_inside_a_fat_hull(views):
    fat = box_grid(0.03, 0.08)
    near = [entry_depth(fat.inside, fat.grid, v) for v in views]
    maps = depth_maps(views, near, np.array([0.0, 0.0, 0.1]), 2)
    errors, shares = [], []
    for found, view in zip(maps, views, strict=True):
        true = true_depth(view.map_from_camera)
        known = np.isfinite(true) & (found.confidence > 0)
        errors.append(np.abs(found.depth[known] - true[known]))
        shares.append(known.sum() / np.isfinite(true).sum())
    assert np.median(np.concatenate(errors)) < 0.004  # a pixel is 6 mm wide
    assert np.mean(np.concatenate(errors) < 0.012) > 0.9
    assert np.mean(shares) > 0.3
    again = depth_maps(views, near, np.array([0.0, 0.0, 0.1]), 1)
    np.testing.assert_array_equal(maps[3].depth, again[3].depth)


def test_texture_in_the_plane_of_the_ground_is_ground(views):
    raised = raised_surfaces(views, [box_grid(0.02, 0.05)], 2)
    masks = [true_mask(v.map_from_camera) for v in views]
    up = np.concatenate([m[r > 0.5] for m, r in zip(masks, raised, strict=True)])
    flat = np.concatenate([m[r < -0.5] for m, r in zip(masks, raised, strict=True)])
    assert len(up) > 1000
    assert len(flat) > 300
    assert up.mean() > 0.95
    assert flat.mean() < 0.1


def test_depths_take_the_roof_off_the_hull(views, shapes):
    grid = VoxelGrid.over(np.array([-0.3, -0.3, 0.0]), np.array([0.3, 0.3, 0.4]), (60, 60, 40))
    hull = hull_probability(views, shapes, grid, EvidenceOptions()) > 0.5
    f, g = data_terms(views, shapes, grid, EvidenceOptions())
    assert len(thin_slabs(grid.shape)) > 1
    np.testing.assert_array_equal((f, g), data_terms(views, shapes, grid, EvidenceOptions(), 3))
    z = grid.centres()[..., 2]
    above = z > HIGH[2] + 0.02
    assert (hull & above).sum() > 50  # a hull seen from above has a roof
    assert ((f < 0) & above).sum() < 0.3 * (hull & above).sum()


@pytest.mark.parametrize(("believers", "stands"), [((4, 5), False), ((3, 4, 5), True)])
def test_bodies_need_three_witnesses_of_their_own(views, believers, stands):
    box = box_grid()
    masks = [render_mask(box.inside, box.grid, v) > 0 for v in views]
    # the first camera sees it behind the box, where its silhouette would allow anything
    grid = VoxelGrid.over(np.array([-0.42, -0.05, 0.0]), np.array([-0.3, 0.05, 0.08]), (24, 20, 16))
    bodies = [render_mask(np.ones(grid.shape, bool), grid, v) > 0 for v in views]
    assert (bodies[0] & masks[0]).sum() > 0.95 * bodies[0].sum()
    shapes = [m.astype(np.float32) for m in masks]
    for k, body in enumerate(bodies):
        shapes[k][body & ~masks[k]] = 1.0 if k in believers else np.nan
    cleaned = without_ghosts(views, shapes, EvidenceOptions())
    for k in believers:
        alone = bodies[k] & ~cv2.dilate(masks[k].astype(np.uint8), np.ones((9, 9))).astype(bool)
        assert alone.sum() > 50
        assert (cleaned[k][alone].mean() > 0.9) == stands
        assert (cleaned[k][masks[k]] == 1.0).all()


def test_smooth_light_is_taken_for_gloss_but_an_obstacle_is_not():
    ground = np.full((150, 200, 3), 150, np.float32)
    x = np.arange(200) / 200
    picture = ground + 20 * x[None, :, None]
    picture[60:100, 80:120] = 40
    corrected = without_gloss(picture.astype(np.uint8), ground, np.ones((150, 200), np.float32))
    off = np.abs(picture - corrected).mean(axis=-1)
    assert off[:40].max() < 5
    assert off[62:98, 82:118].min() > 60
