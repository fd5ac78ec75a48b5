"""Pictures for the report: small, in one string each, the same bytes for the same pixels."""

import base64
import gzip
import io
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pillow

from gvpipe.core.types import Float, Image
from gvpipe.formats.jpeg import jpeg_bytes
from gvpipe.formats.raster import read_png

THUMB_WIDTH = 200
"""Width of the picture of a photograph, pixels."""

MAP_SIDE = 1600
"""Longer side of the picture of a map, pixels, at most."""

GROUND_SIDE = 130
"""Longer side of the ground under the obstacles, vertices, at most."""


def data_uri(kind: str, content: bytes) -> str:
    """Put bytes into an address that needs no network."""
    return f"data:image/{kind};base64,{base64.b64encode(content).decode('ascii')}"


def thumbnail(pixels: Image) -> tuple[str, int]:
    """Make a photograph small.

    Parameters
    ----------
    pixels : (H, W, 3) uint8
        RGB.

    Returns
    -------
    uri : str
        The picture, :data:`THUMB_WIDTH` pixels wide.
    height : int
        Its height, pixels.
    """
    height = max(1, round(THUMB_WIDTH * pixels.shape[0] / pixels.shape[1]))
    small = cv2.resize(pixels, (THUMB_WIDTH, height), interpolation=cv2.INTER_AREA)
    return data_uri("jpeg", jpeg_bytes(np.asarray(small, np.uint8), 74)), height


def picture(path: Path, side: int = MAP_SIDE) -> str:
    """Read a picture that a stage wrote, and make it small; what is transparent stays so."""
    kept = _opened(path)
    kept.thumbnail((side, side), Pillow.Resampling.BOX)
    stream = io.BytesIO()
    kept.save(stream, format="WEBP", quality=82, method=4)
    return data_uri("webp", stream.getvalue())


def _opened(path: Path) -> Pillow.Image:
    """Read a picture of any size; Pillow by itself refuses large maps."""
    pixels = read_png(path)
    return Pillow.fromarray(pixels if pixels.shape[2] > 1 else pixels[..., 0])


def ground_grid(path: Path, map_from_pixel: Float) -> tuple[Float, Image, NDArray[np.int64]]:
    """Turn a map into a coloured net of triangles.

    Parameters
    ----------
    path : Path
        The overhead map, RGBA.
    map_from_pixel : (3, 3) float64
        Takes its pixel centres to metres.

    Returns
    -------
    vertices : (N, 2) float64
        Metres in the map.
    colours : (N, 3) uint8
        RGB of the vertices.
    faces : (F, 3) int64
        Vertex numbers; where nothing was seen there is no face.
    """
    rgba = _opened(path).convert("RGBA")
    full = np.array(rgba.size)
    rgba.thumbnail((GROUND_SIDE, GROUND_SIDE), Pillow.Resampling.BOX)
    pixels = np.asarray(rgba)
    height, width = pixels.shape[:2]
    rows, columns = np.mgrid[:height, :width]
    scale = full / (width, height)
    u = (columns.ravel() + 0.5) * scale[0] - 0.5
    v = (rows.ravel() + 0.5) * scale[1] - 0.5
    vertices = np.column_stack([u, v, np.ones_like(u)]) @ map_from_pixel[:2].T
    number = np.arange(height * width).reshape(height, width)
    a, b = number[:-1, :-1].ravel(), number[:-1, 1:].ravel()
    c, d = number[1:, :-1].ravel(), number[1:, 1:].ravel()
    faces = np.vstack([np.column_stack([a, c, b]), np.column_stack([b, c, d])])
    seen = pixels[..., 3].ravel() > 127
    faces = faces[seen[faces].all(axis=1)]
    used, renumbered = np.unique(faces, return_inverse=True)
    colours: Image = pixels.reshape(-1, 4)[used, :3]
    return vertices[used], colours, renumbered.reshape(-1, 3).astype(np.int64)


def packed_library() -> str:
    """Give plotly's JavaScript, compressed, as base64."""
    from plotly.offline import get_plotlyjs

    return base64.b64encode(gzip.compress(get_plotlyjs().encode(), 9, mtime=0)).decode("ascii")
