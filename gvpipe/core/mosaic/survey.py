"""A coarse look at all views before they are composed: which of them see ground, and how bright.

An obstacle does not lie in the ground plane, so in every overhead view it is smeared away from
the camera, over ground that other views see. Cell by cell the views vote on the colour of the
ground; a vote counts by direction, by length of the line of sight, by how common its colour is on
ground that views from several sides agree on, and by the grain that it shares with others.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.kernels import survey as kernels
from gvpipe.core.kernels.mosaic import CLEAN_SHARE
from gvpipe.core.mosaic.cleanmap import CleanMap
from gvpipe.core.mosaic.exposure import Exposure, Spots, balance
from gvpipe.core.mosaic.groundcolours import GroundColours, colour_bins
from gvpipe.core.mosaic.raster import Border, MosaicRaster, Picture, PlacedIndex, max_depth
from gvpipe.core.mosaic.sight import Look, look_at, take_sight
from gvpipe.core.mosaic.smoothing import mean_around, smooth_light
from gvpipe.core.mosaic.tiles import in_order
from gvpipe.core.types import PosedView

CELLS_PER_HEIGHT = 25.0
"""Cells in one camera height: 2 to 3 cm for a robot, smaller than what it must not run into and
large enough to average the grain of the floor and a pixel of misregistration."""

TILE = 24
"""Side of a survey tile, cells: about a camera height, the neighbourhood of ground colours."""

MARGIN = 2
"""Cells around a tile that its smoothing needs."""

REACH_HEIGHTS = 4.0
"""Line of sight over the ground, in camera heights, at which a vote has lost 63 % of its weight."""

LIKE = 15.0
"""Colours closer than this (grey levels, RGB distance) are the same: noise and registration."""

FIT = 20.0
"""Colours closer than this to the ground's are ground."""

COLOUR_WEIGHT = 0.4
"""Weight of a colour's log likelihood on the ground against one direction's vote: a colour e^2.5
times rarer counts about as much as one view from a direction of its own."""

SURE_SHARE, SURE_WEIGHT = 0.8, 1.3
"""Cells where four fifths of at least one and a bit directions agree teach the ground's colours."""

MAX_SPOTS = 60_000
"""Spots in the estimate of exposures: some hundred for each of hundreds of views."""

SAME = 0.02
"""Change of the log ratio of two views from a cell to the next that halves the cell's weight in the
estimate of exposures: where both show ground, they show the same grain, and the ratio stays."""

SLOPE_NOISE = 5.0
"""Slopes of a cell (grey levels) down to which views differ by noise and registration."""

GRAIN = 3.0
"""A view of the same colour counts one and this much where it shows the same grain: an obstacle may
have the colour of the ground, or look alike from all sides, but its grain lies elsewhere in every
view. From 1 on ghosts lose ties; from 2 to 4 the maps are the same."""

LOG_ODDS = 0.85
"""Evidence of one direction that shows ground, or that does not: odds of 7 to 3."""

Single = NDArray[np.float32]


@dataclass(frozen=True)
class Survey:
    """What the coarse look found.

    Attributes
    ----------
    factor : int
        Mosaic pixels in a cell's side.
    raster : MosaicRaster
        The cells.
    exposure : Exposure
        Brightness of the views.
    clean : tuple of CleanMap
        One of each view.
    borders : tuple of Border
        Of the pictures.
    light : (H, W) float32
        How bright the clean views show each cell, against the balanced exposure; smooth.
    log_odds : (H, W) float16
        Evidence of an obstacle in each cell, negative = free ground.
    covered_m2 : float
        Area of the cells that any view sees.
    """

    factor: int
    raster: MosaicRaster
    exposure: Exposure
    clean: tuple[CleanMap, ...]
    borders: tuple[Border, ...]
    light: Single
    log_odds: NDArray[np.float16]
    covered_m2: float


