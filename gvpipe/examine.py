"""One look at every input file: does it decode, and what are its size and its hash."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from gvpipe.core.types import Rejected
from gvpipe.formats.files import file_sha256
from gvpipe.formats.images import is_image_file, read_image
from gvpipe.formats.video import VideoReader, frame_name, is_video_file


@dataclass(frozen=True)
class FoundImage:
    """One image file or video frame, good or bad.

    Attributes
    ----------
    name : str
        File name, with the frame's number in a video; as the file system has it.
    path, frame : Path, int or None
        The file, and the number of the frame in a video.
    width, height : int
        Pixels; 0 if it is bad.
    sha256, size_bytes : str, int
        Of the file.
    orientation : int or None
        EXIF tag.
    problem : str
        Why it cannot be used; empty if it can.
    counts : bool
        Whether it is an image, good or bad, so that a list of known poses has a line for it.
    """

    name: str
    path: Path
    frame: int | None = None
    width: int = 0
    height: int = 0
    sha256: str = ""
    size_bytes: int = 0
    orientation: int | None = None
    problem: str = ""
    counts: bool = True


def examine(file: tuple[Path, bool]) -> list[FoundImage]:
    """Decode one file to the end.

    Parameters
    ----------
    file : (Path, bool)
        The file, and whether the user named it (or it was just met in a folder).

    Returns
    -------
    found : list of FoundImage
        One item; of a video that was named, one for each frame.
    """
    path, named = file
    if is_video_file(path):
        if named:
            return list(_examine_video(path))
        problem = "is a video in a folder of images; name it in `images:` to use its frames"
        return [FoundImage(path.name, path, problem=problem, counts=False)]
    image = read_image(path)
    if isinstance(image, Rejected):
        return [FoundImage(path.name, path, problem=image.reason, counts=is_image_file(path))]
    height, width = image.pixels.shape[:2]
    facts = (width, height, image.sha256, image.size_bytes, image.exif_orientation)
    return [FoundImage(path.name, path, None, *facts)]


def _examine_video(path: Path) -> Iterator[FoundImage]:
    with VideoReader(path) as reader:
        if reader.reason is not None:
            yield FoundImage(path.name, path, problem=reader.reason)
            return
        digest, size = file_sha256(path)
        count = 0
        for count, pixels in enumerate(reader, start=1):
            height, width = pixels.shape[:2]
            facts = (width, height, digest, size, reader.orientation)
            yield FoundImage(frame_name(path.name, count - 1), path, count - 1, *facts)
        if count < reader.announced:
            problem = f"ends after {count} of {reader.announced} announced frames"
            yield FoundImage(path.name, path, problem=problem, counts=False)
