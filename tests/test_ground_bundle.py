import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from gvpipe.core.geometry.homography import apply, fit_linear, transfer_errors
from gvpipe.core.geometry.pose import robot_from_camera
from gvpipe.core.slam.adjustment import adjust, approach, begin
from gvpipe.core.slam.correlation import JUDGED_LINKS, judged_links, shared_errors
from gvpipe.core.slam.ground_bundle import Problem
from gvpipe.core.slam.links import Matches, matches_of
from gvpipe.core.slam.location_graph import MapOptions, build_map
from gvpipe.core.slam.rig import (
    Rig,
    Spread,
    State,
    camera_from_map,
    centres,
    pose_jacobians,
    rescaled,
    turning,
)
from gvpipe.core.slam.tracks import cell_tracks, chain_matches
from gvpipe.core.types import Float, Mount
from tests.slam_scene import arc_path, errors, loop_path, make_scene, mapped, true_map


def some_rig(count: int, rng: np.random.Generator) -> tuple[Rig, Float]:
    mounts = [Mount(tilt=0.6, roll=0.05, height=0.6) for _ in range(count)]
    rig = Rig(
        matrix=np.tile([[550.0, 0.0, 321.0], [0.0, 550.0, 242.0], [0.0, 0.0, 1.0]], (count, 1, 1)),
        robot_from_camera=np.stack([robot_from_camera(m).rotation for m in mounts]),
        height=np.full(count, 0.6),
        group=np.zeros(count, dtype=np.int64),
    )
    return rig, rng.normal(0.0, [0.2, 0.2, 0.2, 0.05, 0.05, 0.02], (count, 6))


def test_orientation_derivatives_are_those_of_finite_differences() -> None:
    rig, cameras = some_rig(4, np.random.default_rng(1))
    cameras[0, 3:5] = 0.0
    turned = turning(rig, cameras)
    step = 1e-6
    for slot, unknown in enumerate((2, 3, 4)):
        ahead, behind = cameras.copy(), cameras.copy()
        ahead[:, unknown] += step
        behind[:, unknown] -= step
        difference = (camera_from_map(rig, ahead) - camera_from_map(rig, behind)) / (2 * step)
        np.testing.assert_allclose(turned[:, slot], difference, atol=1e-8)


def test_pose_jacobians_are_those_of_finite_differences() -> None:
    rig, cameras = some_rig(3, np.random.default_rng(2))
    step = 1e-6
    numeric = np.empty((3, 6, 6))
    for unknown in range(6):
        ahead, behind = cameras.copy(), cameras.copy()
        ahead[:, unknown] += step
        behind[:, unknown] -= step
        after, before = (camera_from_map(rig, c).transpose(0, 2, 1) for c in (ahead, behind))
        turn = Rotation.from_matrix(after @ before.transpose(0, 2, 1)).as_rotvec()
        numeric[:, :3, unknown] = turn / (2 * step)
        numeric[:, 3:, unknown] = (centres(rig, ahead) - centres(rig, behind)) / (2 * step)
    np.testing.assert_allclose(pose_jacobians(rig, cameras), numeric, atol=1e-7)


def test_normal_equations_point_down_the_cost() -> None:
    # at the best points the gradient of the reduced system is that of the cost itself
    scene = make_scene({"A": arc_path(3)}, np.random.default_rng(3), density=20.0)
    index = {image: k for k, image in enumerate(scene.order)}
    tracks = chain_matches(
        [(index[x.image_i], index[x.image_j]) for x in scene.links],
        [(x.points_i, x.points_j) for x in scene.links],
    )
    rig, noise = some_rig(3, np.random.default_rng(4))
    cameras = 0.02 * noise + np.column_stack([arc_path(3), np.zeros((3, 3))])
    spread = Spread(np.full((1, 3), 0.05), np.full((1, 3), 0.05), np.array([-1]))
    problem = Problem(rig, tracks, 0)
    means = np.array([[0.01, -0.02, 0.003]])
    state = State(cameras, means, problem.initial_points(cameras))
    for _ in range(50):
        _, _, elimination = problem._linearise(state, spread, 3.0, 0.7)
        state = problem._moved(state, np.zeros(21), elimination)
    _, gradient, _ = problem._linearise(state, spread, 3.0, 0.7)
    step = 1e-6
    for k in range(21):
        move = np.zeros(21)
        move[k] = step
        costs = []
        for sign in (1.0, -1.0):
            moved = State(
                state.cameras + sign * move[:18].reshape(3, 6),
                state.means + sign * move[18:].reshape(1, 3),
                state.points,
            )
            costs.append(problem.cost(moved, spread, 3.0, 0.7))
        numeric = (costs[0] - costs[1]) / (2 * step)
        assert 2.0 * gradient[k] == pytest.approx(numeric, rel=1e-4, abs=1e-3)


