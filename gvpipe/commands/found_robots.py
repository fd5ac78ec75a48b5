"""Which pictures are whose: folders and videos become robots, turned pictures upright copies."""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gvpipe.commands.output import write_file
from gvpipe.commands.photos import Photo, list_photos, of_one_size, read_photo
from gvpipe.core.types import Image, Rejected
from gvpipe.errors import InputError, OutputError
from gvpipe.formats.jpeg import jpeg_bytes
from gvpipe.formats.video import is_video_file
from gvpipe.names import escape
from gvpipe.report import log

MOST_FRAMES = 24
"""Frames of a video that are looked at."""


@dataclass(frozen=True)
class Found:
    """Pictures that become one robot."""

    name: str
    images: Path
    photos: tuple[Photo, ...]


def find_robots(places: Sequence[Path]) -> list[Found]:
    """Find pictures, and which of them one robot took.

    Parameters
    ----------
    places : sequence of Path
        Folders of pictures, or of such folders, videos and globs.

    Returns
    -------
    robots : list of Found
        Under different names.

    Raises
    ------
    InputError
        If a place holds no pictures.
    """
    return _distinct([robot for place in places for robot in _robots(place.absolute())])


def _robots(path: Path) -> list[Found]:
    """Robots in one place: its pictures, or those of each of its folders."""
    if not path.is_dir():
        photos = list_photos(path, MOST_FRAMES)
        return [Found(_name(path), path, tuple(of_one_size(photos, escape(str(path)))))]
    photos = [p for p in list_photos(path, MOST_FRAMES) if p.frame is None]
    if photos:
        return [Found(_name(path), path, tuple(of_one_size(photos, escape(str(path)))))]
    robots: list[Found] = []
    for child in sorted(path.iterdir()):
        if child.name.startswith(".") or child.name in ("masks", "upright"):
            continue
        if child.is_dir() and not child.is_symlink():  # links may lead round in circles
            robots += _robots_or_none(child)
        elif is_video_file(child):
            robots += _robots(child)
    if not robots:
        raise InputError(f"{escape(str(path))}: holds no picture, nor do its folders")
    return robots


def _robots_or_none(path: Path) -> list[Found]:
    """Robots in one place, none if it holds no picture."""
    try:
        return _robots(path)
    except InputError:
        return []


def _name(path: Path) -> str:
    """Make a robot's name of a path."""
    stem = path.parent.name if path.name in ("images", "image", "photos") else path.stem
    name = re.sub(r"[^A-Za-z0-9_-]+", "_", stem).strip("_-")
    return name[:40] or "robot"


def _distinct(robots: Sequence[Found]) -> list[Found]:
    """Tell robots that share a name apart by numbers."""
    seen: dict[str, int] = {}
    distinct = []
    for robot in robots:
        seen[robot.name] = seen.get(robot.name, 0) + 1
        number = seen[robot.name]
        distinct.append(replace(robot, name=f"{robot.name}_{number}") if number > 1 else robot)
    return distinct


def upright(robot: Found, folder: Path) -> Found:
    """Write copies the right way up where cameras were turned, as EXIF says.

    Parameters
    ----------
    robot : Found
        As found.
    folder : Path
        The copies go below it, into ``upright/`` and the robot's name.

    Returns
    -------
    robot : Found
        The same if no picture is turned.

    Raises
    ------
    InputError
        If no picture can be read.
    OutputError
        If a copy cannot be written.
    """
    if all(photo.orientation == 1 for photo in robot.photos):
        return robot
    target = folder / "upright" / robot.name
    log.info("%s: turned by EXIF; upright copies go to %s", robot.name, escape(str(target)))
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{escape(str(target))}: cannot be written: {error.strerror}") from error
    photos = []
    stems = Counter(Path(photo.name).stem for photo in robot.photos)
    for photo in robot.photos:
        pixels = read_photo(photo)
        if isinstance(pixels, Rejected):
            log.warning("%s: %s", photo.name, pixels.reason)
            continue
        turned = _turn(pixels, photo.orientation)
        stem = Path(photo.name).stem
        path = target / f"{stem if stems[stem] == 1 else photo.name}.jpg"
        write_file(path, jpeg_bytes(turned, 97))
        height, width = turned.shape[:2]
        photos.append(
            replace(photo, name=path.name, path=path, width=width, height=height, orientation=1)
        )
    kept = of_one_size(photos, escape(str(robot.images)))
    return Found(robot.name, target, tuple(kept))


def _turn(pixels: Image, orientation: int) -> Image:
    """Undo an EXIF orientation."""
    if orientation in (5, 6, 7, 8):
        pixels = pixels.transpose(1, 0, 2)
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    return np.ascontiguousarray(pixels)
