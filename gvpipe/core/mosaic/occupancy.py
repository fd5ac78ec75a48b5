"""Free, occupied and unknown ground: an evidence grid of what the views agree on."""

import cv2
import numpy as np
from numpy.typing import NDArray

FREE, OCCUPIED, UNKNOWN = 0, 100, -1
"""Cell states, with the values of ROS occupancy grids."""

OCCUPIED_LOG_ODDS = 1.0
"""Evidence from which a cell counts as occupied, probability 0.73: more than one direction of
view contradicts the others."""

FREE_LOG_ODDS = -0.85
"""Evidence from which a cell counts as free, probability 0.3: two directions of view agree on it,
or one shows a colour that is common on ground that several agree on. What one direction alone
shows may be the side of an obstacle, drawn out over ground that nobody has seen."""

MIN_OBSTACLE = 0.03
"""Width of the smallest obstacle, metres: narrower evidence is the edge of a texture."""


def margin(resolution: float) -> int:
    """Cells around a part of a map that decide on it: the width of the smallest obstacle."""
    return max(1, round(MIN_OBSTACLE / resolution))


def occupancy(
    seen: NDArray[np.bool_],
    log_odds: NDArray[np.float32],
    resolution: float,
    rows_around: int = 0,
) -> NDArray[np.int8]:
    """State of every cell.

    Parameters
    ----------
    seen : (H, W) bool
        Where any view saw ground.
    log_odds : (H + 2 rows_around, W) float32
        Evidence of an obstacle, positive = occupied, 0 = none.
    resolution : float
        Metres per cell.
    rows_around : int
        Rows of evidence above and below the map's; :func:`margin` of them make the parts of a
        map those of the whole.

    Returns
    -------
    cells : (H, W) int8
        ``OCCUPIED`` where the evidence says so over a patch of at least 3 cm, ``FREE`` where
        the evidence says that bare ground was seen, ``UNKNOWN`` elsewhere.
    """
    side = margin(resolution)
    patch = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    strong = (log_odds >= OCCUPIED_LOG_ODDS).astype(np.uint8)
    rows = slice(rows_around, rows_around + len(seen))
    opened = cv2.morphologyEx(strong, cv2.MORPH_OPEN, patch)[rows]
    occupied = seen & opened.astype(np.bool_)
    free = seen & (log_odds[rows] <= FREE_LOG_ODDS)
    cells = np.full(seen.shape, UNKNOWN, np.int8)
    cells[free] = FREE
    cells[occupied] = OCCUPIED
    return cells


def probability_steps(log_odds: NDArray[np.float32], seen: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Probability of an obstacle in steps of 1/254, (H, W) uint8; 255 = unseen."""
    steps = np.negative(log_odds)
    np.exp(steps, out=steps)
    steps += 1
    np.divide(254, steps, out=steps)
    values = np.rint(steps, out=steps).astype(np.uint8)
    values[~seen] = 255
    return values


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
