"""Pictures with a place in the map: PNG written strip by strip, and its world file."""

import struct
import zlib
from io import BytesIO
from pathlib import Path
from typing import IO

import cv2
import numpy as np
from numpy.typing import NDArray

from gvpipe.errors import InputError

SIGNATURE = b"\x89PNG\r\n\x1a\n"
"""First bytes of every PNG."""

COMPRESSION = 3
"""zlib level: photographs hardly shrink any further at higher ones, which cost five times more."""

COLOUR_TYPES = {1: 0, 3: 2, 4: 6}
"""PNG's number for grey, RGB and RGBA, by the channels they have."""

FILTER_UP = 2
"""PNG's number for rows that are given as differences from the one above."""

ROWS_AT_ONCE = 64
"""Rows filtered and packed together: a few megabytes of a wide picture."""


def _chunk(kind: bytes, data: bytes) -> bytes:
    """One length-prefixed PNG chunk with its checksum."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


class PngWriter:
    """An 8-bit PNG picture that is never in memory as a whole.

    Parameters
    ----------
    stream : writable binary file
        Where the picture goes; it is not closed.
    width, height : int
        Size, pixels.
    channels : {1, 3, 4}
        Grey, RGB or RGBA.
    """

    def __init__(self, stream: IO[bytes], width: int, height: int, channels: int) -> None:
        self._stream, self._size = stream, (height, width, channels)
        self._packer = zlib.compressobj(COMPRESSION)
        self._above = np.zeros((1, width * channels), np.uint8)
        self._rows = 0
        header = struct.pack(">IIBBBBB", width, height, 8, COLOUR_TYPES[channels], 0, 0, 0)
        stream.write(SIGNATURE + _chunk(b"IHDR", header))

    def write(self, strip: NDArray[np.uint8]) -> None:
        """Append rows, (h, width, channels) uint8, or (h, width) if there is one channel.

        Raises
        ------
        ValueError
            If they do not fit.
        """
        _, width, channels = self._size
        if strip.shape[1:] not in ((width, channels), (width,) if channels == 1 else ()):
            raise ValueError(f"a strip of {strip.shape} in a picture of {self._size}")
        flat = strip.reshape(len(strip), -1)
        for start in range(0, len(flat), ROWS_AT_ONCE):
            self._pack(flat[start : start + ROWS_AT_ONCE])

    def _pack(self, flat: NDArray[np.uint8]) -> None:
        """Filter some rows and compress them."""
        self._rows += len(flat)
        coded = np.empty((len(flat), 1 + flat.shape[1]), np.uint8)
        coded[:, 0] = FILTER_UP
        # modulo 256, as the format has it
        np.subtract(flat[:1], self._above, out=coded[:1, 1:])
        np.subtract(flat[1:], flat[:-1], out=coded[1:, 1:])
        self._above = flat[-1:].copy()
        if data := self._packer.compress(coded.data):
            self._stream.write(_chunk(b"IDAT", data))

    def close(self) -> None:
        """Finish the picture.

        Raises
        ------
        ValueError
            If rows are missing, or there are too many.
        """
        if self._rows != self._size[0]:
            raise ValueError(f"{self._rows} rows were given of {self._size[0]}")
        self._stream.write(_chunk(b"IDAT", self._packer.flush()) + _chunk(b"IEND", b""))


def png_bytes(pixels: NDArray[np.uint8]) -> bytes:
    """Encode an (H, W, C) uint8 picture, C = 1, 3 or 4, as PNG."""
    height, width, channels = pixels.shape
    stream = BytesIO()
    writer = PngWriter(stream, width, height, channels)
    writer.write(pixels)
    writer.close()
    return stream.getvalue()


def read_png(path: Path) -> NDArray[np.uint8]:
    """Read a picture that a stage wrote; of any size, as maps may be.

    Returns
    -------
    pixels : (H, W, C) uint8
        C = 1, 3 or 4: grey, RGB or RGBA.

    Raises
    ------
    InputError
        If it cannot be read or is not a whole PNG of 8 bits.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    try:
        raw = np.frombuffer(data, np.uint8)
        found = cv2.imdecode(raw, cv2.IMREAD_UNCHANGED) if png_is_whole(data) else None
    except cv2.error:
        found = None
    if found is None or found.dtype != np.uint8:
        raise InputError(f"{path}: cannot be decoded as an 8-bit PNG picture")
    if found.ndim == 2:
        return np.asarray(found[..., None], np.uint8)
    order = cv2.COLOR_BGRA2RGBA if found.shape[2] == 4 else cv2.COLOR_BGR2RGB
    return np.asarray(cv2.cvtColor(found, order), np.uint8)


def png_is_whole(data: bytes) -> bool:
    """Whether a PNG's chunks follow each other, each with its checksum, up to the last."""
    at = len(SIGNATURE)
    while data.startswith(SIGNATURE) and at + 12 <= len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        end = at + 12 + length
        if end > len(data):
            return False
        checksum = int.from_bytes(data[end - 4 : end], "big")
        if zlib.crc32(memoryview(data)[at + 4 : end - 4]) != checksum:
            return False
        if data[at + 4 : at + 8] == b"IEND":
            return True
        at = end
    return False


def world_file(map_from_pixel: NDArray[np.float64]) -> str:
    """Lines of a world file (``.pgw``): where the pixels of a picture lie in the map.

    Parameters
    ----------
    map_from_pixel : (3, 3) float64
        Affine, from pixels (u right, v down, centres at integers) to map metres.

    Returns
    -------
    text : str
        x by u, y by u, x by v, y by v, x and y of the centre of the upper left pixel.

    Raises
    ------
    ValueError
        If the map is not affine.
    """
    m = map_from_pixel / map_from_pixel[2, 2]
    if np.abs(m[2, :2]).max() > 0:
        raise ValueError("a world file holds affine maps only")
    values = (m[0, 0], m[1, 0], m[0, 1], m[1, 1], m[0, 2], m[1, 2])
    return "".join(f"{float(v)!r}\n" for v in values)
