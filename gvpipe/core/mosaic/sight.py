"""Views in coarse cells of the ground: what each shows of a cell, and all of them of a tile."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.kernels.survey import cell_colours
from gvpipe.core.mosaic.raster import (
    Border,
    MosaicRaster,
    Picture,
    PlacedView,
    place,
    whole_from_part,
)

RADIUS_STEPS = 50.0
"""Steps of a stored radius in one; radii are squared distances from the image centre, in half
image widths, of which vignetting makes some percent."""

UNSEEN = 255
"""Stored radius of a cell that is not seen."""

Single = NDArray[np.float32]


@dataclass(frozen=True)
class Sight:
    """All cells of one view, in a tenth of the memory of its picture.

    Attributes
    ----------
    column, row : int
        Cell of the first value.
    colours : (h, w, 3) uint8
        Mean RGB.
    slopes : (h, w) int8
        How brightness changes within the cell, grey levels.
    radii : (h, w) uint8
        Steps of the radius, or ``UNSEEN``.
    border : Border
        Of the picture.
    """

    column: int
    row: int
    colours: NDArray[np.uint8]
    slopes: NDArray[np.int8]
    radii: NDArray[np.uint8]
    border: Border


@dataclass(frozen=True)
class Look:
    """A tile of cells in all views that may see it.

    Attributes
    ----------
    column, row : int
        Its first cell.
    views : (n,) int
        The views.
    colours : (h, w, n, 3) float32
        Mean RGB.
    slopes : (h, w, n) float32
        How brightness changes within the cell, grey levels.
    radii : (h, w, n) float32
        Squared distances from the image centre, in half image widths; -1 = not seen.
    """

    column: int
    row: int
    views: NDArray[np.intp]
    colours: Single
    slopes: Single
    radii: Single


def take_sight(view: Picture, cells: MosaicRaster, depth: float) -> tuple[PlacedView | None, Sight]:
    """Sample all cells of a view down to a depth in metres; reads its picture.

    Parameters
    ----------
    view : Picture
    cells : MosaicRaster
        Coarse.
    depth : float
        Ground deeper than this is not used, metres.

    Returns
    -------
    placed : PlacedView or None
        The view on the cells; None if it shows none of them.
    sight : Sight
    """
    border = view.border()
    p = place(view, cells, depth, border)
    if p is None:
        nothing = np.zeros((0, 0), np.uint8)
        return p, Sight(0, 0, np.zeros((0, 0, 3), np.uint8), nothing.view(np.int8), nothing, border)
    column, row = int(np.floor(p.box[0])), int(np.floor(p.box[1]))
    shape = (int(np.ceil(p.box[3])) - row + 1, int(np.ceil(p.box[2])) - column + 1)
    colours, slopes = np.zeros((*shape, 3), np.float32), np.zeros(shape, np.float32)
    radii = np.empty(shape, np.float32)
    cell_colours(
        view.read(),
        *border,
        p.pixel_from_raster @ whole_from_part(column, row),
        p.max_depth,
        np.array([view.camera.cx, view.camera.cy]),
        view.camera.width / 2,
        colours,
        slopes,
        radii,
    )
    steps = np.minimum(np.rint(RADIUS_STEPS * radii), UNSEEN - 1)
    return p, Sight(
        column,
        row,
        np.rint(colours).astype(np.uint8),
        np.rint(slopes.clip(-127, 127)).astype(np.int8),
        np.where(radii < 0, UNSEEN, steps).astype(np.uint8),
        border,
    )


def look_at(
    sights: Sequence[Sight], views: NDArray[np.intp], window: tuple[int, int, int, int]
) -> Look:
    """Gather a window of cells from some of the views.

    Parameters
    ----------
    sights : sequence of Sight
        Of all views.
    views : (n,) int
        Those that may see the window.
    window : (column, row, width, height)
        Cells.

    Returns
    -------
    look : Look
    """
    column, row, width, height = window
    colours = np.zeros((height, width, len(views), 3), np.float32)
    slopes = np.zeros((height, width, len(views)), np.float32)
    radii = np.full((height, width, len(views)), -1.0, np.float32)
    for n, k in enumerate(views):
        sight = sights[k]
        h, w = sight.radii.shape
        top, left = max(row, sight.row), max(column, sight.column)
        bottom, right = min(row + height, sight.row + h), min(column + width, sight.column + w)
        if top < bottom and left < right:
            here = np.s_[top - row : bottom - row, left - column : right - column, n]
            there = np.s_[
                top - sight.row : bottom - sight.row, left - sight.column : right - sight.column
            ]
            colours[here], slopes[here] = sight.colours[there], sight.slopes[there]
            steps = sight.radii[there]
            radii[here] = np.where(steps < UNSEEN, steps / np.float32(RADIUS_STEPS), -1.0)
    return Look(column, row, views, colours, slopes, radii)
