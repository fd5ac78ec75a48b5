"""Undistorted pixels on demand, the most recent ones kept within a fixed amount of memory."""

import threading
from collections import OrderedDict
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.geometry.undistortion import Undistortion, undistort, undistortion
from gvpipe.core.types import Camera, Image, Rejected
from gvpipe.errors import InputError
from gvpipe.formats.images import read_image
from gvpipe.formats.video import VideoReader
from gvpipe.names import escape

CACHE_BYTES = 96 << 20
"""Decoded pixels kept: a hundred images of 640x480, or two of 12 Mpx."""

_ROBOTS = 4
"""Videos kept open, and distortions kept tabulated: one for each robot of a small team."""


@dataclass(frozen=True)
class PixelSource:
    """Where the pixels of one image come from.

    Attributes
    ----------
    path : Path
        An image, or a video.
    frame : int or None
        Number of the frame in the video, from 0.
    sha256 : str
        Of the image file when it was opened; not compared for videos.
    camera : Camera
        Intrinsics.
    distortion : tuple of float
        OpenCV order; empty if there is none.
    """

    path: Path
    frame: int | None
    sha256: str
    camera: Camera
    distortion: tuple[float, ...]


class PixelStore:
    """Reads images and remembers the last ones; sent to another process, it arrives empty."""

    def __init__(self, cache_bytes: int = CACHE_BYTES) -> None:
        self._state = _State(cache_bytes)

    def __reduce__(self) -> tuple[type["PixelStore"], tuple[int]]:
        return PixelStore, (self._state.cache_bytes,)

    def read(self, source: PixelSource) -> Image:
        """Undistorted RGB pixels, (H, W, 3) uint8, shared with other callers: do not change them.

        Raises
        ------
        InputError
            If the file is gone or is not the one that was opened.
        """
        state = self._state
        key = (source.path, source.frame, source.camera, source.distortion)
        with state.lock:
            if key in state.images:
                state.images.move_to_end(key)
                return state.images[key]
        pixels = self._decode(source)
        if source.distortion:
            pixels = undistort(pixels, _table(source.camera, source.distortion))
        with state.lock:
            state.images[key] = pixels
            while sum(image.nbytes for image in state.images.values()) > state.cache_bytes:
                state.images.popitem(last=False)
        return pixels

    def _decode(self, source: PixelSource) -> Image:
        name = escape(str(source.path))
        if source.frame is None:
            decoded = read_image(source.path, known_sha256=source.sha256)
            if isinstance(decoded, Rejected):
                raise InputError(f"{name}: {decoded.reason}")
            if decoded.sha256 != source.sha256:
                raise InputError(f"{name}: changed while gvpipe was running")
            return decoded.pixels
        with self._state.video_lock:
            videos = self._state.videos
            reader = videos.pop(source.path, None) or VideoReader(source.path)
            videos[source.path] = reader
            while len(videos) > _ROBOTS:
                videos.popitem(last=False)[1].close()
            frame = reader.read(source.frame)
        if isinstance(frame, Rejected):
            raise InputError(f"{name}: {frame.reason}")
        return frame


def inside_photograph(source: PixelSource) -> NDArray[np.bool_] | None:
    """Where undistorted pixels come from the photograph, (H, W) bool; None if everywhere."""
    return _table(source.camera, source.distortion).inside if source.distortion else None


@dataclass
class _State:
    cache_bytes: int
    images: OrderedDict[object, Image] = field(default_factory=OrderedDict)
    videos: OrderedDict[Path, VideoReader] = field(default_factory=OrderedDict)
    lock: threading.Lock = field(default_factory=threading.Lock)
    video_lock: threading.Lock = field(default_factory=threading.Lock)


@lru_cache(maxsize=_ROBOTS)
def _table(camera: Camera, distortion: tuple[float, ...]) -> Undistortion:
    return undistortion(camera, distortion)
