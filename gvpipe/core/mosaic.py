"""Composition of the overhead mosaic, tile by tile."""

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.blend import Blend, Samples
from gvpipe.core.kernels.mosaic import sample_view
from gvpipe.core.raster import MosaicRaster, PlacedView, max_depth, place, plan_raster
from gvpipe.core.survey import Survey, survey
from gvpipe.core.types import PosedView

__all__ = ["Mosaic", "MosaicRaster", "MosaicTile", "compose", "compose_tiles", "plan_raster"]

TILE = 128
"""Side of a tile, pixels: all samples of its pixels stay in the cache for some ten views."""

ALL_CLEAN = np.full((1, 1), 255, np.uint8)
"""Clean map of views that were not surveyed."""


@dataclass(frozen=True)
class MosaicTile:
    """A composed rectangle of the mosaic.

    Attributes
    ----------
    column, row : int
        Mosaic pixel of the tile's upper left one.
    rgba : (h, w, 4) uint8
        Colours, alpha 0 where nothing was seen.
    views : (h, w) int16
        How many views saw the pixel.
    log_odds : (h, w) float32
        Evidence of an obstacle, negative = free ground; 0 where the blend does not weigh it.
    """

    column: int
    row: int
    rgba: NDArray[np.uint8]
    views: NDArray[np.int16]
    log_odds: NDArray[np.float32]


@dataclass(frozen=True)
class Mosaic:
    """A whole mosaic in memory.

    Attributes
    ----------
    raster : MosaicRaster
        Where its pixels lie in the map.
    rgba : (height, width, 4) uint8
        Colours, alpha 0 where nothing was seen.
    views : (height, width) int16
        How many views saw the pixel.
    log_odds : (height, width) float32
        Evidence of an obstacle, negative = free ground; 0 where the blend does not weigh it.
    """

    raster: MosaicRaster
    rgba: NDArray[np.uint8]
    views: NDArray[np.int16]
    log_odds: NDArray[np.float32]


@dataclass(frozen=True)
class _Composer:
    """What all tiles share."""

    placed: Sequence[PlacedView | None]
    blend: Blend
    survey: Survey | None

    def tile(self, column: int, row: int, width: int, height: int) -> MosaicTile:
        """Sample all views of a tile and blend them."""
        inside = [
            (k, p)
            for k, p in enumerate(self.placed)
            if p is not None and p.touches(column, row, width, height)
        ]
        rgba = np.zeros((height, width, 4), np.uint8)
        samples = Samples.empty(height, width, len(inside))
        if inside:
            for k, p in inside:
                self._sample(k, p, column, row, samples)
            self.blend.kernel(
                samples.colours, samples.density, samples.clean, samples.light, samples.count, rgba
            )
        return MosaicTile(
            column, row, rgba, samples.count, self._evidence(column, row, width, height)
        )

    def _sample(self, k: int, p: PlacedView, column: int, row: int, samples: Samples) -> None:
        """Add one view to the samples of a tile."""
        shift = np.array([[1.0, 0.0, column], [0.0, 1.0, row], [0.0, 0.0, 1.0]])
        camera = p.view.camera
        gain = falloff = 0.0
        clean, cells = ALL_CLEAN, np.array([0.0, 0.0, 0.0])
        if self.survey is not None:
            gain = float(self.survey.exposure.log_gain[k])
            falloff = float(self.survey.exposure.falloff[k])
            f, there = self.survey.factor, self.survey.clean[k]
            clean = there.weights
            # cell = step * pixel + first, cell centres in the middle of their pixels
            half = (f - 1) / 2
            cells = np.array(
                [1.0 / f, (column - half) / f - there.column, (row - half) / f - there.row]
            )
        lens = np.array([camera.cx, camera.cy, camera.width / 2, gain, falloff])
        sample_view(
            p.view.pixels,
            p.rows,
            p.columns,
            p.pixel_from_raster @ shift,
            p.max_depth,
            lens,
            clean,
            cells,
            samples.colours,
            samples.density,
            samples.clean,
            samples.light,
            samples.count,
        )

    def _evidence(self, column: int, row: int, width: int, height: int) -> NDArray[np.float32]:
        """Log odds of the pixels of a tile: those of their cells."""
        if self.survey is None:
            return np.zeros((height, width), np.float32)
        rows = np.arange(row, row + height) // self.survey.factor
        columns = np.arange(column, column + width) // self.survey.factor
        return self.survey.log_odds[rows[:, None], columns[None, :]]


def compose_tiles(
    views: Sequence[PosedView], raster: MosaicRaster, blend: Blend, jobs: int = 1
) -> Iterator[MosaicTile]:
    """Compose a mosaic tile by tile, left to right and top to bottom.

    Parameters
    ----------
    views : sequence of PosedView
        Pictures with their poses in the map.
    raster : MosaicRaster
        What to fill.
    blend : Blend
        One of :data:`gvpipe.core.blend.BLENDS`.
    jobs : int
        Threads; the result does not depend on it.

    Yields
    ------
    tile : MosaicTile
    """
    looked = survey(views, raster, jobs) if blend.surveys and views else None
    placed = [place(v, raster, max_depth(v, raster.resolution)) for v in views]
    composer = _Composer(placed, blend, looked)

    def tile(corner: tuple[int, int]) -> MosaicTile:
        row, column = corner
        width, height = min(TILE, raster.width - column), min(TILE, raster.height - row)
        return composer.tile(column, row, width, height)

    corners = [(r, c) for r in range(0, raster.height, TILE) for c in range(0, raster.width, TILE)]
    with ThreadPoolExecutor(max_workers=max(jobs, 1)) as threads:
        # a few tiles ahead of the reader, so that memory stays bounded
        ahead = 4 * max(jobs, 1)
        pending = [threads.submit(tile, c) for c in corners[:ahead]]
        for k in range(len(corners)):
            done = pending[k % ahead].result()
            if k + ahead < len(corners):
                pending[k % ahead] = threads.submit(tile, corners[k + ahead])
            yield done


def compose(
    views: Sequence[PosedView], raster: MosaicRaster, blend: Blend, jobs: int = 1
) -> Mosaic:
    """Compose a whole mosaic in memory; parameters as for :func:`compose_tiles`."""
    shape = (raster.height, raster.width)
    rgba, count = np.zeros((*shape, 4), np.uint8), np.zeros(shape, np.int16)
    log_odds = np.zeros(shape, np.float32)
    for tile in compose_tiles(views, raster, blend, jobs):
        h, w = tile.views.shape
        window = np.s_[tile.row : tile.row + h, tile.column : tile.column + w]
        rgba[window], count[window], log_odds[window] = tile.rgba, tile.views, tile.log_odds
    return Mosaic(raster, rgba, count, log_odds)
