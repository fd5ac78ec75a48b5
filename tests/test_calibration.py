"""Calibration files of three makers, and what is wrong with bad ones."""

import cv2
import numpy as np
import pytest

from gvpipe.configfile import load_config
from gvpipe.errors import ConfigError
from gvpipe.formats.calibration import Calibration, read_calibration

ROS = """image_width: 640
image_height: 480
camera_name: head
camera_matrix:
  rows: 3
  cols: 3
  data: [520.1, 0.5, 319.5, 0, 521.2, 239.5, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.1, 0.02, 0.001, -0.002, 0.0]
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
"""
KALIBR = """cam0:
  camera_model: pinhole
  distortion_coeffs: [-0.1, 0.02, 0.001, -0.002]
  distortion_model: radtan
  intrinsics: [520.1, 521.2, 319.5, 239.5]
  resolution: [640, 480]
  rostopic: /cam0
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, 0.1]
  camera_model: pinhole
  distortion_coeffs: []
  distortion_model: none
  intrinsics: [400.0, 401.0, 200.0, 150.0]
  resolution: [400, 300]
"""
MESSAGE = """height: 480
width: 640
distortion_model: rational_polynomial
D: [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8]
K: [520.1, 0.0, 319.5, 0.0, 521.2, 239.5, 0.0, 0.0, 1.0]
"""


@pytest.fixture
def write(tmp_path):
    def _write(text):
        path = tmp_path / "camera.yaml"
        path.write_text(text)
        return path

    return _write


def test_ros_file(write):
    assert read_calibration(write(ROS)) == Calibration(
        640, 480, 520.1, 521.2, 319.5, 239.5, 0.5, (-0.1, 0.02, 0.001, -0.002, 0.0)
    )


def test_ros_message(write):
    found = read_calibration(write(MESSAGE))
    assert found.distortion == (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)
    assert (found.width, found.fy) == (640, 521.2)


def test_kalibr_chain_takes_the_camera_of_that_name(write):
    path = write(KALIBR)
    assert read_calibration(path, "cam0").distortion == (-0.1, 0.02, 0.001, -0.002)
    assert read_calibration(path, "cam1") == Calibration(400, 300, 400, 401, 200, 150)
    with pytest.raises(ConfigError, match="holds cam0, cam1; name the camera 'front' like one"):
        read_calibration(path, "front")
    only = write(KALIBR[: KALIBR.index("cam1")])
    assert read_calibration(only, "front").width == 640


@pytest.mark.parametrize("count", [4, 5, 8, 12, 14])
def test_opencv_file_storage_as_opencv_writes_it(count, tmp_path):
    path = tmp_path / "camera.yml"
    coefficients = np.zeros(count)
    coefficients[:4] = [-0.1, 0.02, 0.001, -0.002]
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("calibration_time", "Sun Nov 22 2026")
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", np.array([[520.0, 0, 319.5], [0, 521.25, 239], [0, 0, 1]]))
    storage.write("distortion_coefficients", coefficients)
    storage.release()
    found = read_calibration(path)
    assert (found.fx, found.fy, found.cx, found.cy) == (520, 521.25, 319.5, 239)
    np.testing.assert_array_equal(found.distortion, coefficients[:8])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            ROS.replace("plumb_bob", "equidistant"),
            "camera.yaml:8:19: distortion_model: is 'equidistant'; expected one of "
            "none, plumb_bob, radtan, rational_polynomial",
        ),
        (
            KALIBR[: KALIBR.index("cam1")].replace("radtan", "equidistant"),
            "camera.yaml:4:21: cam0.distortion_model: is 'equidistant'; expected one of none",
        ),
        (KALIBR.replace("pinhole", "omni"), "cam0.camera_model: is 'omni'; expected pinhole"),
        (KALIBR.replace("[640, 480]", "[640]"), "cam0.resolution: is not a size; expected"),
        (KALIBR.replace("[520.1, ", "["), "cam0.intrinsics: has 3 numbers; expected [fx, fy"),
        (ROS.replace("image_width", "imagewidth"), "image_width: is missing; expected pixels"),
        (ROS.replace("640", "-1"), "camera.yaml:1:14: image_width: is -1; expected a number of"),
        (ROS.replace("camera_matrix", "matrix"), "camera_matrix: is missing; expected 3x3"),
        (ROS.replace("520.1", ".nan"), "7:9: camera_matrix.data: is not a list of finite numbers"),
        (ROS.replace("520.1, ", ""), "camera_matrix: has 8 numbers; expected 9"),
        (ROS.replace("0, 521.2", "1, 521.2"), "camera_matrix: is no calibration matrix"),
        (ROS.replace("0.001, -0.002, 0.0]", "1]"), "has 3 numbers; expected 0, 4, 5 or 8"),
        (
            ROS.replace("plumb_bob", "none"),
            "distortion_model: is none, but there are coefficients",
        ),
        (ROS + "fisheye_model: 1\n", "fisheye_model: is set; expected one of none, plumb_bob"),
        (ROS + "image_width: 3\n", "image_width: is given twice, first in line 1"),
        (ROS + "x: !!python/name:os.system\n", "x: tag tag:yaml.org,2002:python/name:os.system"),
        ("", "is empty; expected a ROS, OpenCV or Kalibr calibration"),
        ("[1, 2", "is not valid YAML"),
    ],
)
def test_errors_name_file_and_key(text, expected, write):
    with pytest.raises(ConfigError) as caught:
        read_calibration(write(text), "cam0")
    assert "camera.yaml" in str(caught.value)
    assert expected in str(caught.value)


def test_a_configuration_takes_its_camera_from_a_file(write, tmp_path):
    write(ROS)
    run = tmp_path / "run.yaml"
    text = "cameras: {c: camera.yaml}\nrobots: {A: {images: a, height: 1, tilt: 30}}\n"
    run.write_text(text)
    assert load_config(run).cameras["c"].distortion == (-0.1, 0.02, 0.001, -0.002, 0.0)
    write(ROS.replace("plumb_bob", "fov"))
    with pytest.raises(ConfigError, match=r"run.yaml:1:14: cameras.c: .*camera.yaml:8:19: "):
        load_config(run)
    write(ROS.replace("520.1", "-1"))  # read, but out of range: named by its key
    with pytest.raises(ConfigError, match=r"run.yaml:1:11: cameras.c.fx: is -1.0; expected"):
        load_config(run)
