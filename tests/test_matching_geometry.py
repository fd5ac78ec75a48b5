"""The pair's eight parameters, their fit, and the planes and shifts compared with it."""

import numpy as np
import pytest

from gvpipe.core.geometry.ground import pixel_from_ground, pixel_from_plane
from gvpipe.core.geometry.homography import apply, normalise
from gvpipe.core.geometry.pose import planar_pose
from gvpipe.core.geometry.twoview import PairPrior, TwoView, fit_two_views, two_views
from gvpipe.core.kernels.hypotheses import score_pairs
from gvpipe.core.kernels.matching import SIZE, nearest_two
from gvpipe.core.matching.features import MatchOptions
from gvpipe.core.matching.lower_plane import plane_at
from gvpipe.core.matching.rivals import repetitions, shifted
from gvpipe.core.matching.sift import candidate_matches, extract_sift
from gvpipe.core.types import Camera, Mount, Pose
from tests.synthetic import CAMERA, Scene, texture, tiles, view_at

OTHER = Camera(width=400, height=300, fx=450.0, fy=455.0, cx=199.5, cy=149.5, skew=0.3)
PRIOR = PairPrior(np.radians(3), np.radians(3), np.radians(3), 0.03, np.radians(14))


def pair(**changes: float) -> TwoView:
    return TwoView(
        CAMERA,
        OTHER,
        Mount(np.radians(38), np.radians(3), 0.6),
        Mount(np.radians(45), np.radians(-5), 0.7),
        **({"yaw": 0.6, "x": 0.3, "y": -0.2, "log_scale": 0.02} | changes),
    )


def grid() -> np.ndarray:
    u, v = np.meshgrid(np.linspace(0, 319, 12), np.linspace(60, 239, 12))
    return np.column_stack([u.ravel(), v.ravel()])


def test_homography_is_the_chain_through_both_grounds() -> None:
    p = pair()
    chain = (
        pixel_from_ground(p.camera_j, p.mount_j)
        @ p.ground_j_from_ground_i
        @ np.linalg.inv(pixel_from_ground(p.camera_i, p.mount_i))
    )
    np.testing.assert_allclose(p.homography, normalise(chain), rtol=1e-9)


def test_parameters_round_trip_and_cover_every_homography() -> None:
    p = pair()
    np.testing.assert_allclose(p.with_parameters(p.parameters).parameters, p.parameters)
    columns = []
    for k in range(8):
        moved = p.parameters + 1e-6 * (np.arange(8) == k)
        columns.append((p.with_parameters(moved).homography - p.homography).ravel() / 1e-6)
    jacobian = np.column_stack(columns)
    jacobian /= np.linalg.norm(jacobian, axis=0)
    assert np.linalg.matrix_rank(jacobian, tol=1e-6) == 8


def test_fit_recovers_the_geometry_among_wrong_matches() -> None:
    rng = np.random.default_rng(1)
    true = pair()
    p = grid()
    q = apply(true.homography, p) + rng.normal(scale=0.2, size=p.shape)
    q[::3] += rng.normal(scale=80.0, size=q[::3].shape)
    told = pair(yaw=0.0, x=0.0, y=0.0, log_scale=0.0)
    start = true.with_parameters(
        true.parameters + np.array([0.03, 0.04, -0.04, 0, 0.05, 0, -0.05, 0])
    )
    coarse = fit_two_views(start, told, PRIOR, p, q, np.tile(np.eye(2) / 5.0, (len(p), 1, 1)))
    fine = fit_two_views(
        coarse.geometry, told, PRIOR, p, q, np.tile(np.eye(2) / 0.2, (len(p), 1, 1))
    )
    off = apply(fine.geometry.homography, p) - apply(true.homography, p)
    assert 0.005 < np.sqrt((off**2).sum(axis=1).mean()) < 0.2
    covariance = fine.homography_covariance
    assert np.linalg.matrix_rank(covariance, tol=1e-9 * np.trace(covariance)) <= 8


def test_a_wall_keeps_the_cameras_near_their_configuration() -> None:
    true = pair()
    p = grid()
    q = apply(true.homography, p)
    tilted = true.with_parameters(true.parameters + np.array([0, 0, 0, 0, 0.6, 0, 0, 0]))
    fit = fit_two_views(tilted, tilted, PRIOR, p, q)
    assert fit.geometry.drift(tilted) < PRIOR.limit + np.radians(4.0)  # of the 34 it is off


