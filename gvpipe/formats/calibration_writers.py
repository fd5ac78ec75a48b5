"""Camera calibration files, written: the counterpart of :mod:`gvpipe.formats.calibration`.

All keep pixel centres at integers and OpenCV's order of distortion; only COLMAP counts pixels from
their corner, which :mod:`gvpipe.formats.colmap` sees to.
"""

from collections.abc import Callable

from gvpipe.formats.calibration import Calibration
from gvpipe.formats.colmap import format_cameras
from gvpipe.formats.strict_yaml import format_value


def format_opencv(calibration: Calibration, name: str) -> str:
    """Write an OpenCV FileStorage YAML."""
    del name  # this file holds one camera without a name
    c = calibration
    matrix = [c.fx, c.skew, c.cx, 0.0, c.fy, c.cy, 0.0, 0.0, 1.0]
    distortion = c.distortion or (0.0, 0.0, 0.0, 0.0)
    return (
        "%YAML:1.0\n---\n"
        f"image_width: {c.width}\nimage_height: {c.height}\n"
        f"camera_matrix: {_opencv_matrix(3, 3, matrix)}"
        f"distortion_coefficients: {_opencv_matrix(1, len(distortion), list(distortion))}"
    )


def _opencv_matrix(rows: int, columns: int, data: list[float]) -> str:
    """Write a matrix, row by row, as FileStorage does."""
    numbers = ", ".join(_number(v) for v in data)
    return (
        f"!!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: [ {numbers} ]\n"
    )


def _number(value: float) -> str:
    """Shortest text of a number that OpenCV reads as a real one."""
    return repr(float(value) + 0.0)


def format_ros(calibration: Calibration, name: str) -> str:
    """Write a ROS camera_info YAML, as ``camera_calibration`` saves it."""
    c = calibration
    distortion = [*c.distortion, 0.0] if len(c.distortion) == 4 else list(c.distortion)
    model = "rational_polynomial" if len(distortion) == 8 else "plumb_bob"
    matrices = {
        "camera_matrix": (3, 3, [c.fx, c.skew, c.cx, 0.0, c.fy, c.cy, 0.0, 0.0, 1.0]),
        "distortion_coefficients": (1, len(distortion) or 5, distortion or [0.0] * 5),
        "rectification_matrix": (3, 3, [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]),
        "projection_matrix": (
            *(3, 4),
            [c.fx, c.skew, c.cx, 0.0, 0.0, c.fy, c.cy, 0.0, 0.0, 0.0, 1.0, 0.0],
        ),
    }
    lines = [f"image_width: {c.width}", f"image_height: {c.height}"]
    lines += [f"camera_name: {format_value(name)}", f"distortion_model: {model}"]
    for key, (rows, columns, data) in matrices.items():
        lines += [f"{key}:", f"  rows: {rows}", f"  cols: {columns}"]
        lines.append(f"  data: [{', '.join(_number(v) for v in data)}]")
    return "\n".join(lines) + "\n"


def format_kalibr(calibration: Calibration, name: str) -> str:
    """Write a Kalibr camchain of one camera.

    Raises
    ------
    ValueError
        If the camera has skew or more than four distortion coefficients, for which Kalibr has no
        place.
    """
    c = calibration
    if c.skew or any(c.distortion[4:]):
        raise ValueError("Kalibr has no place for skew or for more than k1 k2 p1 p2")
    distortion = list(c.distortion[:4]) or [0.0] * 4
    return (
        f"{format_value(name)}:\n"
        "  camera_model: pinhole\n"
        f"  intrinsics: [{', '.join(_number(v) for v in (c.fx, c.fy, c.cx, c.cy))}]\n"
        "  distortion_model: radtan\n"
        f"  distortion_coeffs: [{', '.join(_number(v) for v in distortion)}]\n"
        f"  resolution: [{c.width}, {c.height}]\n"
    )


def format_colmap(calibration: Calibration, name: str) -> str:
    """Write a COLMAP ``cameras.txt``.

    Raises
    ------
    ValueError
        If the camera has skew.
    """
    del name  # COLMAP numbers its cameras
    return format_cameras({1: calibration})


def format_gvpipe(calibration: Calibration, name: str) -> str:
    """Write the lines that go under ``cameras:`` of a configuration."""
    c = calibration
    entry: dict[str, object] = {"width": c.width, "height": c.height}
    entry |= {key: float(f"{getattr(c, key):.9g}") for key in ("fx", "fy", "cx", "cy")}
    if c.skew:
        entry["skew"] = c.skew
    if any(c.distortion):
        entry["distortion"] = [float(f"{v:.9g}") for v in c.distortion]
    return f"{format_value(name)}: {format_value(entry)}\n"


WRITERS: dict[str, Callable[[Calibration, str], str]] = {
    "opencv": format_opencv,
    "ros": format_ros,
    "kalibr": format_kalibr,
    "colmap": format_colmap,
    "gvpipe": format_gvpipe,
}
"""By name: a calibration and the camera's name to the file's text."""
