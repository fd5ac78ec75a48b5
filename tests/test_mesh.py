"""Meshes of shapes with known volume, area, height and outline; colours of known textures."""

import numpy as np
import pytest
import trimesh
from scipy import ndimage

from gvpipe.core.reconstruct.ghosts import standing_obstacles
from gvpipe.core.reconstruct.grid import VoxelGrid
from gvpipe.core.reconstruct.mesh import (
    Mesh,
    find_obstacles,
    join,
    polygon_area,
    surface,
)
from gvpipe.core.reconstruct.visibility import colour, project, render_depth, sees, surface_points
from tests.test_carving import CENTRE, RADIUS, ball_view, texture

GRID = VoxelGrid.over(np.array([-0.3, -0.2, 0.0]), np.array([0.3, 0.2, 0.3]), (120, 80, 60))
X, Y, Z = np.moveaxis(GRID.centres(), -1, 0)


def ball(x: float, y: float, z: float, r: float) -> np.ndarray:
    return (r - np.sqrt((X - x) ** 2 + (Y - y) ** 2 + (Z - z) ** 2)).astype(np.float32)


def block(x: float, y: float, top: float, half: float) -> np.ndarray:
    return np.minimum.reduce([half - np.abs(X - x), half - np.abs(Y - y), top - Z]).astype(
        np.float32
    )


def as_trimesh(mesh: Mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


def test_a_ball_has_its_volume_and_area() -> None:
    mesh = surface(ball(0.02, 0.01, 0.15, 0.1), GRID)
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * 1e-3, rel=0.005)
    assert mesh.area == pytest.approx(4 * np.pi * 1e-2, rel=0.01)
    outward = (mesh.vertices - [0.02, 0.01, 0.15]) / 0.1
    assert np.einsum("ij,ij->i", outward, mesh.normals).min() > 0.98
    assert as_trimesh(mesh).is_watertight
    assert mesh.volume == pytest.approx(as_trimesh(mesh).volume, rel=1e-9)
    assert mesh.area == pytest.approx(as_trimesh(mesh).area, rel=1e-9)


def test_a_box_on_the_ground_closes_at_the_ground() -> None:
    mesh = surface(block(0.0, 0.0, 0.2, 0.1), GRID)
    assert as_trimesh(mesh).is_watertight
    assert mesh.volume == pytest.approx(0.2 * 0.2 * 0.2, rel=0.02)
    assert mesh.vertices[:, 2].min() == pytest.approx(0.0, abs=1e-6)
    assert mesh.vertices[:, 2].max() == pytest.approx(0.2, abs=1e-3)


def test_nothing_reaches_below_the_ground() -> None:
    deep = VoxelGrid(GRID.origin - [0, 0, 0.103], GRID.spacing, GRID.shape)
    x, y, z = np.moveaxis(deep.centres(), -1, 0)
    sphere = (0.1 - np.sqrt(x**2 + y**2 + z**2)).astype(np.float32)
    mesh = surface(sphere, deep)
    assert as_trimesh(mesh).is_watertight
    assert mesh.vertices[:, 2].min() == pytest.approx(0.0, abs=1e-4)
    assert mesh.volume == pytest.approx(2 / 3 * np.pi * 1e-3, rel=0.02)


def test_a_surface_that_leaves_the_grid_is_closed_at_its_faces() -> None:
    mesh = surface(ball(0.3, 0.2, 0.3, 0.15), GRID)
    assert as_trimesh(mesh).is_watertight
    assert mesh.volume == pytest.approx(np.pi / 6 * 0.15**3, rel=0.03)
    assert (mesh.vertices <= GRID.upper + 1e-9).all()


@pytest.mark.parametrize("blur", [0.0, 0.7, 1.5])
def test_any_function_gives_a_watertight_mesh(blur: float) -> None:
    rng = np.random.default_rng(7)
    # rounded: many voxels lie exactly on the surface
    u = ndimage.gaussian_filter(rng.normal(size=(24, 20, 16)), blur).round(1).astype(np.float32)
    grid = VoxelGrid.over(np.array([0.0, 0.0, 0.0]), np.array([0.24, 0.2, 0.16]), u.shape)
    for mesh in (surface(u, grid), join([o.mesh for o in find_obstacles(u, grid, 0.0)])):
        assert len(mesh.faces) > 100
        assert as_trimesh(mesh).is_winding_consistent
        assert as_trimesh(mesh).is_watertight
        # and for readers of our single precision files that merge equal vertices
        single = mesh.vertices.astype(np.float32)
        assert trimesh.Trimesh(single, mesh.faces, process=True).is_watertight