def test_rescaling_leaves_the_residuals_alone_and_serves_the_priors() -> None:
    scene = make_scene({"A": arc_path(3)}, np.random.default_rng(5), density=20.0)
    tracks = chain_matches([(0, 1)], [(scene.links[0].points_i, scene.links[0].points_j)])
    rig, cameras = some_rig(3, np.random.default_rng(6))
    problem = Problem(rig, tracks, 0)
    spread = Spread(np.full((1, 3), 0.05), np.full((1, 3), 0.05), np.array([-1]))
    state = State(cameras, np.full((1, 3), 0.02), problem.initial_points(cameras))
    scaled = rescaled(state, spread)
    np.testing.assert_allclose(problem.misfits(scaled), problem.misfits(state), rtol=1e-9)
    assert problem.cost(scaled, spread, 3.0, 1.0) < problem.cost(state, spread, 3.0, 1.0)


def test_chains_join_pairs_that_share_corners() -> None:
    a = np.array([[10.0, 10.0], [50.0, 60.0], [90.0, 20.0]])
    b, c = a + 5.0, a + 9.0
    tracks = chain_matches([(0, 1), (1, 2)], [(a, b), (b[:2], c[:2])])
    assert sorted(np.diff(tracks.start).tolist()) == [2, 3, 3]
    assert len(tracks.camera) == 8


def test_a_chain_that_meets_an_image_twice_falls_apart() -> None:
    a, b, c = np.array([[10.0, 10.0]]), np.array([[20.0, 20.0]]), np.array([[30.0, 30.0]])
    elsewhere = np.array([[400.0, 300.0]])
    tracks = chain_matches([(0, 1), (1, 2), (0, 2)], [(a, b), (b, c), (elsewhere, c)])
    assert np.diff(tracks.start).tolist() == [2, 2, 2]
    pairs = {tuple(tracks.camera[s : s + 2].tolist()) for s in tracks.start[:-1]}
    assert pairs == {(0, 1), (1, 2), (0, 2)}


def test_exact_matches_give_exact_poses() -> None:
    scene = make_scene(
        {"A": arc_path(6)}, np.random.default_rng(7), noise_px=0.0, shake=0.02, bounce=0.0
    )
    found = errors(mapped(scene), true_map(scene, "A/0000.jpg"))
    assert np.abs(found).max() < 1e-4


def test_the_covariance_is_honest() -> None:
    # normalised squared errors of 6 numbers a pose, averaged over runs: chi-squared
    runs, images = 24, 7
    squares = np.zeros(images - 1)
    for seed in range(runs):
        scene = make_scene(
            {"A": arc_path(images, bend=0.1)},
            np.random.default_rng(seed),
            density=50.0,
            scale_sigma=0.005,
            wrong_matches=0.01,
        )
        result = mapped(scene)
        found = errors(result, true_map(scene, "A/0000.jpg"))[1:]
        covariances = [posed.covariance for posed in result.poses.values()][1:]
        squares += [e @ np.linalg.solve(c, e) for e, c in zip(found, covariances, strict=True)]
    low, high = chi2.ppf([0.001, 0.999], 6 * runs) / (6 * runs)
    assert ((low < squares / (6 * runs)) & (squares / (6 * runs) < high)).all(), squares


def test_many_pictures_of_a_robot_are_not_taken_by_hand() -> None:
    # the shared uncertainty of the scale must not pass for scatter of the single heights
    scene = make_scene({"A": arc_path(60)}, np.random.default_rng(10), density=15.0)
    index = {image: k for k, image in enumerate(scene.order)}
    pairs = [(index[x.image_i], index[x.image_j]) for x in scene.links]
    tracks = chain_matches(pairs, [(x.points_i, x.points_j) for x in scene.links])
    mounts = [scene.mounts[image] for image in scene.order]
    rig = Rig(
        matrix=np.stack([scene.cameras[image].matrix for image in scene.order]),
        robot_from_camera=np.stack([robot_from_camera(m).rotation for m in mounts]),
        height=np.array([m.height for m in mounts]),
        group=np.zeros(len(mounts), dtype=np.int64),
    )
    problem = Problem(rig, tracks, 0)
    cameras = np.column_stack([arc_path(60), np.zeros((60, 3))])
    sigma = np.array([[0.05, 0.05, 0.005]])
    start = approach(problem, begin(problem, cameras, sigma, None))
    adjusted = adjust(problem, start, None)
    assert adjusted.spread.within[0, 2] == pytest.approx(0.002, rel=0.4)
    assert adjusted.spread.anchor[0] == -1


