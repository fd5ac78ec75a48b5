"""The obstacles in 3D, from silhouettes against the ground and from consistent colours."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gvpipe.config import Config
from gvpipe.core.reconstruct.agreement import ONE_SIDE_DEG, agreement
from gvpipe.core.reconstruct.background import GroundModel
from gvpipe.core.reconstruct.evidence import find_regions
from gvpipe.core.reconstruct.evidence_options import EvidenceOptions, Silhouette
from gvpipe.core.reconstruct.ghosts import standing_obstacles
from gvpipe.core.reconstruct.grid import VoxelGrid
from gvpipe.core.reconstruct.mesh import Obstacle, find_obstacles
from gvpipe.core.reconstruct.silhouette import count_steps, silhouettes
from gvpipe.core.reconstruct.solution import Solution
from gvpipe.core.types import PosedView
from gvpipe.errors import InputError
from gvpipe.formats.raster import read_png
from gvpipe.records import Body, MosaicBody, ObstacleRow, ReconstructBody, SlamBody
from gvpipe.stages.contract import Context, Outcome, posed_views, shortened
from gvpipe.stages.reconstruct_files import Scene, SolvedRegion, write_scene
from gvpipe.stages.reconstruct_map import RosMap, map_with_obstacles, read_map, write_ros_map
from gvpipe.stages.reconstruct_methods import METHODS, grid_over

SECTIONS = ("cameras", "robots", "match", "overlap", "slam", "mosaic", "reconstruct", "seed")
BODY = ReconstructBody
PARALLEL = "threads"


@dataclass(frozen=True)
class Reconstruction:
    """What is written beside the JSON."""

    scene: Scene
    ros_map: RosMap


def needs(config: Config) -> tuple[type[Body], ...]:
    """Read the poses and the ground's picture."""
    return (SlamBody, MosaicBody)


def run(context: Context) -> Outcome[ReconstructBody, Reconstruction]:
    """Find where obstacles stand, then their surfaces."""
    settings = context.config.reconstruct
    views = posed_views(context.dataset, context.artefact(SlamBody).body)
    options = EvidenceOptions()
    ground, bare = _ground(context), read_map(context.artefact(MosaicBody))
    with context.progress("silhouettes", count_steps(views, options)) as ticker:
        shapes = silhouettes(views, ground, options, context.jobs, ticker.advance)
    regions = find_regions(views, shapes, options, context.jobs)
    solved = []
    with context.progress("reconstruct", len(regions)) as ticker:
        for region in regions:
            grid = grid_over(region, views, settings.grid)
            solved.append(SolvedRegion(grid, _solution(context, grid, views, shapes)))
            ticker.advance()
    bodies = [o for s in solved for o in find_obstacles(s.solution.u, s.grid)]
    found = standing_obstacles(bodies)
    found.sort(key=lambda obstacle: -obstacle.volume_m3)
    rows = _rows(found, views, shapes)
    solutions = [s.solution for s in solved]
    body = ReconstructBody(
        method=settings.method,
        obstacles=rows,
        energy=_total_energy(solutions),
        iterations=max((s.iterations for s in solutions), default=0),
        converged=all(s.converged for s in solutions),
    )
    summary = [
        (
            f"obstacle {row.id}",
            f"{row.height_m:.3f} m high, {float(f'{1e3 * row.volume_m3:.3g}'):g} litres, "
            f"confidence {row.confidence:.2f} from {row.views} views"
            + ", all on one side"
            * (row.azimuth_span_deg < ONE_SIDE_DEG),
        )
        for row in rows
    ]
    return Outcome(
        body,
        Reconstruction(
            Scene(tuple(solved), tuple(found), tuple(views), ground),
            map_with_obstacles(bare, rows, views),
        ),
        no_result=None if rows else "nothing stands on the ground that enough views see",
        summary=(("obstacles", str(len(rows))), *shortened(summary, 12)),
    )


def _solution(
    context: Context,
    grid: VoxelGrid,
    views: Sequence[PosedView],
    shapes: Sequence[Silhouette],
) -> Solution:
    """Reconstruct one region, unless an interrupted run has done so."""
    settings = context.config.reconstruct
    seen = [context.artefact(SlamBody).digest, context.artefact(MosaicBody).digest]
    where = (grid.origin.tolist(), grid.spacing.tolist(), grid.shape)
    key = context.checkpoints.key("region", seen, settings.model_dump_json(), where)
    solution: Solution | None = context.checkpoints.load(key, Solution)
    if solution is None:
        solution = METHODS[settings.method](grid, views, shapes, settings, context.jobs)
        context.checkpoints.save(key, solution)
    return solution


def _rows(
    found: Sequence[Obstacle], views: Sequence[PosedView], shapes: Sequence[Silhouette]
) -> tuple[ObstacleRow, ...]:
    """Describe the obstacles, in order."""
    agreements = agreement([obstacle.mesh for obstacle in found], views, shapes)
    return tuple(
        ObstacleRow(
            id=k,
            footprint=obstacle.footprint,
            height_m=obstacle.height_m,
            volume_m3=obstacle.volume_m3,
            centroid=obstacle.centroid,
            confidence=agreed.confidence,
            views=agreed.views,
            azimuth_span_deg=float(np.degrees(agreed.azimuth_span)),
        )
        for k, (obstacle, agreed) in enumerate(zip(found, agreements, strict=True))
    )


def write(outcome: Outcome[ReconstructBody, Reconstruction], folder: Path) -> None:
    """Write meshes, points, the level-set functions, pictures and the ROS map."""
    write_scene(outcome.payload.scene, folder)
    write_ros_map(outcome.payload.ros_map, folder)


def _ground(context: Context) -> GroundModel:
    """Read the mosaic as the model of the bare ground."""
    mosaic = context.artefact(MosaicBody)
    path = mosaic.folder / "mosaic.png"
    rgba = read_png(path)
    if rgba.shape != (mosaic.body.height, mosaic.body.width, 4):
        raise InputError(f"{path}: not the picture that mosaic.json describes")
    return GroundModel(rgba, mosaic.body.map_from_pixel)


def _total_energy(solutions: Sequence[Solution]) -> tuple[tuple[int, float], ...]:
    """Sum of the regions' energies: each holds its last value once it rests."""
    steps = sorted({step for e in solutions for step, _ in e.energy})
    total = []
    for step in steps:
        values = [[v for s, v in e.energy if s <= step] or [e.energy[0][1]] for e in solutions]
        total.append((step, float(sum(v[-1] for v in values))))
    return tuple(total)