def survey(views: Sequence[PosedView | Picture], raster: MosaicRaster, jobs: int = 1) -> Survey:
    """Look at all views in coarse cells.

    Parameters
    ----------
    views : sequence of PosedView or Picture
        Pictures with their poses in the map; each is read once.
    raster : MosaicRaster
        The mosaic to be composed.
    jobs : int
        Threads; the result does not depend on it.

    Returns
    -------
    survey : Survey
    """
    height = float(np.median([v.map_from_camera.translation[2] for v in views]))
    factor = max(1, round(height / CELLS_PER_HEIGHT / raster.resolution))
    return _Surveyor([Picture.of(v) for v in views], raster, factor, jobs).run()


class _Surveyor:
    """The passes over the tiles, with the cells they share."""

    def __init__(
        self, views: Sequence[Picture], raster: MosaicRaster, factor: int, jobs: int
    ) -> None:
        self.views, self.factor, self.jobs = views, factor, jobs
        self.cells = raster.coarser(factor)
        self.cameras = np.array([v.map_from_camera.translation for v in views])
        seen = list(
            in_order(
                lambda v: take_sight(v, self.cells, max_depth(v, raster.resolution)), views, jobs
            )
        )
        self.placed = [placed for placed, _ in seen]
        self.sights = [sight for _, sight in seen]
        self.index = PlacedIndex(self.placed)
        corners = [
            (row, column)
            for row in range(0, self.cells.height, TILE)
            for column in range(0, self.cells.width, TILE)
        ]
        self.tiles = [c for c in corners if len(self._touching(c))]

    def run(self) -> Survey:
        """Balance the exposures, learn the ground's colours, then judge the views tile by tile."""
        spots = in_order(self._spots, self.tiles, self.jobs)
        exposure = self._balance(spots)
        tallies = in_order(lambda t: self._tally(t, exposure), self.tiles, self.jobs)
        known = GroundColours(TILE, dict(zip(self.tiles, tallies, strict=True)))
        maps = [CleanMap.blank(p, self.cells) for p in self.placed]
        evidence = np.zeros((self.cells.height, self.cells.width), np.float16)
        light = np.full(evidence.shape, np.nan, np.float32)
        covered = 0
        judged = in_order(
            lambda t: self._judge(t, exposure, known.around(t)), self.tiles, self.jobs
        )
        for tile, (look, clean, lit, odds) in zip(self.tiles, judged, strict=True):
            here = np.s_[tile[0] : tile[0] + TILE, tile[1] : tile[1] + TILE]
            light[here], evidence[here] = lit, odds
            inner = look.radii[MARGIN:-MARGIN, MARGIN:-MARGIN]
            covered += int((inner >= 0).any(axis=2).sum())
            for k, weights in zip(look.views, np.moveaxis(clean, 2, 0), strict=True):
                maps[k].paste(tile, weights)
        return Survey(
            self.factor,
            self.cells,
            exposure,
            tuple(maps),
            tuple(s.border for s in self.sights),
            smooth_light(light),
            evidence,
            covered * self.cells.resolution**2,
        )

    def _window(self, tile: tuple[int, int]) -> tuple[int, int, int, int]:
        """First column and row, width and height of a tile with its margin."""
        height = min(TILE, self.cells.height - tile[0]) + 2 * MARGIN
        width = min(TILE, self.cells.width - tile[1]) + 2 * MARGIN
        return tile[1] - MARGIN, tile[0] - MARGIN, width, height

    def _touching(self, tile: tuple[int, int]) -> NDArray[np.intp]:
        """Find the views that may see a tile or its margin."""
        return self.index.touching(*self._window(tile))

    def _look(self, tile: tuple[int, int]) -> Look:
        """Gather the cells of a tile and its margin from all views."""
        return look_at(self.sights, self._touching(tile), self._window(tile))

    def _spots(self, tile: tuple[int, int]) -> Spots:
        """Cells seen by successive views."""
        look = self._look(tile)
        total = self.cells.width * self.cells.height
        step = max(1, round(float(np.sqrt(total / MAX_SPOTS))))
        pairs, *rest = kernels.successive(look.colours, look.radii, step, SAME)
        return Spots(look.views[pairs], *rest)

    def _balance(self, spots: Iterable[Spots]) -> Exposure:
        """Exposures from the spots of all tiles."""
        cameras = {c: k for k, c in enumerate(dict.fromkeys(v.camera for v in self.views))}
        camera_of = np.array([cameras[v.camera] for v in self.views], dtype=np.intp)
        return balance(Spots.joined(spots), camera_of)

    def _brightness(self, look: Look, exposure: Exposure) -> Single:
        """How bright each view shows its cells, against the balanced exposure; (h, w, n)."""
        gain = exposure.log_gain[look.views] + exposure.falloff[look.views] * look.radii
        return np.exp(gain).astype(np.float32)

    def _vote(self, look: Look, exposure: Exposure, grain: float) -> tuple[Single, Single, Single]:
        """Balanced colours, weights and support of a tile's views, shared grain at a weight."""
        brightness = self._brightness(look, exposure)
        colours = look.colours / brightness[..., None]
        weights, support = np.empty_like(look.radii), np.empty_like(look.radii)
        m = self.cells.map_from_pixel
        kernels.vote(
            colours,
            look.slopes / brightness,
            look.radii,
            self.cameras[look.views],
            m[0, 2] + m[0, 0] * look.column,
            m[1, 2] + m[1, 1] * look.row,
            self.cells.resolution,
            REACH_HEIGHTS,
            LIKE,
            SLOPE_NOISE,
            grain,
            weights,
            support,
        )
        return colours, weights, support

    def _tally(self, tile: tuple[int, int], exposure: Exposure) -> NDArray[np.int32]:
        """Colour bins of a tile's sure ground and how often each occurs, (2, m)."""
        look = self._look(tile)
        if not len(look.views):
            return np.empty((2, 0), np.int32)
        # views from several sides must agree: grain may be that of an obstacle's foot or top
        colours, weights, support = self._vote(look, exposure, 0.0)
        best = support.argmax(axis=2)[..., None]
        agreed = np.take_along_axis(support, best, axis=2)[..., 0]
        total = weights.sum(axis=2)
        sure = (agreed > SURE_SHARE * total) & (total > SURE_WEIGHT)
        bins = colour_bins(np.take_along_axis(colours, best[..., None], axis=2)[sure, 0])
        found, occurrences = np.unique(bins, return_counts=True)
        return np.array([found, occurrences], dtype=np.int32)

    def _judge(
        self, tile: tuple[int, int], exposure: Exposure, likelihood: Single
    ) -> tuple[Look, NDArray[np.uint8], Single, Single]:
        """Clean weights (h, w, n), light and log odds (h, w) of a tile, its margin cut off."""
        look = self._look(tile)
        inner = np.s_[MARGIN : len(look.radii) - MARGIN, MARGIN : look.radii.shape[1] - MARGIN]
        clean = np.zeros_like(look.radii)
        light, odds = np.full(clean.shape[:2], np.nan, np.float32), np.zeros(clean.shape[:2])
        if len(look.views):
            colours, weights, support = self._vote(look, exposure, GRAIN)
            seen = look.radii >= 0
            known = likelihood[colour_bins(colours)]
            support = mean_around(support + COLOUR_WEIGHT * known, seen, MARGIN)
            kernels.agree(colours, look.radii, support, LIKE, FIT, clean)
            kernels.median_light(self._brightness(look, exposure), clean, CLEAN_SHARE, light)
            # one direction alone cannot tell ground from the side of an obstacle; its colour helps
            best = np.where(seen, support, -np.inf).argmax(axis=2)[..., None]
            colour = np.take_along_axis(known, best, axis=2)[..., 0]
            against = (weights * (1.0 - 2.0 * clean)).sum(axis=2)
            odds = np.where(seen.any(axis=2), LOG_ODDS * (against - COLOUR_WEIGHT * colour), 0.0)
        rounded = np.rint(255 * clean[inner]).astype(np.uint8)
        return look, rounded, light[inner], odds[inner].astype(np.float32)
