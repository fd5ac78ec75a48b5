"""The files of a reconstruction beside its JSON: meshes, points, volume and pictures."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvpipe.artefacts import write_npz
from gvpipe.core.reconstruct.background import GroundModel
from gvpipe.core.reconstruct.grid import VoxelGrid
from gvpipe.core.reconstruct.history import nearest_frame, restored
from gvpipe.core.reconstruct.mesh import Mesh, Obstacle, PointCloud, join, surface
from gvpipe.core.reconstruct.render import sculpture, turntable
from gvpipe.core.reconstruct.solution import Solution
from gvpipe.core.reconstruct.visibility import colour, surface_points
from gvpipe.core.types import Image, PosedView
from gvpipe.formats.figures import BLACK, layer_picture, line_colours, sheet
from gvpipe.formats.glb import write_glb
from gvpipe.formats.ply import write_mesh, write_points
from gvpipe.formats.raster import png_bytes

TURNTABLE_VIEWS = 4
"""Pictures of the obstacles, from all sides, on one sheet of two rows."""

MOMENTS = (0.0, 2 / 7, 5 / 7, 1.0)
"""When an evolution is pictured, as shares of its iterations: the thesis (figs. 5.16 and 5.17)
shows its start and iterations 400, 1000 and 1400, its last."""

PICTURE = (480, 360)
"""Width and height of the pictures of an evolution, pixels."""

LAYER_SIDE = 400
"""Side of the pictures of a layer, pixels."""


@dataclass(frozen=True)
class SolvedRegion:
    """What was found in one region."""

    grid: VoxelGrid
    solution: Solution


@dataclass(frozen=True)
class Scene:
    """All regions, what stands in them, and what it was seen by."""

    regions: tuple[SolvedRegion, ...]
    obstacles: tuple[Obstacle, ...]
    views: tuple[PosedView, ...]
    ground: GroundModel


def write_scene(scene: Scene, folder: Path) -> None:
    """Write meshes, points, the level-set functions and pictures."""
    mesh = colour(join([obstacle.mesh for obstacle in scene.obstacles]), scene.views)
    write_mesh(folder / "obstacles.ply", mesh)
    write_glb(folder / "obstacles.glb", mesh)
    write_points(folder / "points.ply", surface_points(mesh) if len(mesh.faces) else _no_points())
    write_npz(folder / "volume.npz", _arrays(scene.regions))
    if len(mesh.faces):
        pictures = turntable(mesh, scene.ground, TURNTABLE_VIEWS)
        pair = len(pictures) // 2
        rows = [np.hstack(pictures[:pair]), np.hstack(pictures[pair:])]
        (folder / "turntable.png").write_bytes(png_bytes(np.vstack(rows)))
    evolved = [r for r in scene.regions if len(r.solution.frames)]
    if evolved:
        page = _evolution_page(evolved, mesh, scene.ground)
        (folder / "evolution.png").write_bytes(png_bytes(page))
        (folder / "terms.png").write_bytes(png_bytes(_terms_page(evolved[0])))


def _no_points() -> PointCloud:
    nothing = np.empty((0, 3))
    return PointCloud(nothing, nothing, nothing.astype(np.uint8))


def _arrays(regions: Sequence[SolvedRegion]) -> dict[str, NDArray[Any]]:
    """Name the arrays of all regions: the first has plain names."""
    if not regions:
        empty = np.zeros((0, 0, 0), np.float32)
        return {"u": empty, "origin": np.zeros(3), "spacing": np.ones(3)}
    arrays: dict[str, NDArray[Any]] = {}
    for k, region in enumerate(regions):
        end = f"_{k}" if k else ""
        arrays[f"u{end}"] = region.solution.u
        arrays[f"origin{end}"] = region.grid.origin
        arrays[f"spacing{end}"] = region.grid.spacing
    return arrays


def _evolution_page(regions: Sequence[SolvedRegion], last: Mesh, ground: GroundModel) -> Image:
    """Picture the surfaces of all regions at some moments of their evolution."""
    total = max(r.solution.iterations for r in regions)
    moments = [_moment(regions, share * total) for share in MOMENTS[:-1]]
    start = moments[0][0].vertices
    bounds = (start.min(axis=0), start.max(axis=0))
    shown = [(mesh, f"iteration {step} of {total}" if step else "start") for mesh, step in moments]
    shown.append((last, f"iteration {total}, the end"))
    pictures = [(sculpture(mesh, ground, bounds, PICTURE), text) for mesh, text in shown]
    return sheet(pictures, columns=2)


def _moment(regions: Sequence[SolvedRegion], wanted: float) -> tuple[Mesh, int]:
    """Give the surface of all regions near an iteration, and which one that is."""
    meshes, steps = [], []
    for grid, solution in ((r.grid, r.solution) for r in regions):
        k = nearest_frame(solution.frame_iterations, wanted)
        meshes.append(surface(*restored(solution.frames[k], grid)))
        steps.append(solution.frame_iterations[k])
    return join(meshes), max(steps)


def _terms_page(region: SolvedRegion) -> Image:
    """Picture the energy's weights in a layer, and how the surface's outline moved there."""
    solution, grid = region.solution, region.grid
    height = float(grid.origin[2] + solution.layer * grid.spacing[2])
    end = solution.u[:, :, solution.layer]
    f, (f_low, f_high) = layer_picture(solution.f, [end], LAYER_SIDE, signed=True)
    g, (g_low, g_high) = layer_picture(solution.g, [end], LAYER_SIDE, signed=False)
    moments = [
        nearest_frame(solution.frame_iterations, share * solution.iterations)
        for share in MOMENTS[:-1]
    ]
    outlines = []
    for k in moments:
        u, coarse = restored(solution.frames[k], grid)
        outlines.append(u[:, :, round(solution.layer * grid.spacing[2] / coarse.spacing[2])])
    path, _ = layer_picture(solution.f, [*outlines, end], LAYER_SIDE, signed=True)
    steps = [*(solution.frame_iterations[k] for k in moments), solution.iterations]
    key = [(f"{n} ", colour) for n, colour in zip(steps, line_colours(len(steps)), strict=True)]
    return sheet(
        [
            (f, f"f at z = {height:.2f} m: {f_low:.2f} (obstacle) to {f_high:.2f}"),
            (g, f"g: {g_low:.2f} (views agree) to {g_high:.2f}"),
            (path, [("surface at iterations ", BLACK), *key]),
        ],
        columns=3,
    )
