"""Occupancy maps of the ROS map_server: a PGM picture and a YAML file beside it."""

import re

import numpy as np
import yaml
from numpy.typing import NDArray

from gvpipe.core.mosaic.occupancy import FREE, OCCUPIED, UNKNOWN

PGM_VALUES = {FREE: 254, OCCUPIED: 0, UNKNOWN: 205}
"""What map_server itself saves; 205 lies between the two thresholds, so it reads as unknown."""

OCCUPIED_THRESHOLD, FREE_THRESHOLD = 0.65, 0.196
"""map_server's own defaults: occupied above the first, free below the second."""


def pgm_bytes(cells: NDArray[np.int8]) -> bytes:
    """Picture of an occupancy grid.

    Parameters
    ----------
    cells : (H, W) int8
        ``FREE``, ``OCCUPIED`` or ``UNKNOWN``; first row at the top, the highest map y.

    Returns
    -------
    pgm : bytes
        Binary PGM (P5), 8 bits.
    """
    height, width = cells.shape
    return pgm_header(width, height) + pgm_rows(cells)


def pgm_header(width: int, height: int) -> bytes:
    """Begin a PGM picture of a size; all its rows follow from top to bottom."""
    return b"P5\n%d %d\n255\n" % (width, height)


def pgm_rows(cells: NDArray[np.int8]) -> bytes:
    """Encode some rows of an occupancy grid."""
    values = np.empty(cells.shape, np.uint8)
    for cell, value in PGM_VALUES.items():
        values[cells == cell] = value
    return values.tobytes()


def read_pgm(data: bytes) -> NDArray[np.int8]:
    """Read a picture of :func:`pgm_bytes` back to its cells.

    Raises
    ------
    ValueError
        If it is not such a picture.
    """
    found = re.match(rb"P5\n(\d{1,6}) (\d{1,6})\n255\n", data)
    if found is None or len(data) - found.end() != int(found[1]) * int(found[2]):
        raise ValueError("not a binary 8-bit PGM picture")
    values = np.frombuffer(data, np.uint8, offset=found.end())
    cells = np.full(values.shape, UNKNOWN, np.int8)
    for cell, value in PGM_VALUES.items():
        cells[values == value] = cell
    return cells.reshape(int(found[2]), int(found[1]))


def yaml_text(image: str, resolution: float, x_min: float, y_min: float) -> str:
    """Describe an occupancy grid for map_server.

    Parameters
    ----------
    image : str
        File name of the picture, relative to the YAML file.
    resolution : float
        Metres per cell.
    x_min, y_min : float
        Map coordinates of the centre of the lower left cell, metres.

    Returns
    -------
    text : str
        map_server counts a cell from its lower left corner (cell i covers origin + i to i + 1
        resolutions), so the origin is half a cell below the centre.
    """
    half = resolution / 2
    return yaml.safe_dump(
        {
            "image": image,
            "mode": "trinary",
            "resolution": float(resolution),
            "origin": [float(x_min - half), float(y_min - half), 0.0],
            "negate": 0,
            "occupied_thresh": OCCUPIED_THRESHOLD,
            "free_thresh": FREE_THRESHOLD,
        },
        sort_keys=False,
        default_flow_style=None,
    )