def test_plane_at_finds_the_ground_under_a_lid() -> None:
    low, high = Mount(0.7, 0.0, 0.6), Mount(0.8, 0.0, 0.75)
    pose_i, pose_j = planar_pose(0, 0, 0.0, low), planar_pose(0.3, 0.2, 0.5, high)
    lid = 0.2

    def from_plane(camera: Camera, pose: Pose, height: float) -> np.ndarray:
        return pixel_from_plane(camera, Pose(pose.rotation, pose.translation - [0, 0, height]))

    of_lid = from_plane(OTHER, pose_j, lid) @ np.linalg.inv(from_plane(CAMERA, pose_i, lid))
    of_ground = from_plane(OTHER, pose_j, 0) @ np.linalg.inv(from_plane(CAMERA, pose_i, 0))
    p = grid()
    told = TwoView(CAMERA, OTHER, low, high, yaw=-0.5)
    loose = PairPrior(0.5, 0.5, 0.5, 1.0)
    on_lid = fit_two_views(told, told, loose, p, apply(of_lid, p), loss=1e3, iterations=200)
    ground = plane_at(on_lid.geometry, (high.height - lid) / high.height)
    np.testing.assert_allclose(apply(ground.homography, p), apply(of_ground, p), atol=0.2)


def test_repetitions_are_multiples_of_the_tile() -> None:
    scene = Scene(tiles(np.random.default_rng(5)))
    view, _ = view_at(scene, 0, 0, 15, 45)
    shifts = repetitions(view, two_views(view, view))
    assert len(shifts)
    side = 6.0 / 16
    c, s = np.cos(np.radians(15)), np.sin(np.radians(15))
    on_map = shifts @ np.array([[c, s], [-s, c]])
    np.testing.assert_allclose(on_map / side, np.rint(on_map / side), atol=0.1)
    view, _ = view_at(Scene(texture(np.random.default_rng(3))), 0, 0, 15, 45)
    assert not len(repetitions(view, two_views(view, view)))


def test_shifted_moves_the_ground_of_i() -> None:
    p = pair()
    moved = shifted(p, np.array([0.1, -0.3]))
    point = np.array([[0.7, 0.2]])
    np.testing.assert_allclose(
        apply(moved.ground_j_from_ground_i, point),
        apply(p.ground_j_from_ground_i, point + np.array([0.1, -0.3])),
    )


@pytest.mark.parametrize("yaw_deg", [0.0, 100.0, -140.0])
def test_keypoints_turn_with_the_robot(yaw_deg: float) -> None:
    scene = Scene(texture(np.random.default_rng(3)))
    yaw = np.radians(yaw_deg)
    centre = 0.8 * np.array([1 - np.cos(yaw), -np.sin(yaw)])  # both look at (0.8, 0)
    options = MatchOptions()
    a = extract_sift(view_at(scene, 0, 0, 0, 45)[0], options)
    b = extract_sift(view_at(scene, *centre, yaw_deg, 45)[0], options)
    i, j, _ = candidate_matches(a, b, 0.8)
    assert len(i) > 15
    assert 0.2 < a.dark.mean() < 0.8
    assert (a.dark[i] == b.dark[j]).all()
    turn = b.angle[j] - a.angle[i]
    # what lies ahead of i is turned back by the yaw of j
    assert np.degrees(np.angle(np.exp(1j * (turn + yaw)).mean())) == pytest.approx(0.0, abs=3.0)
    assert np.median(np.log(b.size[j] / a.size[i])) == pytest.approx(0.0, abs=0.05)


def test_nearest_descriptors_are_exact_within_their_rows() -> None:
    rng = np.random.default_rng(2)
    a, b = (rng.choice([0, 3, 250, 255], (n, SIZE)).astype(np.uint8) for n in (300, 40))
    first = rng.integers(0, 38, 300)
    last = np.minimum(first + rng.integers(0, 30, 300), 40)
    nearest, ratio = nearest_two(a, b, first, last)
    for k in range(len(a)):
        square = ((a[k].astype(int) - b[first[k] : last[k]].astype(int)) ** 2).sum(axis=1)
        if len(square):
            assert nearest[k] == first[k] + square.argmin()
        best = np.sort(square)
        assert ratio[k] == (np.sqrt(best[0] / best[1]) if len(square) > 1 else 1.0)


def test_inverse_intrinsics_take_pixels_to_rays() -> None:
    np.testing.assert_allclose(OTHER.inverse @ OTHER.matrix, np.eye(3), atol=1e-15)


def test_drawing_ends_once_a_pair_explains_enough() -> None:
    rng = np.random.default_rng(4)
    ground = rng.uniform(-1.0, 1.0, (40, 2))
    wrong = np.arange(40) < 10
    moved = ground + [0.1, -0.2] + 0.5 * wrong[:, None] * rng.normal(size=(40, 2))
    draws = np.concatenate([[[0, 1], [2, 3]], rng.integers(40, size=(500, 2))])
    plane = np.diag([500.0, 500.0, 1.0])
    matches = (ground, moved, apply(plane, moved), np.zeros(40), np.zeros(40), plane)
    every, some = (
        score_pairs(draws, *matches, 0.4, 0.5, 0.6, 14.0, enough) for enough in (np.inf, 20.0)
    )
    last = int((every[:, 0] > 20.0).argmax())
    assert every[last, 1:] == pytest.approx([0.0, 0.1, -0.2, 0.0], abs=1e-9)
    np.testing.assert_array_equal(some[: last + 1], every[: last + 1])
    assert 1 < last < 500
    assert not some[last + 1 :].any()
