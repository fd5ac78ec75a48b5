"""Small pictures with captions, on one sheet."""

from collections.abc import Sequence
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Layer = NDArray[np.float32]
Colour: TypeAlias = tuple[int, int, int]
Caption: TypeAlias = str | Sequence[tuple[str, Colour]]

BLACK: Colour = (0, 0, 0)

CAPTION_HEIGHT, GAP = 30, 8
"""Pixels below a picture for its caption, and between pictures."""

TEXT_SCALE, TEXT_MARGIN = 0.5, 8
"""Size of captions for OpenCV, some 11 pixels high, and pixels to their left."""

DIVERGING = np.array([[103, 169, 207], [247, 247, 247], [239, 138, 98]])
"""Blue over white to red (ColorBrewer's RdBu): told apart by everybody, and pale enough
for lines."""

SEQUENTIAL = np.array([[0, 0, 0], [255, 255, 255]])
"""Dark for small values, bright for large ones."""

BRUSH = np.ones((3, 3), np.uint8)
"""What outlines are drawn with: a pixel on either side."""

BAR_HEIGHT = 10
"""Pixels of the bar that shows the colours from the smallest to the largest value."""

LINES: tuple[Colour, ...] = ((148, 60, 189), (214, 39, 40), (20, 120, 40), BLACK)
"""Colours of outlines, first to last: violet, red, green, black."""


def line_colours(count: int) -> tuple[Colour, ...]:
    """Colours of outlines drawn over each other; the last is black."""
    return LINES[-count:]


def sheet(pictures: Sequence[tuple[Image, Caption]], columns: int) -> Image:
    """Put pictures of one size, each over its caption, on a white sheet.

    Parameters
    ----------
    pictures : sequence of ((H, W, 3) uint8, str or sequence of (str, colour))
        At least one; RGB and caption (ASCII), in black or in pieces of any colour.
    columns : int
        Pictures in a row; the last row may have fewer.

    Returns
    -------
    page : (H, W, 3) uint8
        RGB.
    """
    cells = [_captioned(picture, text) for picture, text in pictures]
    height, width, _ = cells[0].shape
    rows = -(-len(cells) // columns)
    page = np.full((rows * (height + GAP) + GAP, columns * (width + GAP) + GAP, 3), 255, np.uint8)
    for k, cell in enumerate(cells):
        top, left = GAP + k // columns * (height + GAP), GAP + k % columns * (width + GAP)
        page[top : top + height, left : left + width] = cell
    return page


def _captioned(picture: Image, caption: Caption) -> Image:
    """Put a picture on a white strip with its caption."""
    strip = np.full((CAPTION_HEIGHT, picture.shape[1], 3), 255, np.uint8)
    x, font = TEXT_MARGIN, cv2.FONT_HERSHEY_SIMPLEX
    for text, colour in [(caption, BLACK)] if isinstance(caption, str) else caption:
        place = (x, CAPTION_HEIGHT - 10)
        cv2.putText(strip, text, place, font, TEXT_SCALE, colour, 1, cv2.LINE_AA)
        x += cv2.getTextSize(text, font, TEXT_SCALE, 1)[0][0]
    return np.vstack([picture, strip])


def layer_picture(
    values: Layer, outlines: Sequence[Layer], side: int, *, signed: bool
) -> tuple[Image, tuple[float, float]]:
    """Draw a horizontal layer of the map from above, x to the right and y up.

    Parameters
    ----------
    values : (nx, ny) float32
        What is shown in colours, with a bar of them from smallest to largest below.
    outlines : sequence of (n, m) float32
        Level-set functions over the same ground at any resolution; their zero levels are drawn,
        the last one black.
    side : int
        Width and height of the square that the layer is fitted into, pixels.
    signed : bool
        Blue below zero, white at zero, red above; else dark is small and bright is large.

    Returns
    -------
    picture : (side + bar, side, 3) uint8
        RGB, white round the layer.
    limits : (float, float)
        Values at the two ends of the bar.
    """
    if signed:
        largest = max(float(np.abs(values).max()), 1e-12)
        low, high = -largest, largest
    else:
        low, high = float(values.min()), float(values.max())
    ramp = DIVERGING if signed else SEQUENTIAL
    scale = side / max(values.shape)
    width, height = (max(1, round(n * scale)) for n in values.shape)
    shares = (_from_above(values) - low) / max(high - low, 1e-12)
    enlarged = cv2.resize(shares, (width, height), interpolation=cv2.INTER_NEAREST)
    colours = _coloured(enlarged.astype(np.float32), ramp)
    for outline, colour in zip(outlines, line_colours(len(outlines)), strict=True):
        u = cv2.resize(_from_above(outline), (width, height), interpolation=cv2.INTER_LINEAR)
        inside = (u > 0).astype(np.uint8)
        rim = cv2.dilate(inside, BRUSH) != cv2.erode(inside, BRUSH)
        colours[rim] = colour
    picture = np.full((side + BAR_HEIGHT + GAP, side, 3), 255, np.uint8)
    top, left = (side - height) // 2, (side - width) // 2
    picture[top : top + height, left : left + width] = colours
    bar = _coloured(np.linspace(0.0, 1.0, side, dtype=np.float32)[None], ramp)
    picture[-BAR_HEIGHT:] = bar
    return picture, (low, high)


def _from_above(layer: Layer) -> Layer:
    """Turn [x, y] into rows from the top."""
    return np.ascontiguousarray(layer.T[::-1], dtype=np.float32)


def _coloured(shares: Layer, ramp: NDArray[np.int_]) -> Image:
    """Colours, (H, W, 3), of shares 0..1 on a ramp."""
    places = np.linspace(0.0, 1.0, len(ramp))
    channels = [np.interp(shares, places, ramp[:, c]) for c in range(3)]
    return np.rint(np.stack(channels, axis=-1)).astype(np.uint8)
