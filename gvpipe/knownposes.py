"""Known poses of a robot's images, from a trajectory or a COLMAP model."""

from collections.abc import Mapping
from math import log
from pathlib import Path
from statistics import median

from gvpipe.core.types import Pose
from gvpipe.errors import InputError
from gvpipe.formats.colmap import read_images
from gvpipe.formats.tum import read_tum_lines
from gvpipe.names import escape, nearest

MOST_APART = 3.0
"""Times that the heights of known poses may be as large as the configured ones, or as small, at
the median: single pictures may be taken from a ladder, but all of them only in another unit."""


def pose_file(poses: Path) -> Path:
    """File that holds known poses: of a COLMAP model, the one with its images."""
    return poses / "images.txt" if poses.is_dir() else poses


def known_poses(
    poses: Path, images: Path, heights: Mapping[str, float], key: str = "height"
) -> dict[str, Pose]:
    """Read the poses of all images of a robot, bad ones included.

    Parameters
    ----------
    poses : Path
        TUM file with one line an image, or a COLMAP text model (its folder or ``images.txt``).
    images : Path
        Where the images are, for messages.
    heights : mapping of str to float
        Configured height of each by image id, in order, metres.
    key : str
        Where the height is configured, for messages.

    Returns
    -------
    poses : dict of str to Pose
        map_from_camera by image id.

    Raises
    ------
    InputError
        If the file cannot be read, does not fit the images, has a camera below the ground, or is
        in another unit than the heights.
    """
    file = pose_file(poses)
    name = escape(str(file))
    places = dict.fromkeys(heights, name)
    if file.name == "images.txt":
        known = _by_name(file, list(heights))
    else:
        rows = read_tum_lines(file)
        if len(rows) != len(heights):
            expected = f"{len(heights)}, one line for each image in {escape(str(images))}"
            raise InputError(f"{name}: {len(rows)} poses; expected {expected}")
        known = {image_id: pose for image_id, (_, (_, pose)) in zip(heights, rows, strict=True)}
        places = {image_id: f"{name}:{n}" for image_id, (n, _) in zip(heights, rows, strict=True)}
    for image_id, pose in known.items():
        if pose.translation[2] <= 0:
            height = f"{pose.translation[2]:g} m above the ground z = 0"
            raise InputError(f"{places[image_id]}: the camera of {image_id} is {height}")
    ratios = {image: pose.translation[2] / heights[image] for image, pose in known.items()}
    if not 1 / MOST_APART <= median(ratios.values()) <= MOST_APART:
        worst = max(ratios, key=lambda image: abs(log(ratios[image])))
        above = f"the camera of {worst} is {known[worst].translation[2]:g} m above the ground z = 0"
        told = f"{key} says {heights[worst]:g} m; expected metres in both"
        raise InputError(f"{places[worst]}: {above}, but {told}")
    return known


def _by_name(file: Path, ids: list[str]) -> dict[str, Pose]:
    """Look the poses of a COLMAP model up by image id, or else by file name alone."""
    rows = [(escape(row.name), row.map_from_camera) for row in read_images(file)]
    by_id = dict(rows)
    by_file = {name.rsplit("/", 1)[-1]: pose for name, pose in rows}
    known = {}
    for image_id in ids:
        short = image_id.split("/", 1)[1]
        pose = by_id.get(image_id, by_id.get(short, by_file.get(short)))
        if pose is None:
            raise InputError(f"{escape(str(file))}: no pose of {image_id}{nearest(short, by_file)}")
        known[image_id] = pose
    return known
