"""Rotations from and to quaternions and vectors, compared with SciPy's."""

import numpy as np
from scipy.spatial.transform import Rotation

from gvpipe.core.geometry.pose import quaternions, rotation_matrix, rotation_of, rotation_vector
from gvpipe.core.types import Pose

RNG = np.random.default_rng(1)
TURNS = Rotation.concatenate(
    [
        Rotation.random(200, rng=RNG),
        Rotation.from_rotvec(RNG.normal(0.0, 1e-7, (20, 3))),
        Rotation.from_rotvec(RNG.normal(0.0, 1.0, (20, 3)) * [1, 1, 0] + [0, 0, 3.1]),
        Rotation.from_euler("xyz", RNG.integers(-2, 3, (60, 3)) * np.pi / 2),
    ]
)
MATRICES = TURNS.as_matrix()


def test_quaternions() -> None:
    found = quaternions([Pose(rotation, np.zeros(3)) for rotation in MATRICES])
    np.testing.assert_allclose(found, Rotation.from_matrix(MATRICES).as_quat(True), atol=1e-14)
    for quaternion, rotation in zip(found, MATRICES, strict=True):
        np.testing.assert_allclose(rotation_of(3.0 * quaternion), rotation, atol=1e-14)


def test_half_turns_have_one_quaternion() -> None:
    half = [Pose(np.diag(signs), np.zeros(3)) for signs in ([1.0, -1, -1], [-1.0, 1, -1])]
    assert quaternions(half).tolist() == [[1, 0, 0, 0], [0, 1, 0, 0]]


def test_vectors() -> None:
    found = np.array([rotation_vector(rotation) for rotation in MATRICES])
    np.testing.assert_allclose(rotation_matrix(found), MATRICES, atol=1e-14)
    small = np.linalg.norm(TURNS.as_rotvec(), axis=1) < 3.1  # a half turn has two vectors
    np.testing.assert_allclose(found[small], TURNS.as_rotvec()[small], rtol=1e-9, atol=1e-15)
    assert rotation_vector(np.eye(3)).tolist() == [0, 0, 0]
    assert rotation_matrix(np.zeros(3)).tolist() == np.eye(3).tolist()
