"""The obstacles in 3D, from silhouettes against the mosaic and from consistent colours."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
from numpy.typing import NDArray

from gvpipe.artefacts import write_npz
from gvpipe.config import Config, ReconstructConfig
from gvpipe.core.reconstruct.background import GroundModel
from gvpipe.core.reconstruct.carving import level_set_of, space_carving, visual_hull, voxel_coloring
from gvpipe.core.reconstruct.evidence import Region, data_terms, find_regions
from gvpipe.core.reconstruct.grid import VoxelGrid
from gvpipe.core.reconstruct.levelset import Evolution, evolve
from gvpipe.core.reconstruct.mesh import Obstacle, PointCloud, find_obstacles, join
from gvpipe.core.reconstruct.render import turntable
from gvpipe.core.reconstruct.silhouette import EvidenceOptions, Silhouette, silhouettes
from gvpipe.core.reconstruct.visibility import colour, surface_points
from gvpipe.core.types import PosedView
from gvpipe.errors import InputError
from gvpipe.formats.ply import write_mesh, write_points
from gvpipe.formats.raster import png_bytes
from gvpipe.records import Body, MosaicBody, ObstacleRow, ReconstructBody, SlamBody
from gvpipe.stages.contract import Context, Outcome, posed_views

SECTIONS = ("cameras", "robots", "match", "overlap", "slam", "mosaic", "reconstruct", "seed")
BODY = ReconstructBody

TURNTABLE_VIEWS = 4
"""Pictures of the obstacles, from all sides, on one sheet of two rows."""

Method = Callable[
    [VoxelGrid, Sequence[PosedView], Sequence[Silhouette], ReconstructConfig, int], Evolution
]


@dataclass(frozen=True)
class Volume:
    """The level-set function of one region."""

    grid: VoxelGrid
    evolution: Evolution


@dataclass(frozen=True)
class Reconstruction:
    """All regions and what stands in them."""

    volumes: tuple[Volume, ...]
    obstacles: tuple[Obstacle, ...]
    views: tuple[PosedView, ...]
    ground: GroundModel


def needs(config: Config) -> tuple[type[Body], ...]:
    """Read the poses and the ground's picture."""
    return (SlamBody, MosaicBody)


def run(context: Context) -> Outcome[ReconstructBody, Reconstruction]:
    """Find where obstacles stand, then their surfaces."""
    settings = context.config.reconstruct
    views = posed_views(context.dataset, context.artefact(SlamBody).body)
    options = EvidenceOptions()
    ground = _ground(context)
    shapes = silhouettes(views, ground, options, context.jobs)
    regions = find_regions(views, shapes, options)
    volumes = []
    with context.progress("reconstruct", len(regions)) as ticker:
        for region in regions:
            grid = _grid(region, views, settings.grid)
            evolution = _volume(context, grid, views, shapes)
            volumes.append(Volume(grid, evolution))
            ticker.advance()
    found = [o for v in volumes for o in find_obstacles(v.evolution.u, v.grid)]
    found.sort(key=lambda obstacle: -obstacle.volume_m3)
    rows = tuple(
        ObstacleRow(
            id=k,
            footprint=obstacle.footprint,
            height_m=obstacle.height_m,
            volume_m3=obstacle.volume_m3,
            centroid=obstacle.centroid,
        )
        for k, obstacle in enumerate(found)
    )
    body = ReconstructBody(
        method=settings.method,
        obstacles=rows,
        energy=_total_energy([v.evolution for v in volumes]),
        iterations=max((v.evolution.iterations for v in volumes), default=0),
        converged=all(v.evolution.converged for v in volumes),
    )
    summary = tuple(
        (f"obstacle {row.id}", f"{row.height_m:.3f} m high, {row.volume_m3 * 1e3:.2f} litres")
        for row in rows[:12]
    )
    return Outcome(
        body,
        Reconstruction(tuple(volumes), tuple(found), tuple(views), ground),
        no_result=None if rows else "nothing stands on the ground that enough views see",
        summary=(("obstacles", str(len(rows))), *summary),
    )


def _volume(
    context: Context,
    grid: VoxelGrid,
    views: Sequence[PosedView],
    shapes: Sequence[Silhouette],
) -> Evolution:
    """Evolve one region, unless an interrupted run has done so."""
    settings = context.config.reconstruct
    seen = [context.artefact(SlamBody).digest, context.artefact(MosaicBody).digest]
    where = (grid.origin.tolist(), grid.spacing.tolist(), grid.shape)
    key = context.checkpoints.key("region", seen, settings.model_dump_json(), where)
    evolution: Evolution | None = context.checkpoints.load(key, Evolution)
    if evolution is None:
        evolution = METHODS[settings.method](grid, views, shapes, settings, context.jobs)
        context.checkpoints.save(key, evolution)
    return evolution


