"""Composition of the overhead mosaic, band by band, with bounded memory."""

from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gvpipe.core.kernels.mosaic import sample_view
from gvpipe.core.mosaic.blend import Blend, Samples
from gvpipe.core.mosaic.raster import (
    MosaicRaster,
    Picture,
    PlacedIndex,
    max_depth,
    place,
    whole_from_part,
)
from gvpipe.core.mosaic.survey import Survey, survey
from gvpipe.core.types import PosedView

TILE = 128
"""Side of a tile, pixels: all samples of its pixels stay in the cache for some ten views."""

BAND = 4 * TILE
"""Height of a band, pixels. Its tiles are done column by column, so that a picture is needed for
a short while in each band, and in two or three bands only."""

MOST_VIEWS = 255
"""The count of views ends here."""

UNSEEN_ERROR = 255
"""Value of the error layer where nothing was seen."""

ALL_CLEAN = np.full((1, 1), 255, np.uint8)
"""Clean map of views that are not weighed."""


@dataclass(frozen=True)
class MosaicBand:
    """Some rows of the mosaic.

    Attributes
    ----------
    row : int
        Mosaic row of its first one.
    rgba : (h, W, 4) uint8
        Colours, alpha 0 where nothing was seen.
    views : (h, W) uint8
        How many views saw the pixel, at most 255.
    error : (h, W) uint8
        Standard error of the colour in eighths of a grey level, at most 254; 255 = unseen.
    """

    row: int
    rgba: NDArray[np.uint8]
    views: NDArray[np.uint8]
    error: NDArray[np.uint8]

    @classmethod
    def empty(cls, row: int, height: int, width: int) -> "MosaicBand":
        """Nothing seen yet."""
        return cls(
            row,
            np.zeros((height, width, 4), np.uint8),
            np.zeros((height, width), np.uint8),
            np.full((height, width), UNSEEN_ERROR, np.uint8),
        )


@dataclass(frozen=True)
class Mosaic:
    """A whole mosaic in memory: the fields of :class:`MosaicBand`, and its raster and evidence.

    Attributes
    ----------
    raster : MosaicRaster
        Where its pixels lie in the map.
    rgba : (height, width, 4) uint8
        Colours, alpha 0 where nothing was seen.
    views, error : (height, width) uint8
        Count of views; eighths of a grey level.
    log_odds : (height, width) float32
        Evidence of an obstacle, negative = free ground.
    """

    raster: MosaicRaster
    rgba: NDArray[np.uint8]
    views: NDArray[np.uint8]
    error: NDArray[np.uint8]
    log_odds: NDArray[np.float32]


