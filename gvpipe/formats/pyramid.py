"""Large pictures with a place in the map: tiled BigTIFF with overviews, GeoTIFF tags."""

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import tifffile
from numpy.typing import NDArray

TILE = 512
"""Side of a tile, pixels: what viewers fetch at once."""

SMALLEST = 1024
"""Overviews are made until one is no larger than this."""

PIXEL_SCALE, TIEPOINT, GEO_KEYS = 33550, 33922, 34735
"""GeoTIFF 1.1 tags."""

LOCAL_AREA = (1, 1, 0, 2, 1024, 0, 1, 32767, 1025, 0, 1, 1)
"""Geo keys: version 1.1.0, two keys; the coordinate system is a local one, pixels are areas."""


def write_pyramid(
    path: Path,
    width: int,
    height: int,
    strips: Iterable[NDArray[np.uint8]],
    map_from_pixel: NDArray[np.float64],
) -> None:
    """Write a picture that is never in memory as a whole, and overviews of half the size each.

    Parameters
    ----------
    path : Path
        The file.
    width, height : int
        Size, pixels.
    strips : iterable of (h, width, 4) uint8
        RGBA rows from top to bottom in pieces of 512; the last may be lower.
    map_from_pixel : (3, 3) float64
        From pixels (u right, v down, centres at integers) to map metres; no rotation.
    """
    m = map_from_pixel / map_from_pixel[2, 2]
    corner = m[:2, :2] @ np.array([-0.5, -0.5]) + m[:2, 2]
    tags = (
        (PIXEL_SCALE, "d", 3, (float(m[0, 0]), float(-m[1, 1]), 0.0), True),
        (TIEPOINT, "d", 6, (0.0, 0.0, 0.0, float(corner[0]), float(corner[1]), 0.0), True),
        (GEO_KEYS, "H", len(LOCAL_AREA), LOCAL_AREA, True),
    )
    _write_level(path, width, height, _tiles(strips, width), tags)
    level = 0
    while max(width, height) > SMALLEST:
        width, height = -(-width // 2), -(-height // 2)
        with tifffile.TiffFile(path) as whole:
            finer = whole.pages[level]
            assert isinstance(finer, tifffile.TiffPage)
            _write_level(path, width, height, _halved(finer, width, height), ())
        level += 1


def _write_level(
    path: Path,
    width: int,
    height: int,
    tiles: Iterator[NDArray[np.uint8]],
    tags: tuple[tuple[int, str, int, tuple[float, ...], bool], ...],
) -> None:
    """Write the full picture (with tags) or append an overview (without)."""
    with tifffile.TiffWriter(path, bigtiff=True, append=not tags) as writer:
        writer.write(
            tiles,
            shape=(height, width, 4),
            dtype=np.uint8,
            tile=(TILE, TILE),
            photometric="rgb",
            extrasamples=["unassalpha"],
            compression="zlib",
            compressionargs={"level": 3},
            subfiletype=0 if tags else 1,
            extratags=tags,
            software=False,
            metadata=None,
            maxworkers=1,
        )


def _tiles(strips: Iterable[NDArray[np.uint8]], width: int) -> Iterator[NDArray[np.uint8]]:
    """Cut strips into tiles, transparent beyond the picture."""
    for strip in strips:
        for column in range(0, width, TILE):
            tile = np.zeros((TILE, TILE, 4), np.uint8)
            part = strip[:, column : column + TILE]
            tile[: part.shape[0], : part.shape[1]] = part
            yield tile


def _halved(finer: tifffile.TiffPage, width: int, height: int) -> Iterator[NDArray[np.uint8]]:
    """Tiles of half the resolution, each of four that are read back."""
    across = -(-finer.imagewidth // TILE)
    down = -(-finer.imagelength // TILE)
    for row in range(-(-height // TILE)):
        for column in range(-(-width // TILE)):
            four = np.zeros((2 * TILE, 2 * TILE, 4), np.uint8)
            for v in range(2 * row, min(2 * row + 2, down)):
                for u in range(2 * column, min(2 * column + 2, across)):
                    tile = _read_tile(finer, v * across + u)
                    top, left = (v % 2) * TILE, (u % 2) * TILE
                    four[top : top + tile.shape[0], left : left + tile.shape[1]] = tile
            yield _half(four)


def _read_tile(page: tifffile.TiffPage, index: int) -> NDArray[np.uint8]:
    """Read one tile of a page."""
    handle = page.parent.filehandle
    handle.seek(page.dataoffsets[index])
    decoded = page.decode(handle.read(page.databytecounts[index]), index)[0]
    assert decoded is not None
    return np.asarray(decoded, dtype=np.uint8).reshape(-1, decoded.shape[-2], 4)


def _half(rgba: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Average two by two pixels, of those that are there."""
    total = np.zeros((len(rgba) // 2, rgba.shape[1] // 2, 3), np.uint16)
    count = np.zeros((*total.shape[:2], 1), np.uint16)
    for v in (0, 1):
        for u in (0, 1):
            part = rgba[v::2, u::2]
            there = part[..., 3:] >> 7
            total += part[..., :3] * there
            count += there
    out = np.zeros((*count.shape[:2], 4), np.uint8)
    out[..., :3] = (total + count // 2) // np.maximum(count, 1)
    out[..., 3:] = (count > 0) * np.uint8(255)
    return out