def write(outcome: Outcome[ReconstructBody, Reconstruction], folder: Path) -> None:
    """Write the coloured mesh, its points and the level-set function."""
    result = outcome.payload
    mesh = colour(join([obstacle.mesh for obstacle in result.obstacles]), result.views)
    write_mesh(folder / "obstacles.ply", mesh)
    if len(mesh.faces):
        sheet = turntable(mesh, result.ground, TURNTABLE_VIEWS)
        pair = len(sheet) // 2
        rows = [np.hstack(sheet[:pair]), np.hstack(sheet[pair:])]
        (folder / "turntable.png").write_bytes(png_bytes(np.vstack(rows)))
    cloud = surface_points(mesh) if len(mesh.faces) else _no_points()
    write_points(folder / "points.ply", cloud)
    arrays: dict[str, NDArray[Any]] = {}
    for k, volume in enumerate(result.volumes):
        end = f"_{k}" if k else ""
        arrays[f"u{end}"] = volume.evolution.u
        arrays[f"origin{end}"] = volume.grid.origin
        arrays[f"spacing{end}"] = volume.grid.spacing
    if not arrays:
        arrays = {
            "u": np.zeros((0, 0, 0), np.float32),
            "origin": np.zeros(3),
            "spacing": np.ones(3),
        }
    write_npz(folder / "volume.npz", arrays)


def _no_points() -> PointCloud:
    nothing = np.empty((0, 3))
    return PointCloud(nothing, nothing, nothing.astype(np.uint8))


def _ground(context: Context) -> GroundModel:
    """Read the mosaic as the model of the bare ground."""
    mosaic = context.artefact(MosaicBody)
    path = mosaic.folder / "mosaic.png"
    try:
        rgba = iio.imread(path.read_bytes(), extension=".png")
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not a picture: {error}") from None
    if rgba.shape != (mosaic.body.height, mosaic.body.width, 4):
        raise InputError(f"{path}: not the picture that mosaic.json describes")
    return GroundModel(rgba.astype(np.uint8), mosaic.body.map_from_pixel)


def _grid(region: Region, views: Sequence[PosedView], cells: tuple[int, int, int]) -> VoxelGrid:
    """Lay voxels over a region: as many as configured, none smaller than a pixel's footprint."""
    size = region.upper - region.lower
    middle = (region.lower + region.upper) / 2
    distances = [np.linalg.norm(v.map_from_camera.translation - middle) for v in views]
    focal = np.median([v.camera.fx for v in views])
    pixel = float(np.median(distances) / focal)
    spacing = max(float((size / np.array(cells)).max()), pixel)
    shape = np.maximum(np.ceil(size / spacing).astype(int), 8)
    origin = np.array([*(middle[:2] - (shape[:2] - 1) * spacing / 2), spacing / 2])
    return VoxelGrid(origin, np.full(3, spacing), (int(shape[0]), int(shape[1]), int(shape[2])))


def _level_set(
    grid: VoxelGrid,
    views: Sequence[PosedView],
    shapes: Sequence[Silhouette],
    settings: ReconstructConfig,
    jobs: int,
) -> Evolution:
    """Evolve a box that fills the region down to the surface (thesis 5.6)."""
    f, g = data_terms(views, shapes, grid, EvidenceOptions(), jobs)
    start = np.full(grid.shape, -1.0, np.float32)
    start[2:-2, 2:-2, :-2] = 1.0
    return evolve(
        start,
        f,
        g * float(grid.spacing[0]),
        grid.spacing,
        iterations=settings.iterations,
        evolution=settings.evolution,
        jobs=jobs,
    )


def _carved(carve: Callable[..., NDArray[np.bool_]]) -> Method:
    """Make a method of a carving function: it has no energy and no iterations."""

    def method(
        grid: VoxelGrid,
        views: Sequence[PosedView],
        shapes: Sequence[Silhouette],
        settings: ReconstructConfig,
        jobs: int,
    ) -> Evolution:
        u = level_set_of(carve(views, shapes, grid), grid)
        return Evolution(u, energy=[], iterations=0, converged=True)

    return method


METHODS: dict[str, Method] = {
    "level-set": _level_set,
    "visual-hull": _carved(visual_hull),
    "voxel-coloring": _carved(voxel_coloring),
    "space-carving": _carved(space_carving),
}
"""By name in the configuration: grid, views, silhouettes, settings and threads to a volume."""


def _total_energy(evolutions: Sequence[Evolution]) -> tuple[tuple[int, float], ...]:
    """Sum of the regions' energies: each holds its last value once it rests."""
    steps = sorted({step for e in evolutions for step, _ in e.energy})
    total = []
    for step in steps:
        values = [[v for s, v in e.energy if s <= step] or [e.energy[0][1]] for e in evolutions]
        total.append((step, float(sum(v[-1] for v in values))))
    return tuple(total)