class Composition:
    """A mosaic that is composed while it is read.

    Parameters
    ----------
    views : sequence of PosedView or Picture
        Pictures with their poses in the map.
    raster : MosaicRaster
        What to fill.
    blend : Blend
        One of :data:`gvpipe.core.mosaic.blend.BLENDS`.
    jobs : int
        Threads; the result does not depend on it.
    """

    def __init__(
        self,
        views: Sequence[PosedView | Picture],
        raster: MosaicRaster,
        blend: Blend,
        jobs: int = 1,
    ) -> None:
        self.raster, self._blend, self._jobs = raster, blend, max(jobs, 1)
        pictures = [Picture.of(v) for v in views]
        self.survey: Survey = survey(pictures, raster, jobs)
        self._placed = [
            place(picture, raster, max_depth(picture, raster.resolution), border)
            for picture, border in zip(pictures, self.survey.borders, strict=True)
        ]
        self._index = PlacedIndex(self._placed)

    @property
    def band_rows(self) -> list[tuple[int, int]]:
        """First and last but one row of each band."""
        height = self.raster.height
        return [(row, min(row + BAND, height)) for row in range(0, height, BAND)]

    def bands(self) -> Iterator[MosaicBand]:
        """Compose from top to bottom, one band ahead of the reader."""
        with ThreadPoolExecutor(max_workers=self._jobs) as threads:
            waiting: deque[tuple[MosaicBand, list[Future[None]]]] = deque()
            try:
                for first, last in self.band_rows:
                    band = MosaicBand.empty(first, last - first, self.raster.width)
                    corners = self._corners(last - first)
                    tasks = [threads.submit(self._fill, band, *corner) for corner in corners]
                    waiting.append((band, tasks))
                    if len(waiting) > 1:
                        yield _finished(*waiting.popleft())
                while waiting:
                    yield _finished(*waiting.popleft())
            finally:
                for _, tasks in waiting:
                    for task in tasks:
                        task.cancel()

    def log_odds(self, first: int, last: int) -> NDArray[np.float32]:
        """Evidence of an obstacle in mosaic rows [first, last), 0 outside of the mosaic."""
        out = np.zeros((last - first, self.raster.width), np.float32)
        inside = slice(max(first, 0), min(last, self.raster.height))
        rows = np.arange(inside.start, inside.stop) // self.survey.factor
        columns = np.arange(self.raster.width) // self.survey.factor
        cells = self.survey.log_odds[rows[0] : rows[-1] + 1].astype(np.float32)
        out[inside.start - first : inside.stop - first] = cells[
            (rows - rows[0])[:, None], columns[None, :]
        ]
        return out

    def _corners(self, height: int) -> list[tuple[int, int]]:
        """Row in the band and column of its tiles, column by column."""
        width = self.raster.width
        return [(v, u) for u in range(0, width, TILE) for v in range(0, height, TILE)]

    def _fill(self, band: MosaicBand, top: int, left: int) -> None:
        """Sample all views of a tile of a band and blend them."""
        window = np.s_[top : top + TILE, left : left + TILE]
        rgba, error = band.rgba[window], band.error[window]
        height, width = error.shape
        inside = self._index.touching(left, band.row + top, width, height)
        if not len(inside):
            return
        samples = Samples.empty(height, width, len(inside))
        for k in inside:
            self._sample(int(k), left, band.row + top, samples)
        self._blend.kernel(
            samples.colours,
            samples.density,
            samples.clean,
            self._light(left, band.row + top, width, height),
            samples.count,
            rgba,
            error,
        )
        band.views[window] = np.minimum(samples.count, MOST_VIEWS)

    def _light(self, column: int, row: int, width: int, height: int) -> NDArray[np.float32]:
        """Light of the ground in the pixels of a tile, (height, width)."""
        if not self._blend.surveys:
            return np.ones((height, width), np.float32)
        f = self.survey.factor
        # cell centres lie in the middle of their pixels
        u, v = (
            (first + np.arange(n) - (f - 1) / 2) / f
            for first, n in ((column, width), (row, height))
        )
        left, top = max(int(np.floor(u[0])), 0), max(int(np.floor(v[0])), 0)
        cells = self.survey.light[top : int(v[-1]) + 2, left : int(u[-1]) + 2]
        x, y = np.meshgrid((u - left).astype(np.float32), (v - top).astype(np.float32))
        light = cv2.remap(cells, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(light, dtype=np.float32)

    def _sample(self, k: int, column: int, row: int, samples: Samples) -> None:
        """Add one view to the samples of a tile."""
        p = self._placed[k]
        if p is None:
            return
        camera = p.view.camera
        gain = falloff = 0.0
        clean, cells = ALL_CLEAN, np.array([0.0, 0.0, 0.0])
        if self._blend.surveys:
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
            p.view.read(),
            *p.border,
            p.pixel_from_raster @ whole_from_part(column, row),
            p.max_depth,
            lens,
            clean,
            cells,
            samples.colours,
            samples.density,
            samples.clean,
            samples.count,
        )


def _finished(band: MosaicBand, tasks: list[Future[None]]) -> MosaicBand:
    """Wait for all tiles of a band."""
    for task in tasks:
        task.result()
    return band


def compose(
    views: Sequence[PosedView | Picture], raster: MosaicRaster, blend: Blend, jobs: int = 1
) -> Mosaic:
    """Compose a whole mosaic in memory; parameters as for :class:`Composition`."""
    composition = Composition(views, raster, blend, jobs)
    whole = MosaicBand.empty(0, raster.height, raster.width)
    for band in composition.bands():
        rows = slice(band.row, band.row + len(band.rgba))
        whole.rgba[rows], whole.views[rows] = band.rgba, band.views
        whole.error[rows] = band.error
    odds = composition.log_odds(0, raster.height)
    return Mosaic(raster, whole.rgba, whole.views, whole.error, odds)
