"""The overhead maps of all components, with their layers and occupancy grids for ROS."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from gvpipe.config import Config
from gvpipe.core.mosaic.blend import BLENDS
from gvpipe.core.mosaic.compose import Composition, MosaicBand
from gvpipe.core.mosaic.occupancy import margin, occupancy, probability_steps
from gvpipe.core.mosaic.raster import Picture, plan_raster
from gvpipe.core.types import Pose
from gvpipe.dataset import Dataset
from gvpipe.errors import InputError
from gvpipe.formats.occupancy import pgm_header, pgm_rows, yaml_text
from gvpipe.formats.pyramid import write_pyramid
from gvpipe.formats.raster import PngWriter, world_file
from gvpipe.records import Body, MosaicBody, MosaicPart, SlamBody
from gvpipe.stages.contract import Context, Outcome, Ticker, main_component

SECTIONS = ("cameras", "robots", "match", "overlap", "slam", "mosaic", "seed")
BODY = MosaicBody
PARALLEL = "threads"

PYRAMID_SIDE = 8192
"""Mosaics larger than this, in pixels, also come as a tiled TIFF: picture viewers begin to fail."""


@dataclass(frozen=True)
class Maps:
    """The compositions of all components, to be read while they are written."""

    parts: tuple[tuple[str, Composition], ...]
    progress: Callable[[str, int], AbstractContextManager[Ticker]]


def needs(config: Config) -> tuple[type[Body], ...]:
    """Read the poses."""
    return (SlamBody,)


def run(context: Context) -> Outcome[MosaicBody, Maps]:
    """Survey the pictures of every component."""
    settings = context.config.mosaic
    slam = context.artefact(SlamBody)
    rows: list[MosaicPart] = []
    parts: list[tuple[str, Composition]] = []
    for component in _components(slam.body):
        images, pictures = _pictures(context.dataset, slam.body, component)
        try:
            raster = plan_raster(pictures, settings.resolution)
        except ValueError as error:
            if rows:  # a stray picture of the horizon does not spoil the map
                continue
            why = slam.header.reason or error
            raise InputError(f"{slam.folder / slam.body.file}: {why}") from None
        composition = Composition(pictures, raster, BLENDS[settings.blend], context.jobs)
        suffix = f"_{len(rows)}" if rows else ""
        parts.append((suffix, composition))
        rows.append(
            MosaicPart(
                component=component,
                suffix=suffix,
                map_from_pixel=raster.map_from_pixel,
                width=raster.width,
                height=raster.height,
                images=images,
                coverage_m2=round(composition.survey.covered_m2, 6),
            )
        )
    main = rows[0].model_dump(exclude={"suffix"})
    body = MosaicBody(
        **main, resolution=settings.resolution, blend=settings.blend, components=tuple(rows)
    )
    summary = [
        (
            f"map{row.suffix}",
            f"{row.width} x {row.height} pixels of {settings.resolution:g} m, "
            f"{row.coverage_m2:.2f} m² covered",
        )
        for row in rows
    ]
    return Outcome(body, Maps(tuple(parts), context.progress), summary=tuple(summary))


def write(outcome: Outcome[MosaicBody, Maps], folder: Path) -> None:
    """Compose the maps band by band into their files."""
    maps = outcome.payload
    bands = sum(len(composition.band_rows) for _, composition in maps.parts)
    with maps.progress("compose", bands) as ticker:
        for suffix, composition in maps.parts:
            write_map(composition, folder, suffix, ticker)


def _components(slam: SlamBody) -> list[int]:
    """Give the main component, then the others by number."""
    main = main_component(slam)
    return [main, *sorted({row.component for row in slam.poses} - {main})]


def _pictures(
    dataset: Dataset, slam: SlamBody, component: int
) -> tuple[tuple[str, ...], list[Picture]]:
    """Ids of the images of a component, and their pictures, to be read when needed."""
    rows = [row for row in slam.poses if row.component == component]

    def reader(image: str) -> Callable[[], NDArray[np.uint8]]:
        return lambda: dataset.view(image).pixels

    pictures = [
        Picture(
            dataset.entry(row.image).camera,
            Pose(row.R, row.t),
            reader(row.image),
            dataset.inside(row.image),
        )
        for row in rows
    ]
    return tuple(row.image for row in rows), pictures


def write_map(composition: Composition, folder: Path, suffix: str, ticker: Ticker) -> None:
    """Write the picture with its world file, its layers and the ROS map.

    Parameters
    ----------
    composition : Composition
        Composed here, band by band.
    folder : Path
        Where the files go.
    suffix : str
        Ends their names.
    ticker : Ticker
        Counts the bands.
    """
    raster = composition.raster
    size = (raster.width, raster.height)
    y_min = raster.y_max - (raster.height - 1) * raster.resolution
    (folder / f"mosaic{suffix}.pgw").write_text(world_file(raster.map_from_pixel))
    yaml = yaml_text(f"map{suffix}.pgm", raster.resolution, raster.x_min, y_min)
    (folder / f"map{suffix}.yaml").write_text(yaml)
    with ExitStack() as stack:

        def opened(name: str) -> IO[bytes]:
            return stack.enter_context((folder / name).open("wb"))

        picture = PngWriter(opened(f"mosaic{suffix}.png"), *size, channels=4)
        layers = [
            PngWriter(opened(f"{name}{suffix}.png"), *size, channels=1)
            for name in ("views", "uncertainty", "evidence")
        ]
        grid = opened(f"map{suffix}.pgm")
        grid.write(pgm_header(*size))

        def strips() -> Iterator[NDArray[np.uint8]]:
            for band in composition.bands():
                picture.write(band.rgba)
                cells, evidence = _ground_state(composition, band)
                for layer, values in zip(layers, (band.views, band.error, evidence), strict=True):
                    layer.write(values)
                grid.write(pgm_rows(cells))
                ticker.advance()
                yield band.rgba

        if max(size) > PYRAMID_SIDE:
            write_pyramid(folder / f"mosaic{suffix}.tif", *size, strips(), raster.map_from_pixel)
        else:
            for _ in strips():
                pass
        for writer in (picture, *layers):
            writer.close()


def _ground_state(
    composition: Composition, band: MosaicBand
) -> tuple[NDArray[np.int8], NDArray[np.uint8]]:
    """States of the cells of a band, and the probability that they are occupied."""
    resolution = composition.raster.resolution
    around = margin(resolution)
    odds = composition.log_odds(band.row - around, band.row + len(band.views) + around)
    seen = band.views > 0
    steps = probability_steps(odds[around:-around], seen)
    return occupancy(seen, odds, resolution, around), steps
