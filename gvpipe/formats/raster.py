"""Pictures with a place in the map: PNG written strip by strip, and its world file."""

import struct
import zlib
from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

SIGNATURE = b"\x89PNG\r\n\x1a\n"
COMPRESSION = 3
"""zlib level: photographs hardly shrink any further at higher ones, which cost five times more."""
COLOUR_TYPES = {1: 0, 3: 2, 4: 6}
FILTER_UP = 2


def _chunk(kind: bytes, data: bytes) -> bytes:
    """One length-prefixed PNG chunk with its checksum."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png_chunks(
    width: int, height: int, channels: int, strips: Iterable[NDArray[np.uint8]]
) -> Iterator[bytes]:
    """Encode an 8-bit picture that is never in memory as a whole.

    Parameters
    ----------
    width, height : int
        Size, pixels.
    channels : {1, 3, 4}
        Grey, RGB or RGBA.
    strips : iterable of (h, width, channels) uint8
        The rows from top to bottom in pieces of any height.

    Yields
    ------
    chunk : bytes
        To be written one after the other.

    Raises
    ------
    ValueError
        If a strip does not fit or the rows do not add up to the height.
    """
    header = struct.pack(">IIBBBBB", width, height, 8, COLOUR_TYPES[channels], 0, 0, 0)
    yield SIGNATURE + _chunk(b"IHDR", header)
    packer = zlib.compressobj(COMPRESSION)
    above = np.zeros((1, width * channels), np.uint8)
    rows = 0
    for strip in strips:
        if strip.ndim != 3 or strip.shape[1:] != (width, channels):
            raise ValueError(
                f"a strip of {strip.shape} in a picture of {(height, width, channels)}"
            )
        flat = strip.reshape(len(strip), -1)
        rows += len(flat)
        coded = np.empty((len(flat), 1 + width * channels), np.uint8)
        coded[:, 0] = FILTER_UP
        # modulo 256, as the format has it
        np.subtract(flat, np.concatenate([above, flat[:-1]]), out=coded[:, 1:])
        above = flat[-1:].copy() if len(flat) else above
        if data := packer.compress(coded.tobytes()):
            yield _chunk(b"IDAT", data)
    if rows != height:
        raise ValueError(f"{rows} rows were given of {height}")
    yield _chunk(b"IDAT", packer.flush())
    yield _chunk(b"IEND", b"")


def png_bytes(pixels: NDArray[np.uint8]) -> bytes:
    """Encode an (H, W, C) uint8 picture, C = 1, 3 or 4, as PNG."""
    height, width, channels = pixels.shape
    return b"".join(png_chunks(width, height, channels, [pixels]))


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


def read_world_file(text: str) -> NDArray[np.float64]:
    """Read a world file back to its (3, 3) map from pixels.

    Raises
    ------
    ValueError
        If the text is not six finite numbers.
    """
    a, d, b, e, c, f = (float(v) for v in text.split())
    matrix = np.array([[a, b, c], [d, e, f], [0.0, 0.0, 1.0]])
    if not np.isfinite(matrix).all():
        raise ValueError("a world file of numbers that are not finite")
    return matrix
