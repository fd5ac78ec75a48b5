"""Diagrams: curves as SVG, matrices as small pictures."""

from collections.abc import Mapping, Sequence
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from gvpipe.formats.svg import Drawing, Style

WIDTH, HEIGHT, LEFT, BOTTOM, TOP, RIGHT = 640.0, 360.0, 48.0, 40.0, 36.0, 112.0
"""Size of a diagram and its margins, pixels."""

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
"""Okabe and Ito: told apart by everybody."""

MAP_SIDE = 512
"""Size that the longer side of a matrix is enlarged to, about, pixels."""

EDGE, GAP = 40, 8
"""Pixels around a matrix for its numbers, of three digits at least, and between the two."""

FONT, TEXT_SCALE, TEXT_HEIGHT = cv2.FONT_HERSHEY_SIMPLEX, 0.5, 11
"""Of OpenCV, and how high its digits are then, pixels."""

RAMP = np.array([[13, 8, 60], [123, 30, 120], [213, 80, 72], [250, 165, 40], [252, 250, 190]])
"""Colours of a matrix from its smallest to its largest value: darker is smaller, also in grey."""


def curves_svg(
    title: str, x_label: str, ticks: Sequence[str], curves: Mapping[str, NDArray[np.floating]]
) -> str:
    """Draw curves over the same places, each scaled to its own largest value.

    Parameters
    ----------
    title, x_label : str
        Texts.
    ticks : sequence of n str
        What the places are called; shown on hovering.
    curves : mapping of str to (n,) float
        By name; at least one place.

    Returns
    -------
    svg : str
    """
    drawing = Drawing(WIDTH, HEIGHT, title)
    drawing.add("rect", {"x": 0, "y": 0, "width": WIDTH, "height": HEIGHT, "fill": "white"})
    n = len(ticks)
    across = (WIDTH - LEFT - RIGHT) / max(n - 1, 1)
    floor, high = HEIGHT - BOTTOM, HEIGHT - BOTTOM - TOP
    axis: Style = {"stroke": "#444444", "stroke-width": 1}
    drawing.line((LEFT, floor), (WIDTH - RIGHT, floor), axis)
    drawing.line((LEFT, floor), (LEFT, TOP), axis)
    drawing.text((LEFT, 20), title, {"font-size": 13})
    drawing.text((LEFT, HEIGHT - 10), x_label, {"font-size": 11})
    for share in (0.0, 0.5, 1.0):
        drawing.text((8, floor - share * high + 4), f"{share:.0%}", {"font-size": 10})
    for place in sorted({0, (n - 1) // 2, n - 1}):
        style: Style = {"font-size": 10, "text-anchor": "middle"}
        drawing.text((LEFT + place * across, floor + 14), str(place), style)
    for k, (name, values) in enumerate(curves.items()):
        colour = COLOURS[k % len(COLOURS)]
        shares = np.asarray(values, dtype=np.float64) / max(float(values.max()), 1e-12)
        points = [(LEFT + x * across, floor - y * high) for x, y in enumerate(shares)]
        # curves may coincide: the one below shows through the gaps
        dashes = "6 5" if k >= 2 else "none"
        path: Style = {"stroke": colour, "stroke-width": 1.5, "stroke-dasharray": dashes}
        for start, end in pairwise(points):
            drawing.line(start, end, path)
        low = int(np.argmin(values))
        dot: Style = {"cx": points[low][0], "cy": points[low][1], "r": 4, "fill": colour}
        drawing.add("circle", dot, tooltip=f"{name}: {ticks[low]}, {float(values[low]):.3g}")
        row = TOP + 16 * k + 8
        drawing.line((WIDTH - RIGHT + 8, row), (WIDTH - RIGHT + 26, row), path)
        drawing.text((WIDTH - RIGHT + 32, row + 4), name, {"font-size": 11})
    return drawing.to_svg()


def heat_map(matrix: NDArray[np.floating], down: str = "", across: str = "") -> NDArray[np.uint8]:
    """Colour a matrix, rows from top to bottom, with the numbers of some at its edges.

    Parameters
    ----------
    matrix : (n, m) float
        Not empty.
    down, across : str
        What its rows and its columns are (ASCII); written below if given.

    Returns
    -------
    page : (H, W, 3) uint8
        RGB on white: every value a square of the same size, the first :data:`EDGE` pixels from
        the left and from the top.
    """
    low, high = float(matrix.min()), float(matrix.max())
    places = np.linspace(0.0, 1.0, len(RAMP))
    shares = (matrix - low) / max(high - low, 1e-12)
    pixels = np.stack([np.interp(shares, places, RAMP[:, c]) for c in range(3)], axis=-1)
    side = max(1, MAP_SIDE // max(matrix.shape))
    squares = np.rint(pixels).astype(np.uint8).repeat(side, axis=0).repeat(side, axis=1)
    caption = f"down: {down}, across: {across}" if down or across else ""
    height, width, _ = squares.shape
    size = (height + 2 * EDGE, max(width + EDGE, EDGE + _text_width(caption)) + EDGE, 3)
    page = np.full(size, 255, np.uint8)
    page[EDGE : EDGE + height, EDGE : EDGE + width] = squares
    rows, columns = (_numbered(count, side) for count in matrix.shape)
    for k in rows:
        middle = EDGE + (2 * k + 1) * side // 2
        _write(page, str(k), EDGE - GAP - _text_width(str(k)), middle + TEXT_HEIGHT // 2)
    for k in columns:
        middle = EDGE + (2 * k + 1) * side // 2
        _write(page, str(k), middle - _text_width(str(k)) // 2, EDGE - GAP)
    _write(page, caption, EDGE, height + 2 * EDGE - GAP - TEXT_HEIGHT // 2)
    return page


def _numbered(count: int, side: int) -> list[int]:
    """First, middle and last of some rows or columns, as far as their numbers have room."""
    chosen: list[int] = []
    for k in sorted({0, (count - 1) // 2, count - 1}):
        if not chosen or (k - chosen[-1]) * side >= EDGE:
            chosen.append(k)
    return chosen


def _text_width(text: str) -> int:
    """Pixels that a text takes."""
    return int(cv2.getTextSize(text, FONT, TEXT_SCALE, 1)[0][0])


def _write(page: NDArray[np.uint8], text: str, left: int, foot: int) -> None:
    """Write a text in black, its lower left corner given."""
    cv2.putText(page, text, (left, foot), FONT, TEXT_SCALE, (0, 0, 0), 1, cv2.LINE_AA)
