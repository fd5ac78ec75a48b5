"""Level sets against exact solutions: plain motions, minimisers, energy, change of topology."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from gvpipe.core.reconstruct.energy import measure
from gvpipe.core.reconstruct.grid import VoxelGrid
from gvpipe.core.reconstruct.levelset import evolve
from gvpipe.core.reconstruct.motions import (
    curvature,
    step_along_normal,
    step_by_curvature,
    step_by_velocity,
)

Array = NDArray[np.float64]


def lattice(n: int, dimensions: int, half_width: float = 1.0) -> tuple[list[Array], float]:
    axis = np.linspace(-half_width, half_width, n)
    return list(np.meshgrid(*[axis] * dimensions, indexing="ij")), float(axis[1] - axis[0])


def radius_of(phi: Array, spacing: float) -> float:
    """Radius of the ball whose content equals that of phi < 0, to a fraction of a cell."""
    cells = np.clip(0.5 - phi / spacing, 0, 1).sum() * spacing**phi.ndim
    return float(np.sqrt(cells / np.pi) if phi.ndim == 2 else np.cbrt(cells * 3 / (4 * np.pi)))


@pytest.mark.parametrize(("dimensions", "n"), [(2, 81), (3, 33)])
def test_curvature_flow_shrinks_balls_at_the_exact_rate(dimensions: int, n: int) -> None:
    axes, h = lattice(n, dimensions)
    phi = np.sqrt(sum(a**2 for a in axes)) - 0.7
    step = 0.2 * h * h / dimensions
    steps = int(0.1 / step)
    for _ in range(steps):
        phi = step_by_curvature(phi, 1.0, h, step)
    exact = np.sqrt(0.7**2 - 2 * (dimensions - 1) * steps * step)
    assert radius_of(phi, h) == pytest.approx(exact, abs=0.3 * h)


@pytest.mark.parametrize("dimensions", [2, 3])
@pytest.mark.parametrize("speed", [1.0, -1.0])
def test_normal_motion_moves_balls_by_time(dimensions: int, speed: float) -> None:
    axes, h = lattice(61, dimensions)
    phi = np.sqrt(sum(a**2 for a in axes)) - 0.6
    for _ in range(20):
        phi = step_along_normal(phi, speed, h, 0.3 * h)
    assert radius_of(phi, h) == pytest.approx(0.6 + speed * 6 * h, abs=0.3 * h)


def test_a_square_that_grows_gets_round_corners_and_one_that_shrinks_stays_square() -> None:
    (x, y), h = lattice(121, 2)
    corner = {}
    for speed in (1.0, -1.0):
        phi = np.maximum(np.abs(x), np.abs(y)) - 0.5
        phi = np.where(
            phi > 0, np.hypot(np.maximum(abs(x) - 0.5, 0), np.maximum(abs(y) - 0.5, 0)), phi
        )
        for _ in range(30):
            phi = step_along_normal(phi, speed, h, 0.4 * h)
        diagonal = ndimage.map_coordinates(phi, [np.linspace(60, 120, 2000)] * 2, order=1)
        corner[speed] = np.linspace(0, 1, 2000)[np.argmax(diagonal > 0)] * np.sqrt(2)
    travel = 30 * 0.4 * h
    assert corner[1.0] == pytest.approx(0.5 * np.sqrt(2) + travel, abs=1.5 * h)
    assert corner[-1.0] == pytest.approx((0.5 - travel) * np.sqrt(2), abs=1.5 * h)


def turned_polygon(dimensions: int, n: int) -> tuple[float, float, float, float]:
    """Content kept, centre and grid spacing after a quarter turn of a box about the origin."""
    axes, h = lattice(n, dimensions)
    x, y = axes[:2]
    sides = [np.abs(x - 0.35) - 0.3, np.abs(y) - 0.3, *[np.abs(z) - 0.5 for z in axes[2:]]]
    phi = np.max(sides, axis=0)
    before = (phi < 0).sum()
    velocity = np.stack([-y, x, *[np.zeros_like(x) for _ in axes[2:]]])
    steps = int(3.2 / h)
    for _ in range(steps):
        phi = step_by_velocity(phi, velocity, h, np.pi / 2 / steps)
    inside = phi < 0
    return inside.sum() / before, float(x[inside].mean()), float(y[inside].mean()), h


@pytest.mark.parametrize(("dimensions", "n"), [(2, 81), (3, 41)])
def test_rotation_carries_a_polygon_round(dimensions: int, n: int) -> None:
    _, x, y, h = turned_polygon(dimensions, n)
    assert x == pytest.approx(0.0, abs=h)
    assert y == pytest.approx(0.35, abs=h)


def test_rotation_keeps_the_area_to_first_order() -> None:
    coarse, fine = (1.0 - turned_polygon(2, n)[0] for n in (81, 241))
    assert 0.0 <= fine < 0.05
    assert fine < 0.6 * coarse


def star(x: Array, y: Array) -> Array:
    return np.hypot(x, y) - (0.5 + 0.2 * np.cos(7 * np.arctan2(y, x)))


def test_a_star_turns_round_under_curvature_then_shrinks() -> None:
    (x, y), h = lattice(101, 2)
    phi = star(x, y)

    def roundness(values: Array) -> float:
        rim = np.hypot(x, y)[np.abs(values) < h]
        return float(rim.std() / rim.mean())

    before, area = roundness(phi), (phi < 0).sum() * h * h
    for _ in range(1500):
        phi = step_by_curvature(phi, 1.0, h, 0.1 * h * h)
    assert before > 0.2
    # the total curvature of any closed curve is 2 pi, so its area falls at that rate
    assert area - (phi < 0).sum() * h * h == pytest.approx(2 * np.pi * 150 * h * h, rel=0.03)
    assert roundness(phi) < 0.05
    assert 0.2 < radius_of(phi, h) < 0.5


def test_a_star_that_grows_along_its_normal_stays_at_that_distance_from_where_it_was() -> None:
    h = 2.4 / 200
    fine = np.linspace(-1.2, 1.2, 801)
    inside = star(*np.meshgrid(fine, fine, indexing="ij")) < 0
    outside = ndimage.distance_transform_edt(~inside) - 0.5
    distance = h / 4 * np.where(inside, 0.5 - ndimage.distance_transform_edt(inside), outside)
    phi = start = distance[::4, ::4]
    for _ in range(50):
        phi = step_along_normal(phi, 1.0, h, 0.4 * h)
    exact = start - 20 * h
    assert np.abs(exact[np.abs(phi) < h / 2]).mean() < 0.6 * h


def test_curvature_of_a_sphere_is_two_over_its_radius() -> None:
    axes, h = lattice(61, 3)
    phi = np.sqrt(sum(a**2 for a in axes)) - 0.6
    near = np.abs(phi) < h
    assert curvature(phi, h)[near] == pytest.approx(2 / (phi[near] + 0.6), rel=0.02)


def test_backward_curvature_flow_is_refused() -> None:
    with pytest.raises(ValueError, match="ill-posed"):
        step_by_curvature(np.zeros((5, 5)), -1.0, 1.0, 0.1)


# --- the obstacle energy: f < 0 inside r = 0.7, g low on that surface (thesis, section 5.6)


def weights(r: Array) -> tuple[Array, Array]:
    f = -1 / (1 + np.exp((r - 0.7) / 0.08))
    g = 0.5 * (1 - 0.8 * np.exp(-(((r - 0.7) / 0.15) ** 2)))
    return f, g


def best_radius(dimensions: int) -> float:
    r = np.linspace(0, 1.2, 20001)
    f, g = weights(r)
    rim = 2 * np.pi * r if dimensions == 2 else 4 * np.pi * r**2
    energy = np.cumsum(rim * f) * (r[1] - r[0]) + rim * g
    return float(r[np.argmin(np.where(r > 0.4, energy, np.inf))])


def ball_problem(layers: bool) -> tuple[Array, Array, Array, Array, list[Array]]:
    n = 56
    axis = (np.arange(n) - (n - 1) / 2) * (2.4 / n)
    z = axis[:6] if layers else axis
    x, y, z = np.meshgrid(axis, axis, z, indexing="ij")
    r = np.hypot(x - 0.1, y) if layers else np.sqrt((x - 0.1) ** 2 + y**2 + z**2)
    f, g = (a.astype(np.float32) for a in weights(r))
    return r, f, g, np.full(3, 2.4 / n), [x, y, z]


@pytest.mark.parametrize("start", ["box", "seed"])
@pytest.mark.parametrize(("evolution", "levels"), [("volume", 1), ("volume", 2), ("layers", 1)])
def test_the_front_comes_to_rest_at_the_analytic_minimum(
    evolution: str, start: str, levels: int
) -> None:
    layers = evolution == "layers"
    r, f, g, spacing, (x, y, z) = ball_problem(layers)
    if start == "box":
        sides = [np.abs(x), np.abs(y)] if layers else [np.abs(x), np.abs(y), np.abs(z)]
        u0 = 1.1 - np.max(sides, axis=0)
    else:
        # inside of this the area term outweighs the volume term: no seed would grow
        u0 = (0.5 if layers else 0.62) - r
    result = evolve(
        u0.astype(np.float32), f, g, spacing, iterations=3000, evolution=evolution,  # type: ignore[arg-type]
        levels=levels, tolerance=1e-5,
    )  # fmt: skip
    assert result.converged
    rim = r[np.abs(result.u) < 0.5 * spacing[0]] + result.u[np.abs(result.u) < 0.5 * spacing[0]]
    expected = best_radius(2 if layers else 3)
    assert rim.mean() == pytest.approx(expected, abs=0.2 * spacing[0])
    assert rim.std() < 0.2 * spacing[0]
    energies = [e for _, e in result.energy]
    assert len(energies) > 3
    assert (np.diff(energies) <= 0).all()


def test_the_minimum_in_two_dimensions_is_the_known_one() -> None:
    assert best_radius(2) == pytest.approx(0.708, abs=0.002)


@pytest.mark.parametrize("layers", [False, True])
def test_measured_energy_is_that_of_the_ball(layers: bool) -> None:
    r, _, _, spacing, _ = ball_problem(layers)
    one = np.ones_like(r, dtype=np.float32)
    energy = measure((0.6 - r).astype(np.float32), -one, 2 * one, spacing, layers=layers)
    depth = r.shape[2] * spacing[2]
    volume = np.pi * 0.36 * depth if layers else 4 / 3 * np.pi * 0.216
    area = 2 * np.pi * 0.6 * depth if layers else 4 * np.pi * 0.36
    assert energy.volume == pytest.approx(-volume, rel=0.005)
    assert energy.area == pytest.approx(2 * area, rel=0.005)
    assert energy.total == energy.volume + energy.area


def test_the_energy_of_a_plane_does_not_depend_on_where_it_cuts_the_grid() -> None:
    z = np.broadcast_to(np.arange(16.0), (4, 4, 16))
    one = np.ones(z.shape, dtype=np.float32)
    areas = [
        measure((7 + s - z).astype(np.float32), one, one, np.ones(3)).area
        for s in np.linspace(0, 1, 7)
    ]
    assert areas == pytest.approx([16.0] * 7, rel=1e-5)


def two_boxes() -> tuple[Array, Array, Array, Array]:
    """Distance to two boxes on the ground, weights, and a start that holds both (voxels)."""
    shape = (64, 40, 24)
    x, y, z = np.meshgrid(*[np.arange(n, dtype=float) for n in shape], indexing="ij")

    def box(cx: float, cy: float) -> Array:
        return np.maximum.reduce([np.abs(x - cx) - 9, np.abs(y - cy) - 9, z - 14])

    d = np.minimum(box(17, 20), box(47, 20))
    f = np.tanh(d / 2) * np.where(d < 0, 1.0, 0.2)
    g = 0.4 * (1 - 0.8 * np.exp(-((d / 2) ** 2)))
    u0 = np.minimum.reduce([29 - np.abs(x - 31.5), 17 - np.abs(y - 19.5), 21 - z])
    return d, f.astype(np.float32), g.astype(np.float32), u0.astype(np.float32)


@pytest.mark.parametrize("levels", [1, 2, None])
def test_one_box_splits_into_two_obstacles(levels: int | None) -> None:
    d, f, g, u0 = two_boxes()
    assert ndimage.label(u0 > 0)[1] == 1
    seen: list[int] = []
    result = evolve(
        u0, f, g, np.ones(3), iterations=2000, levels=levels,
        on_iteration=lambda iteration, u: seen.append(int(ndimage.label(u > 0)[1])),
    )  # fmt: skip
    assert result.converged
    assert seen[0] == 1
    assert seen[-1] == ndimage.label(result.u > 0)[1] == 2
    assert len(seen) == len(result.energy)
    inside, truth = result.u > 0, d < 0
    assert (inside & truth).sum() / (inside | truth).sum() > 0.93
    assert (np.diff([e for _, e in result.energy]) <= 0).all()


def test_a_start_at_rest_is_left_alone() -> None:
    _, f, g, u0 = two_boxes()
    first = evolve(u0, f, g, np.ones(3), iterations=2000, tolerance=1e-5)
    again = evolve(first.u, f, g, np.ones(3), iterations=2000, tolerance=1e-5)
    assert np.abs(again.u - first.u)[np.abs(first.u) < 2].max() < 0.5
    start, end = again.energy[0][1], again.energy[-1][1]
    assert end <= start
    assert end == pytest.approx(start, rel=2e-3)


def test_units_do_not_matter() -> None:
    _, f, g, u0 = two_boxes()
    voxels = evolve(u0, f, g, np.ones(3), iterations=300)
    metres = evolve(u0, f, 0.005 * g, np.full(3, 0.005), iterations=300)
    assert metres.iterations == voxels.iterations
    assert np.abs(metres.u / 0.005 - voxels.u).max() < 0.05


@pytest.mark.parametrize("evolution", ["volume", "layers"])
def test_any_number_of_threads_gives_the_same_bytes(evolution: str) -> None:
    _, f, g, u0 = two_boxes()
    one, two, five = (
        evolve(u0, f, g, np.ones(3), iterations=150, evolution=evolution, jobs=jobs)  # type: ignore[arg-type]
        for jobs in (1, 2, 5)
    )
    assert one.u.tobytes() == two.u.tobytes() == five.u.tobytes()
    assert one.energy == two.energy == five.energy


@pytest.mark.parametrize("width", [5, 8])
def test_a_thin_pole_is_not_lost_on_coarse_levels(width: int) -> None:
    x, y, z = np.meshgrid(*[np.arange(64.0)] * 3, indexing="ij")
    d = np.maximum(np.hypot(x - 31.7, y - 30.4) - width / 2, z - 50)
    f = (np.tanh(d / 1.5) * np.where(d < 0, 1.0, 0.15)).astype(np.float32)
    g = (0.4 * (1 - 0.8 * np.exp(-((d / 2) ** 2)))).astype(np.float32)
    u0 = np.minimum.reduce([26 - np.abs(x - 31), 26 - np.abs(y - 31), 60 - z]).astype(np.float32)
    result = evolve(u0, f, g, np.ones(3), iterations=2000, levels=3)
    inside = result.u > 0
    assert (inside & (d < 0)).sum() > 0.85 * (d < 0).sum()
    assert (inside & (d > 1)).sum() == 0
    assert (np.diff([e for _, e in result.energy]) <= 0).all()


@pytest.mark.parametrize("gap", [1, 2, 3])
def test_a_start_close_to_the_faces_is_driven_in_on_coarse_levels(gap: int) -> None:
    x, y, z = np.meshgrid(*[np.arange(n, dtype=float) for n in (72, 72, 56)], indexing="ij")
    d = np.sqrt((x - 30) ** 2 + (y - 40) ** 2 + (z - 20) ** 2) - 12
    f = (0.5 * np.tanh(d)).astype(np.float32)
    g = np.full_like(f, 0.3)
    u0 = np.full(f.shape, -1, np.float32)
    u0[gap:-gap, gap:-gap, :-gap] = 1
    seen: list[tuple[int, int]] = []
    result = evolve(
        u0, f, g, np.ones(3), iterations=2000, levels=3,
        on_iteration=lambda iteration, u: seen.append((iteration, int((u > 0).sum()))),
    )  # fmt: skip
    # half of the way within the first looks, which are at coarse levels
    assert min(inside for iteration, inside in seen if iteration < 100) < 0.5 * (u0 > 0).sum()
    assert result.iterations < 200
    assert (result.u > 0).sum() == pytest.approx((d < 0).sum(), rel=0.08)


def test_axes_are_treated_alike() -> None:
    _, f, g, u0 = two_boxes()
    plain = evolve(u0, f, g, np.ones(3), iterations=60, levels=1).u
    turned = evolve(
        *(a.transpose(2, 0, 1).copy() for a in (u0, f, g)), np.ones(3), iterations=60, levels=1
    ).u
    assert np.abs(turned.transpose(1, 2, 0) - plain).max() < 1e-3


def test_unequal_spacing_gives_the_same_shape() -> None:
    _, f, g, u0 = two_boxes()
    wide = slice(0, None, 2)
    full = evolve(u0, f, g, np.ones(3), iterations=2000, tolerance=1e-5)
    half = evolve(
        u0[:, :, wide].copy(),
        f[:, :, wide].copy(),
        g[:, :, wide].copy(),
        np.array([1, 1, 2.0]),
        iterations=2000,
        tolerance=1e-5,
    )
    assert (half.u > 0).sum() * 2 == pytest.approx((full.u > 0).sum(), rel=0.08)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda u, f, g: (u[1:], f, g), "shapes differ"),
        (lambda u, f, g: (u, f, g - 1), "negative"),
        (lambda u, f, g: (u, f * np.float32("nan"), g), "finite"),
    ],
)
def test_impossible_weights_are_refused(change, message: str) -> None:  # type: ignore[no-untyped-def]
    _, f, g, u0 = two_boxes()
    with pytest.raises(ValueError, match=message):
        evolve(*change(u0, f, g), np.ones(3), iterations=10)


def test_an_empty_start_stays_empty() -> None:
    _, f, g, _ = two_boxes()
    result = evolve(-np.ones_like(f), f, g, np.ones(3), iterations=50, levels=1)
    assert not (result.u > 0).any()
    assert result.energy[-1][1] == 0


def test_grid_indices_and_map_coordinates_are_inverse() -> None:
    grid = VoxelGrid.over(np.array([-1.0, 0.0, 0.0]), np.array([1.0, 1.0, 0.5]), (20, 10, 5))
    assert grid.origin == pytest.approx([-0.95, 0.05, 0.05])
    index = np.array([[0.0, 0.0, 0.0], [3.5, 2.0, 4.0]])
    assert grid.index_from_map(grid.map_from_index(index)) == pytest.approx(index)
    assert grid.centres()[3, 2, 1] == pytest.approx(grid.map_from_index(np.array([3, 2, 1])))
    assert grid.upper == pytest.approx([1.0, 1.0, 0.5])
    with pytest.raises(ValueError, match="positive"):
        VoxelGrid(np.zeros(3), np.zeros(3), (2, 2, 2))