def test_obstacles_are_listed_with_their_measures() -> None:
    u = np.maximum.reduce(
        [block(-0.15, 0.03, 0.2, 0.06), ball(0.15, 0.0, 0.1, 0.08), ball(0.0, -0.1, 0.1, 0.012)]
    )
    box, sphere = find_obstacles(u, GRID, smallest_m3=2e-5)
    assert (box.id, sphere.id) == (0, 1)
    assert box.height_m == pytest.approx(0.2, abs=1e-3)
    assert box.volume_m3 == pytest.approx(0.12 * 0.12 * 0.2, rel=0.03)
    assert box.centroid == pytest.approx([-0.15, 0.03, 0.1], abs=2e-3)
    assert polygon_area(box.footprint) == pytest.approx(0.12**2, rel=0.05)
    assert box.footprint.mean(axis=0) == pytest.approx([-0.15, 0.03], abs=0.02)
    assert len(box.footprint) < 30
    assert sphere.height_m == pytest.approx(0.18, abs=2e-3)
    assert sphere.centroid == pytest.approx([0.15, 0.0, 0.1], abs=1e-3)
    assert polygon_area(sphere.footprint) == pytest.approx(np.pi * 0.08**2, rel=0.04)
    whole = join([box.mesh, sphere.mesh])
    assert as_trimesh(whole).is_watertight
    assert whole.volume == pytest.approx(box.volume_m3 + sphere.volume_m3, rel=1e-9)
    assert len(find_obstacles(u, GRID, smallest_m3=1e-7)) == 3


def test_what_floats_over_nothing_is_no_obstacle() -> None:
    shelf = np.minimum(block(-0.15, 0.03, 0.2, 0.06), -block(-0.15, 0.03, 0.16, 0.07))
    foot = block(-0.15, 0.03, 0.05, 0.06)
    missed_foot = ball(0.15, 0.0, 0.1, 0.08)
    floating = ball(0.0, -0.1, 0.16, 0.04)
    alone = np.maximum.reduce([shelf, missed_foot, floating])
    (sphere,) = standing_obstacles(find_obstacles(alone, GRID))
    assert sphere.centroid == pytest.approx([0.15, 0.0, 0.1], abs=1e-3)
    # the same shelf over a foot is one obstacle seen in two parts
    kept = standing_obstacles(find_obstacles(np.maximum(alone, foot), GRID))
    assert sorted(round(o.height_m, 2) for o in kept) == [0.05, 0.18, 0.2]


def test_closed_voids_count_as_solid() -> None:
    hollow = np.minimum(ball(0.0, 0.0, 0.15, 0.1), -ball(0.0, 0.0, 0.15, 0.05))
    (obstacle,) = find_obstacles(hollow, GRID)
    assert obstacle.volume_m3 == pytest.approx(4 / 3 * np.pi * 1e-3, rel=0.01)


def test_no_inside_means_no_obstacle() -> None:
    u = np.full(GRID.shape, -1.0, dtype=np.float32)
    assert find_obstacles(u, GRID) == []
    assert len(surface(u, GRID).faces) == len(join([]).faces) == 0


def ball_mesh() -> Mesh:
    grid = VoxelGrid.over(np.array([-0.15, -0.15, 0.0]), np.array([0.15, 0.15, 0.3]), (60, 60, 60))
    u = RADIUS - np.linalg.norm(grid.centres() - CENTRE, axis=-1)
    return surface(u.astype(np.float32), grid)


def test_rendered_depth_is_that_of_the_ball() -> None:
    view, mask = ball_view(0.3)
    depth = render_depth(ball_mesh(), view)
    assert (np.isfinite(depth) != (mask > 0.5)).mean() < 0.005
    nearest = np.linalg.norm(view.map_from_camera.translation - CENTRE) - RADIUS
    assert depth.min() == pytest.approx(nearest, abs=0.002)


def test_a_ball_shows_its_near_half_only() -> None:
    view, _ = ball_view(1.0)
    mesh = ball_mesh()
    seen = sees(render_depth(mesh, view), mesh.vertices, view)
    ray = view.map_from_camera.translation - mesh.vertices
    facing = np.einsum("ij,ij->i", ray, mesh.normals) / np.linalg.norm(ray, axis=1)
    assert seen[facing > 0.2].mean() > 0.99
    assert seen[facing < -0.2].mean() < 0.01


def test_projection_finds_the_optical_axis() -> None:
    view, _ = ball_view(0.5)
    pose = view.map_from_camera
    pixels, depths = project((pose.translation + 0.8 * pose.rotation[:, 2])[None], view)
    assert pixels[0] == pytest.approx([view.camera.cx, view.camera.cy])
    assert depths[0] == pytest.approx(0.8)


def test_vertices_take_the_colours_of_the_texture() -> None:
    views = [ball_view(k * np.pi / 4)[0] for k in range(8)]
    mesh = colour(ball_mesh(), views)
    upper = mesh.vertices[:, 2] > CENTRE[2]
    error = np.abs(mesh.colours[upper] - texture(mesh.vertices[upper]))
    assert np.median(error) < 4
    assert np.percentile(error, 95) < 20
    assert (colour(ball_mesh(), []).colours == 128).all()


def test_surface_points_leave_out_the_ground() -> None:
    mesh = surface(block(0.0, 0.0, 0.2, 0.1), GRID)
    cloud = surface_points(mesh)
    assert 0.5 * len(mesh.vertices) < len(cloud.points) < len(mesh.vertices)
    assert cloud.points[:, 2].min() > 0
    assert np.linalg.norm(cloud.normals, axis=1) == pytest.approx(1.0, abs=1e-6)
