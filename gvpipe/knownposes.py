"""Known poses of a robot's images, from a trajectory or a COLMAP model."""

from pathlib import Path

from gvpipe.core.types import Pose
from gvpipe.errors import InputError
from gvpipe.formats.colmap import read_images
from gvpipe.formats.tum import read_tum
from gvpipe.names import escape, nearest


def pose_file(poses: Path) -> Path:
    """File that holds known poses: of a COLMAP model, the one with its images."""
    return poses / "images.txt" if poses.is_dir() else poses


def known_poses(poses: Path, images: Path, ids: list[str]) -> dict[str, Pose]:
    """Read the poses of all images of a robot, bad ones included.

    Parameters
    ----------
    poses : Path
        TUM file with one line an image, or a COLMAP text model (its folder or ``images.txt``).
    images : Path
        Where the images are, for messages.
    ids : list of str
        Their ids, in order.

    Returns
    -------
    poses : dict of str to Pose
        map_from_camera by image id.

    Raises
    ------
    InputError
        If the file cannot be read, does not fit the images or has a camera below the ground.
    """
    file = pose_file(poses)
    name = escape(str(file))
    if file.name == "images.txt":
        known = _by_name(file, ids)
    else:
        rows = read_tum(file)
        if len(rows) != len(ids):
            expected = f"{len(ids)}, one line for each image in {escape(str(images))}"
            raise InputError(f"{name}: {len(rows)} poses; expected {expected}")
        known = {image_id: pose for image_id, (_, pose) in zip(ids, rows, strict=True)}
    for image_id, pose in known.items():
        if pose.translation[2] <= 0:
            height = f"{pose.translation[2]:g} m above the ground z = 0"
            raise InputError(f"{name}: the camera of {image_id} is {height}")
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
