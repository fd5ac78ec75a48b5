"""Whether what a configuration names is there, without a look at the pictures themselves."""

from collections.abc import Iterator, Mapping
from pathlib import Path

from gvpipe.configcheck import Finding
from gvpipe.errors import InputError
from gvpipe.filelist import list_files
from gvpipe.formats.colmap import read_images
from gvpipe.formats.tum import read_tum
from gvpipe.knownposes import pose_file
from gvpipe.names import escape


def missing_inputs(data: Mapping[str, object], base: Path) -> Iterator[Finding]:
    """Find picture folders and pose files that are not there or cannot be read.

    Parameters
    ----------
    data : mapping
        The configuration as parsed; parts that are wrong in themselves are passed over.
    base : Path
        Folder that paths are relative to.

    Yields
    ------
    finding : Finding
        With the message of the stage that would meet it.
    """
    robots = data.get("robots")
    for name, robot in robots.items() if isinstance(robots, Mapping) else ():
        for key, look in (("images", _look_at_images), ("poses", _look_at_poses)):
            value = robot.get(key) if isinstance(robot, Mapping) else None
            if isinstance(value, str) and value and "\0" not in value:
                try:
                    look(base / value)
                except InputError as error:
                    yield Finding(("robots", name, key), str(error))


def _look_at_images(path: Path) -> None:
    if not list_files(path):
        raise InputError(f"{escape(str(path))}: no usable image")


def _look_at_poses(path: Path) -> None:
    file = pose_file(path)
    if file.name == "images.txt":
        read_images(file)
    else:
        read_tum(file)
