"""The overhead map of the main component, and its occupancy grid for ROS."""

from pathlib import Path

from gvpipe.config import Config
from gvpipe.core.blend import BLENDS
from gvpipe.core.mosaic import Mosaic, compose, plan_raster
from gvpipe.core.occupancy import occupancy
from gvpipe.errors import InputError
from gvpipe.formats.occupancy import pgm_bytes, yaml_text
from gvpipe.formats.raster import png_bytes, world_file
from gvpipe.records import Body, MosaicBody, SlamBody
from gvpipe.stages.contract import Context, Outcome, main_component, posed_views

SECTIONS = ("cameras", "robots", "match", "overlap", "slam", "mosaic", "seed")
BODY = MosaicBody


def needs(config: Config) -> tuple[type[Body], ...]:
    """Read the poses."""
    return (SlamBody,)


def run(context: Context) -> Outcome[MosaicBody, Mosaic]:
    """Compose the pictures of the largest map."""
    settings = context.config.mosaic
    slam = context.artefact(SlamBody)
    views = posed_views(context.dataset, slam.body, photograph_only=True)
    try:
        raster = plan_raster(views, settings.resolution)
    except ValueError as error:
        raise InputError(f"{slam.folder / slam.body.file}: {error}") from None
    mosaic = compose(views, raster, BLENDS[settings.blend], context.jobs)
    covered = float((mosaic.views > 0).sum()) * settings.resolution**2
    body = MosaicBody(
        component=main_component(slam.body),
        resolution=settings.resolution,
        map_from_pixel=raster.map_from_pixel,
        blend=settings.blend,
        width=raster.width,
        height=raster.height,
        images=tuple(view.image_id for view in views),
        coverage_m2=covered,
    )
    size = f"{raster.width} x {raster.height} pixels of {settings.resolution:g} m"
    return Outcome(body, mosaic, summary=(("map", size), ("covered", f"{covered:.2f} m²")))


def write(outcome: Outcome[MosaicBody, Mosaic], folder: Path) -> None:
    """Write the picture with its world file, and the ROS map."""
    mosaic, raster = outcome.payload, outcome.payload.raster
    (folder / "mosaic.png").write_bytes(png_bytes(mosaic.rgba))
    (folder / "mosaic.pgw").write_text(world_file(raster.map_from_pixel))
    cells = occupancy(mosaic.views > 0, mosaic.log_odds, raster.resolution)
    y_min = raster.y_max - (raster.height - 1) * raster.resolution
    (folder / "map.pgm").write_bytes(pgm_bytes(cells))
    (folder / "map.yaml").write_text(yaml_text("map.pgm", raster.resolution, raster.x_min, y_min))
