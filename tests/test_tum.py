"""TUM trajectories: exact round trips, and every malformed line named."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gvpipe.core.types import Pose
from gvpipe.errors import InputError
from gvpipe.formats.tum import format_tum, read_tum


def random_poses(n):
    rng = np.random.default_rng(3)
    rotations = Rotation.random(n, rng=rng).as_matrix()
    return [(k * 0.1, Pose(r, rng.normal(size=3))) for k, r in enumerate(rotations)]


def test_round_trip(tmp_path):
    poses = random_poses(20)
    path = tmp_path / "a.tum"
    path.write_text(format_tum(poses))
    back = read_tum(path)
    assert [t for t, _ in back] == [t for t, _ in poses]
    for (_, a), (_, b) in zip(poses, back, strict=True):
        np.testing.assert_array_equal(a.translation, b.translation)
        np.testing.assert_allclose(a.rotation, b.rotation, atol=1e-14)
    assert format_tum(back) == format_tum(read_tum(path))


def test_a_quarter_turn_to_the_left_reads_as_one(tmp_path):
    path = tmp_path / "a.tum"
    path.write_text(f"# a comment\n\n  1.5 1 2 3 0 0 {np.sqrt(0.5)} {np.sqrt(0.5)}\r\n")
    [(timestamp, pose)] = read_tum(path)
    assert timestamp == 1.5
    np.testing.assert_allclose(pose.rotation @ [1, 0, 0], [0, 1, 0], atol=1e-12)
    np.testing.assert_array_equal(pose.translation, [1, 2, 3])


def test_quaternions_rounded_to_three_decimals_are_accepted_and_normalised(tmp_path):
    path = tmp_path / "a.tum"
    quaternion = np.round(Rotation.random(rng=np.random.default_rng(0)).as_quat(), 3)
    path.write_text("0 0 0 1 " + " ".join(map(str, quaternion)))
    [(_, pose)] = read_tum(path)
    np.testing.assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("1 2 3", "3 values; expected 8"),
        ("0 0 0 0 0 0 0 1 9", "9 values; expected 8"),
        ("0 a 0 0 0 0 0 1", "a value is not a number"),
        ("0 0 0 0 0 0 0 \u0661", "a value is not a number"),
        ("0 nan 0 0 0 0 0 1", "a value is not finite"),
        ("0 0 0 0 0 0 0 inf", "a value is not finite"),
        ("0 1e9 0 0 0 0 0 1", "a coordinate is beyond"),
        ("0 0 0 0 0 0 0 0", "the quaternion's norm is 0; expected 1"),
        ("0 0 0 0 1 0 0 1", "the quaternion's norm is 1.414; expected 1"),
        ("1,2,3,4,5,6,7,8", "1 values; expected 8"),
    ],
)
def test_malformed_lines_are_named(line, expected, tmp_path):
    path = tmp_path / "a.tum"
    path.write_text(f"0 0 0 0 0 0 0 1\n# next\n{line}\n", encoding="utf-8")
    with pytest.raises(InputError) as caught:
        read_tum(path)
    assert str(caught.value).startswith(f"{path}:3: {expected}")


def test_files_that_cannot_be_read(tmp_path):
    for path in (tmp_path, tmp_path / "none"):
        with pytest.raises(InputError, match="expected a TUM trajectory"):
            read_tum(path)


@given(raw=st.binary(max_size=200))
@settings(deadline=None, max_examples=100)
def test_arbitrary_bytes_are_poses_or_an_input_error(raw, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "fuzz.tum"
    path.write_bytes(b"0 0 0 0 0 0 0 1\n" + raw)
    try:
        poses = read_tum(path)
    except InputError:
        return
    assert len(poses) >= 1
