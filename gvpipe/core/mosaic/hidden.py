"""Ground on which nothing stands, as far as enough cameras see it past the known obstacles."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gvpipe.core.mosaic.occupancy import FREE, UNKNOWN, draw_footprints
from gvpipe.core.mosaic.raster import MosaicRaster, Posed, outline
from gvpipe.core.types import Float

MAX_HEIGHT_SHARE = 0.95
"""Obstacles count as no higher than this share of the camera's height: the shadow of a higher one
has no end, and one 20 times the obstacle's distance long leaves every picture."""


@dataclass(frozen=True)
class Prism:
    """An obstacle as an upright prism.

    Attributes
    ----------
    footprint : (N, 2) float64
        Outline on the ground, map metres.
    height_m : float
        Above the ground.
    """

    footprint: Float
    height_m: float


def with_obstacles(
    cells: NDArray[np.int8],
    prisms: Sequence[Prism],
    views: Sequence[Posed],
    raster: MosaicRaster,
    least_views: int,
    least_share: float,
) -> NDArray[np.int8]:
    """Correct an occupancy grid by what stands on the ground.

    Parameters
    ----------
    cells : (H, W) int8
        Cell states.
    prisms : sequence of Prism
        Obstacles.
    views : sequence of Posed
        All cameras of the map.
    raster : MosaicRaster
        Of the cells.
    least_views, least_share : int, float
        Views that must see a place for an obstacle there to be found, and their share of the views
        that see the best seen one.

    Returns
    -------
    cells : (H, W) int8
        A copy: occupied under the obstacles; unknown where it was free though fewer cameras see
        the ground there past them: what they saw may be the side of an obstacle, known or not.
    """
    count = np.zeros(cells.shape, np.uint16)
    for view in views:
        ground = outline(view, raster.resolution)
        if len(ground):
            count += _sight(view, ground, prisms, cells.shape, raster)
    enough = max(least_views, least_share * int(count.max(initial=0)))
    hidden = (cells == FREE) & (count < enough)
    known = np.where(hidden, UNKNOWN, cells).astype(np.int8)
    return draw_footprints(known, [p.footprint for p in prisms], raster.map_from_pixel)


def _sight(
    view: Posed,
    ground: Float,
    prisms: Sequence[Prism],
    shape: tuple[int, ...],
    raster: MosaicRaster,
) -> NDArray[np.uint8]:
    """Ground in view without the shadows that obstacles throw from the camera, (H, W) 0 or 1."""
    seen = np.zeros(shape, np.uint8)
    cv2.fillPoly(seen, [_pixels(ground, raster)], 1)
    centre = view.map_from_camera.translation
    for prism in prisms:
        height = min(prism.height_m, MAX_HEIGHT_SHARE * centre[2])
        top = centre[:2] + (prism.footprint - centre[:2]) * (centre[2] / (centre[2] - height))
        corners = np.concatenate([prism.footprint, top])
        cv2.fillConvexPoly(seen, cv2.convexHull(_pixels(corners, raster)), 0)
    return seen


def _pixels(points: Float, raster: MosaicRaster) -> NDArray[np.int32]:
    """Nearest pixels of map points, (N, 2)."""
    return np.rint(raster.pixel_from_map(points)).astype(np.int32)
