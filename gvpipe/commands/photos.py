"""The pictures a user points at: which there are, how large, and what their EXIF tells."""

import io
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from PIL import Image as Pillow

from gvpipe.core.types import Image, Rejected
from gvpipe.errors import InputError
from gvpipe.filelist import list_files
from gvpipe.formats.files import read_regular_file
from gvpipe.formats.images import MAX_FILE_BYTES, is_image_file, read_header, read_image
from gvpipe.formats.video import VideoReader, frame_name, is_video_file
from gvpipe.names import escape
from gvpipe.report import log

DIAGONAL_35_MM = 43.267
"""Diagonal of a 36 x 24 mm frame, which equivalent focal lengths refer to."""

_IFD, _FOCAL_MM, _FOCAL_35_MM, _WIDTH, _UNIT = 0x8769, 37386, 41989, 41486, 41488
_MM_OF_UNIT = {2: 25.4, 3: 10.0, 4: 1.0}
_MODEL = 272


@dataclass(frozen=True)
class Photo:
    """One picture.

    Attributes
    ----------
    name : str
        File name, or ``video#frame``; printable.
    path : Path
        The file.
    frame : int or None
        Frame of a video.
    width, height : int
        Pixels.
    focal_px : float or None
        By EXIF.
    focal_source : str
        Which tag it comes from, in words.
    orientation : int
        EXIF orientation; 1 if there is none.
    model : str
        Camera by EXIF, printable; empty if there is none.
    """

    name: str
    path: Path
    frame: int | None
    width: int
    height: int
    focal_px: float | None = None
    focal_source: str = ""
    orientation: int = 1
    model: str = ""


def list_photos(path: Path, most_frames: int) -> list[Photo]:
    """List the pictures that a folder, glob, file or video holds.

    Parameters
    ----------
    path : Path
        As under ``images:`` of a configuration.
    most_frames : int
        Frames taken of a video, evenly.

    Returns
    -------
    photos : list of Photo
        In natural order; files that are no pictures are passed over with a warning.

    Raises
    ------
    InputError
        If there is nothing of that name, or the one file named is no picture.
    """
    photos: list[Photo] = []
    for file in list_files(path):
        video = is_video_file(file)
        found = _frames(file, most_frames) if video else _look(file)
        if not isinstance(found, Rejected):
            photos += found
        elif file == path:
            raise InputError(f"{escape(str(file))}: {found.reason}")
        elif video or is_image_file(file):  # notes and the like may lie there, too
            log.warning("%s: %s: left out", escape(file.name), found.reason)
    return photos


def _look(file: Path) -> list[Photo] | Rejected:
    """Read size and EXIF without decoding pixels."""
    raw = read_regular_file(file, MAX_FILE_BYTES)
    if isinstance(raw, Rejected):
        return raw
    header = read_header(raw)
    if isinstance(header, Rejected):
        return header
    focal, source, model = _exif(raw, header.width, header.height)
    turn = header.orientation or 1
    size = (header.width, header.height)
    return [
        Photo(
            escape(file.name),
            file,
            None,
            *size,
            focal,
            source,
            turn if 1 <= turn <= 8 else 1,
            model,
        )
    ]


def _exif(raw: bytes, width: int, height: int) -> tuple[float | None, str, str]:
    """Focal length in pixels, where it comes from, and the camera's model."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Pillow.open(io.BytesIO(raw)) as picture:
                exif = picture.getexif()
                focal, source = _focal(exif, width, height)
                return focal, source, escape(str(exif.get(_MODEL, "")).strip("\0 "))[:80]
    except Exception:  # a parser of hostile bytes may raise anything
        return None, "", ""


def _focal(exif: Pillow.Exif, width: int, height: int) -> tuple[float | None, str]:
    """Focal length in pixels by whichever tags say it."""
    tags = exif.get_ifd(_IFD)
    try:
        equivalent = float(tags.get(_FOCAL_35_MM, 0))
        if 5 < equivalent < 1000:
            focal = equivalent / DIAGONAL_35_MM * float(np.hypot(width, height))
            return focal, f"{equivalent:g} mm equivalent"
        focal_mm, per_unit = float(tags.get(_FOCAL_MM, 0)), float(tags.get(_WIDTH, 0))
        unit_mm = _MM_OF_UNIT.get(int(tags.get(_UNIT, 2)), 25.4)
        focal = focal_mm * per_unit / unit_mm
        if 0.2 * width < focal < 20 * width:
            return focal, f"{focal_mm:g} mm, sensor resolution by EXIF"
    except (TypeError, ValueError, ZeroDivisionError):
        pass
    return None, ""


def _frames(file: Path, most: int) -> list[Photo] | Rejected:
    """Frames of a video, evenly spread."""
    with VideoReader(file) as reader:
        if reader.reason is not None:
            return Rejected(reader.reason)
        count = max(reader.announced, 1)
        chosen = sorted({int(k) for k in np.linspace(0, count - 1, min(most, count))})
        names = [frame_name(escape(file.name), k) for k in chosen]
        size = (reader.width, reader.height)
        return [Photo(name, file, k, *size) for name, k in zip(names, chosen, strict=True)]


def of_one_size(photos: Sequence[Photo], where: str) -> list[Photo]:
    """Keep the pictures of the most common size; warn of the others.

    Raises
    ------
    InputError
        If there is none.
    """
    if not photos:
        raise InputError(f"{where}: holds no picture")
    sizes = Counter((photo.width, photo.height) for photo in photos)
    (width, height), _ = sizes.most_common(1)[0]
    for photo in photos:
        if (photo.width, photo.height) != (width, height):
            log.warning(
                "%s: is %dx%d, the others are %dx%d: left out",
                *(photo.name, photo.width, photo.height, width, height),
            )
    return [photo for photo in photos if (photo.width, photo.height) == (width, height)]


def evenly(photos: Sequence[Photo], most: int) -> list[Photo]:
    """At most so many of the pictures, spread over all of them."""
    chosen = sorted({int(k) for k in np.linspace(0, len(photos) - 1, min(most, len(photos)))})
    return [photos[k] for k in chosen]


def read_photo(photo: Photo) -> Image | Rejected:
    """Decode a picture, not turned, (H, W, 3) uint8 RGB."""
    if photo.frame is not None:
        with VideoReader(photo.path) as reader:
            return reader.read(photo.frame)
    decoded = read_image(photo.path)
    return decoded if isinstance(decoded, Rejected) else decoded.pixels


def shrink(pixels: Image, most_pixels: int) -> tuple[Image, float]:
    """Make a picture smaller.

    Returns
    -------
    smaller : (h, w, 3) uint8
        At most about so many pixels.
    scale : float
        Pixels of the original in one of the smaller, along a side.
    """
    height, width = pixels.shape[:2]
    scale = max(float(np.sqrt(width * height / most_pixels)), 1.0)
    if scale == 1.0:
        return pixels, 1.0
    size = (max(round(width / scale), 16), max(round(height / scale), 16))
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.uint8), scale
