"""Where a view shows ground and where an obstacle hides it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.mosaic.raster import MosaicRaster, PlacedView


@dataclass(frozen=True)
class CleanMap:
    """Where a view shows ground, in cells.

    Attributes
    ----------
    column, row : int
        Cell of its first value.
    weights : (h, w) uint8
        255 = surely ground, 0 = surely an obstacle, or not seen.
    """

    column: int
    row: int
    weights: NDArray[np.uint8]

    @classmethod
    def blank(cls, placed: PlacedView | None, cells: MosaicRaster) -> "CleanMap":
        """Nothing seen yet, in the box of a view laid on the cells."""
        if placed is None:
            return cls(0, 0, np.zeros((1, 1), np.uint8))
        left, top = (max(int(np.floor(b)), 0) for b in placed.box[:2])
        right = min(int(np.ceil(placed.box[2])), cells.width - 1)
        bottom = min(int(np.ceil(placed.box[3])), cells.height - 1)
        size = (max(bottom - top + 1, 1), max(right - left + 1, 1))
        return cls(left, top, np.zeros(size, np.uint8))

    def paste(self, corner: tuple[int, int], weights: NDArray[np.uint8]) -> None:
        """Copy what lies in the box of a tile's weights; `corner` is its first (row, column)."""
        row, column = corner[0] - self.row, corner[1] - self.column
        h, w = self.weights.shape
        top, left = max(row, 0), max(column, 0)
        bottom, right = min(row + weights.shape[0], h), min(column + weights.shape[1], w)
        if top < bottom and left < right:
            part = weights[top - row : bottom - row, left - column : right - column]
            self.weights[top:bottom, left:right] = part