def test_matches_are_sampled_evenly() -> None:
    counts = (0, 3, 4, 9, 1)
    start = np.append(0, np.cumsum(counts))
    points = np.arange(34.0).reshape(17, 2)
    few = Matches(start, points, points + 100.0).sampled(4)
    expected = [points[a:b][:: max(-(-(b - a) // 4), 1)] for a, b in itertools.pairwise(start)]
    assert few.count.tolist() == [0, 3, 4, 3, 1]
    np.testing.assert_array_equal(few.points_i, np.concatenate(expected))
    np.testing.assert_array_equal(few.points_j, few.points_i + 100.0)


def test_few_links_are_all_judged_and_many_are_thinned() -> None:
    assert len(range(7)[judged_links(7)]) == 7
    assert len(range(0)[judged_links(0)]) == 0
    assert len(range(JUDGED_LINKS + 1)[judged_links(JUDGED_LINKS + 1)]) > JUDGED_LINKS / 2
    assert len(range(10_000)[judged_links(10_000)]) <= JUDGED_LINKS


def test_cells_of_matches_say_what_the_matches_say() -> None:
    rng = np.random.default_rng(11)
    scene = make_scene({"A": arc_path(2)}, rng, density=300.0, wrong_matches=0.02)
    [link] = scene.links
    ends, matches = np.array([[1, 0]]), matches_of([link])
    tracks = cell_tracks(ends, matches, np.array([0]), link.homography[None])
    assert len(tracks.weight) <= 16
    assert (tracks.camera.reshape(-1, 2) == [0, 1]).all()
    good = transfer_errors(link.homography, link.points_i, link.points_j) < 3.0
    assert tracks.weight.sum() == pytest.approx(good.sum(), rel=0.05)
    q, p = tracks.pixel.reshape(-1, 2, 2).transpose(1, 0, 2)
    whole = fit_linear(link.points_i[good], link.points_j[good])
    few = fit_linear(p, q, np.sqrt(tracks.weight))
    assert whole is not None
    assert few is not None
    corners = np.array([link.points_i.min(axis=0), link.points_i.max(axis=0)])
    # four degrees of freedom fewer than matches: the fits differ by less than their own noise
    np.testing.assert_allclose(apply(few, corners), apply(whole, corners), atol=0.4)


def test_heights_taken_by_hand_are_scaled_by_the_first_picture() -> None:
    scene = make_scene(
        {"A": loop_path(12, radius=0.5)},
        np.random.default_rng(8),
        bounce=0.06,
        shake=np.radians(3.0),
    )
    # the user measured the first picture's height
    first = scene.poses["A/0000.jpg"].translation[2]
    mounts = {
        image: Mount(tilt=m.tilt, roll=m.roll, height=first) for image, m in scene.mounts.items()
    }
    result = build_map(scene.cameras, mounts, scene.order, scene.links, "A/0000.jpg", MapOptions())
    found = errors(result, true_map(scene, "A/0000.jpg"))
    assert np.linalg.norm(found[:, 3:], axis=1).max() < 0.01


def test_a_robot_s_height_is_the_mean_of_its_pictures() -> None:
    scene = make_scene({"A": loop_path(16)}, np.random.default_rng(9), bounce=0.002)
    result = mapped(scene)
    heights = [posed.map_from_camera.translation[2] for posed in result.poses.values()]
    assert np.mean(heights) == pytest.approx(0.6, rel=5e-4)
    found = errors(result, true_map(scene, "A/0000.jpg"))
    assert np.sqrt((found[:, 3:] ** 2).sum(axis=1).mean()) < 0.006


def test_independent_errors_share_nothing_and_waves_do() -> None:
    rng = np.random.default_rng(4)
    h = np.array([[0.9, 0.1, 20.0], [-0.05, 1.1, 5.0], [1e-4, 2e-4, 1.0]])
    independent, waves = [], []
    for _ in range(60):
        p = rng.uniform([0, 0], [640, 480], (150, 2))
        q = apply(h, p) + rng.normal(0.0, 0.3, p.shape)
        q[:3] += 40.0
        independent.append((h, p, q))
        phase = rng.uniform(0, 2 * np.pi, 4)
        wave = np.column_stack([np.sin(p[:, k] / 60.0 + phase[k]) for k in (0, 1)])
        waves.append((h, p, q + 0.1 * wave))
    assert shared_errors(independent) < 1.15
    assert shared_errors(waves) > 1.5
    assert shared_errors([(h, p[:9], q[:9])]) == 1.0
    assert shared_errors([(h, p, apply(h, p))]) == 1.0
