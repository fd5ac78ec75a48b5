"""Free, occupied and unknown ground: an evidence grid of what the views agree on."""

import cv2
import numpy as np
from numpy.typing import NDArray

FREE, OCCUPIED, UNKNOWN = 0, 100, -1
"""Cell states, with the values of ROS occupancy grids."""

OCCUPIED_LOG_ODDS = 1.0
"""Evidence from which a cell counts as occupied, probability 0.73: more than one direction of
view contradicts the others."""

MIN_OBSTACLE = 0.03
"""Width of the smallest obstacle, metres: narrower evidence is the edge of a texture."""


def occupancy(
    seen: NDArray[np.bool_], log_odds: NDArray[np.float32], resolution: float
) -> NDArray[np.int8]:
    """State of every cell.

    Parameters
    ----------
    seen : (H, W) bool
        Where any view saw ground.
    log_odds : (H, W) float32
        Evidence of an obstacle, positive = occupied, 0 = none.
    resolution : float
        Metres per cell.

    Returns
    -------
    cells : (H, W) int8
        ``OCCUPIED`` where the evidence says so over a patch of at least 3 cm, ``FREE`` where
        ground was seen and nothing speaks against it, ``UNKNOWN`` elsewhere.
    """
    side = max(1, round(MIN_OBSTACLE / resolution))
    patch = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    strong = (seen & (log_odds >= OCCUPIED_LOG_ODDS)).astype(np.uint8)
    occupied = cv2.morphologyEx(strong, cv2.MORPH_OPEN, patch).astype(np.bool_)
    free = seen & (log_odds <= 0)
    return np.where(occupied, OCCUPIED, np.where(free, FREE, UNKNOWN)).astype(np.int8)


def draw_footprints(
    cells: NDArray[np.int8],
    footprints: list[NDArray[np.float64]],
    map_from_pixel: NDArray[np.float64],
) -> NDArray[np.int8]:
    """Mark the ground under known obstacles as occupied.

    Parameters
    ----------
    cells : (H, W) int8
        Cell states.
    footprints : list of (N, 2) float64
        Outlines in the map, metres.
    map_from_pixel : (3, 3) float64
        Map from cells (u right, v down).

    Returns
    -------
    cells : (H, W) int8
        A copy; every cell an outline touches is ``OCCUPIED``.
    """
    drawn = np.zeros(cells.shape, np.uint8)
    pixel_from_map = np.linalg.inv(map_from_pixel)
    for outline in footprints:
        pixels = outline @ pixel_from_map[:2, :2].T + pixel_from_map[:2, 2]
        cv2.fillPoly(drawn, [np.rint(pixels).astype(np.int32)], 1)
    return np.where(drawn > 0, OCCUPIED, cells).astype(np.int8)
