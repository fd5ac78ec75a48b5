"""Signatures of the ground: motion and common ground of two robots on a painted floor."""

import cv2
import numpy as np
import pytest

from gvpipe.core.geometry.ground import pixel_from_plane
from gvpipe.core.geometry.pose import planar_pose
from gvpipe.core.overlap.candidates import candidate_pairs
from gvpipe.core.overlap.signature import (
    MIN_VOTES,
    agreement,
    common_ground,
    expected_overlap,
    ground_signature,
)
from gvpipe.core.types import Camera, Mount, View

CAMERA = Camera(320, 240, 270.0, 270.0, 159.5, 119.5)
MOUNT = Mount(np.radians(45), 0.0, 0.6)
SCALE = 250.0  # texture pixels per metre


def texture(seed: int) -> np.ndarray:
    """A floor of 8 m: blotches of several sizes."""
    rng = np.random.default_rng(seed)
    size = int(8 * SCALE)
    floor = np.zeros((size, size, 3), np.float32)
    for sigma, weight in ((3, 1.0), (8, 1.0), (20, 0.7)):
        noise = rng.standard_normal((size, size, 3)).astype(np.float32)
        blurred = cv2.GaussianBlur(noise, (0, 0), sigma)
        floor += weight * blurred / blurred.std()
    return (128 + 35 * floor).clip(0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def floors() -> tuple[np.ndarray, np.ndarray]:
    return texture(0), texture(1)


def view(floor: np.ndarray, x: float, y: float, yaw_deg: float, mount: Mount = MOUNT) -> View:
    """Picture of the floor, whose middle is the origin of the map."""
    pose = planar_pose(x, y, np.radians(yaw_deg), mount)
    map_from_texture = np.array([[1 / SCALE, 0, -4.0], [0, -1 / SCALE, 4.0], [0, 0, 1.0]])
    pixel_from_texture = pixel_from_plane(CAMERA, pose) @ map_from_texture
    pixels = cv2.warpPerspective(floor, pixel_from_texture, (CAMERA.width, CAMERA.height))
    return View(f"A/{x},{y}", pixels, CAMERA, mount)


def motion(x: float, y: float, yaw_deg: float) -> np.ndarray:
    c, s = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
    return np.array([[c, -s, x], [s, c, y], [0, 0, 1.0]])


@pytest.mark.parametrize("yaw_deg", [0, 40, 115, 180])
def test_agreement_finds_the_motion_whatever_the_turn(floors, yaw_deg):
    """The second robot stands so that it sees the spot 1 m ahead of the first one."""
    c, s = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
    x, y = 1.0 - 0.9 * c, -0.9 * s
    found = agreement(
        ground_signature(view(floors[0], 0, 0, 0)),
        ground_signature(view(floors[0], x, y, yaw_deg)),
    )
    assert found.votes >= MIN_VOTES
    expected = np.linalg.inv(motion(x, y, yaw_deg))
    np.testing.assert_allclose(found.j_from_i, expected, atol=0.04)


def test_robots_of_different_height_tilt_and_exposure(floors):
    a = view(floors[0], 0, 0, 0)
    b = view(floors[0], 0.3, 0.2, 30, Mount(np.radians(38), 0.0, 0.75))
    b = View(b.image_id, (b.pixels * 0.8).astype(np.uint8), b.camera, b.mount)
    found = agreement(ground_signature(a), ground_signature(b))
    assert found.votes >= MIN_VOTES
    np.testing.assert_allclose(found.j_from_i, np.linalg.inv(motion(0.3, 0.2, 30)), atol=0.06)


def test_different_floors_do_not_agree(floors):
    found = agreement(*(ground_signature(view(f, 0, 0, 0)) for f in floors))
    assert found.votes < MIN_VOTES


def test_views_without_texture_or_ground():
    grey = np.full((240, 320, 3), 99, np.uint8)
    bare = ground_signature(View("A/0", grey, CAMERA, MOUNT))
    sky = ground_signature(View("A/1", grey, CAMERA, Mount(np.radians(-60), 0.0, 0.6)))
    assert len(bare.points) == len(sky.points) == 0
    assert agreement(bare, sky).votes == 0
    assert expected_overlap(bare, sky) == 0.0


def test_common_ground_is_the_share_in_view(floors):
    a = ground_signature(view(floors[0], 0, 0, 0))
    assert common_ground(a, a, np.eye(3)) == pytest.approx(1.0, abs=0.03)
    assert common_ground(a, a, motion(9, 0, 0)) == 0.0
    assert common_ground(a, a, motion(0, 0, 180)) < 0.1  # back to back
    assert 0.3 < common_ground(a, a, motion(0.3, 0, 0)) < 0.95


def test_the_pair_with_most_common_ground_comes_first(floors):
    floor = floors[0]
    of_a = [ground_signature(view(floor, x, 0, 0)) for x in (-2.0, -0.4, 0.2)]
    of_b = [ground_signature(view(floor, 0.25, 0.05, 10)), ground_signature(view(floor, -3, 2, 90))]
    i, j = np.indices((3, 2)).reshape(2, -1)
    expected = np.array([expected_overlap(of_a[m], of_b[n]) for m, n in zip(i, j, strict=True)])
    alike = np.full(6, 0.1)  # histograms of one floor tell nothing
    first, second = candidate_pairs(i, j, alike, 0.2, expected)[:2]
    assert (first.i, first.j) == (2, 0)
    assert first.expected == expected.max()
    assert second.expected < first.expected
    by_spots = {(c.i, c.j) for c in candidate_pairs(i, j, alike, 0.05, expected)}
    assert (2, 0) in by_spots <= {(2, 0), (1, 0)}
