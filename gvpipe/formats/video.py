"""Videos as numbered images: decoded from the start, one frame in memory at a time."""

import os
import stat
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from gvpipe.core.types import Image, Rejected
from gvpipe.formats.images import MAX_PIXELS

VIDEO_EXTENSIONS = frozenset(
    {".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".wmv", ".mts", ".3gp"}
)

_ORIENTATION_OF_TURN = {0: 1, 90: 6, 180: 3, 270: 8}  # degrees clockwise to the EXIF number


def is_video_file(path: Path) -> bool:
    """Whether a file counts as a video, by its ending."""
    return path.suffix.lower() in VIDEO_EXTENSIONS


def frame_name(file_name: str, index: int) -> str:
    """Name of one frame, ``walk.mp4#000012``; `index` counts from 0."""
    return f"{file_name}#{index:06d}"


class VideoReader:
    """Frames of one video by number; going back means decoding from the start again.

    Decoding from the start, never seeking, makes frame numbers exact and the same on every
    machine. Turning marks in the file are not applied.

    Parameters
    ----------
    path : Path
        Any name; names that are not UTF-8 need /proc.

    Attributes
    ----------
    reason : str or None
        Why the video cannot be read; None if it can.
    width, height : int
        Size of the frames, pixels; 0 if it cannot be read.
    announced : int
        Number of frames according to the container; 0 if it does not say.
    orientation : int or None
        EXIF number of the turning mark.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._descriptor = -1
        self._capture: cv2.VideoCapture | None = None
        self._next = 0
        self.width = self.height = self.announced = 0
        self.orientation: int | None = None
        self.reason = self._open()

    def __enter__(self) -> "VideoReader":
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def __iter__(self) -> Iterator[Image]:
        """All frames in order, RGB."""
        index = 0
        while isinstance(frame := self.read(index), np.ndarray):
            yield frame
            index += 1

    def read(self, index: int) -> Image | Rejected:
        """Decode frame `index`, counted from 0.

        Returns
        -------
        frame : (H, W, 3) uint8 RGB, or Rejected
            Rejected beyond the last frame that can be decoded.
        """
        if self.reason is None and index < self._next:
            self.close()
            self.reason = self._open()
        if self._capture is None:
            return Rejected(self.reason or "is closed")
        while self._next < index:
            if not self._capture.grab():
                return Rejected(f"ends before frame {index}")
            self._next += 1
        good, bgr = self._capture.read()
        if not good or bgr is None:
            return Rejected(f"ends before frame {index}")
        self._next += 1
        return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), dtype=np.uint8)

    def close(self) -> None:
        """Free the decoder."""
        if self._capture is not None:
            self._capture.release()
            self._capture = None
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    def _open(self) -> str | None:
        """Open at frame 0; the reason if that fails."""
        self._next = 0
        try:
            if not stat.S_ISREG(self._path.stat().st_mode):
                return "is not a regular file"
            self._descriptor = os.open(self._path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        except (OSError, ValueError) as error:
            return f"cannot be read: {error.strerror if isinstance(error, OSError) else error}"
        name = str(self._path.absolute())
        if not _is_utf8(name):  # such a name would crash OpenCV
            name = f"/proc/self/fd/{self._descriptor}"
        capture = cv2.VideoCapture(name, cv2.CAP_FFMPEG)
        if not capture.isOpened():
            self.close()
            return "is not a video that can be decoded"
        self._capture = capture
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        self.width = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH))
        self.height = int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        self.announced = max(int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), 0)
        turn = round(capture.get(cv2.CAP_PROP_ORIENTATION_META)) % 360
        self.orientation = _ORIENTATION_OF_TURN.get(turn)
        if self.width * self.height > MAX_PIXELS:
            self.close()
            return f"is {self.width}x{self.height}, larger than {MAX_PIXELS / 1e6:g} Mpx"
        return None


def _is_utf8(name: str) -> bool:
    """Whether a name can be handed on as UTF-8."""
    try:
        name.encode("utf-8")
    except UnicodeEncodeError:
        return False
    return True
