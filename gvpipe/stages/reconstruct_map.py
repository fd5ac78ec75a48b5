"""The ROS map with reconstructed obstacles drawn into it."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvpipe.artefacts import Artefact
from gvpipe.core.mosaic.hidden import Prism, with_obstacles
from gvpipe.core.mosaic.raster import MosaicRaster, Posed
from gvpipe.core.reconstruct.evidence_options import EvidenceOptions
from gvpipe.core.reconstruct.hull import VIEW_SHARE
from gvpipe.errors import InputError
from gvpipe.formats.occupancy import pgm_bytes, read_pgm, yaml_text
from gvpipe.records import MosaicBody, ObstacleRow


@dataclass(frozen=True)
class RosMap:
    """An occupancy grid and where it lies."""

    cells: NDArray[np.int8]
    raster: MosaicRaster


def read_map(mosaic: Artefact[MosaicBody]) -> RosMap:
    """Read the mosaic's map.

    Raises
    ------
    InputError
        If it is damaged, or not what `mosaic.json` describes.
    """
    body, path = mosaic.body, mosaic.folder / "map.pgm"
    try:
        cells = read_pgm(path.read_bytes())
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: {error}") from None
    if cells.shape != (body.height, body.width):
        raise InputError(f"{path}: not the map that mosaic.json describes")
    m = body.map_from_pixel
    raster = MosaicRaster(body.width, body.height, body.resolution, float(m[0, 2]), float(m[1, 2]))
    if body.resolution <= 0 or not np.allclose(m, raster.map_from_pixel):
        json_path = mosaic.folder / body.file
        raise InputError(f"{json_path}: map_from_pixel: does not fit the resolution")
    return RosMap(cells, raster)


def map_with_obstacles(
    bare: RosMap, obstacles: Sequence[ObstacleRow], views: Sequence[Posed]
) -> RosMap:
    """Correct a map by the obstacles found.

    Parameters
    ----------
    bare : RosMap
        The mosaic's.
    obstacles : sequence of ObstacleRow
        Footprints and heights.
    views : sequence of Posed
        All cameras of the main component.

    Returns
    -------
    map : RosMap
        Occupied under the obstacles, free only where one that is not known would have been found.
    """
    prisms = [Prism(row.footprint, row.height_m) for row in obstacles]
    least = EvidenceOptions().min_views, VIEW_SHARE
    return RosMap(with_obstacles(bare.cells, prisms, views, bare.raster, *least), bare.raster)


def write_ros_map(ros_map: RosMap, folder: Path) -> None:
    """Write `map.pgm` and `map.yaml`."""
    raster = ros_map.raster
    y_min = raster.y_max - (raster.height - 1) * raster.resolution
    (folder / "map.pgm").write_bytes(pgm_bytes(ros_map.cells))
    yaml = yaml_text("map.pgm", raster.resolution, raster.x_min, y_min)
    (folder / "map.yaml").write_text(yaml)
