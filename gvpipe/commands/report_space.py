"""The report's view in space: ground, obstacles and cameras, as plotly reads them."""

from collections.abc import Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

from gvpipe.artefacts import Artefact
from gvpipe.commands.report_figures import Json, array, figure, pose_text
from gvpipe.commands.report_pictures import ground_grid
from gvpipe.core.reconstruct.mesh import Mesh
from gvpipe.core.types import Float, Image
from gvpipe.formats.plots import COLOURS
from gvpipe.records import MosaicBody, PoseRow, SlamBody

MOST_VERTICES = 40_000
"""A finer surface of the obstacles is thinned to about this many vertices."""


def scene_figure(
    name: str,
    slam: SlamBody,
    component: int,
    mosaic: Artefact[MosaicBody] | None,
    mesh: Mesh | None,
) -> Json:
    """Draw obstacles, ground and cameras in space."""
    traces: list[Json] = []
    if mosaic is not None:
        part = mosaic.body
        flat, colours, faces = ground_grid(mosaic.folder / "mosaic.png", part.map_from_pixel)
        vertices = np.column_stack([flat, np.zeros(len(flat))])
        traces.append(_surface("ground", vertices, faces, colours, ambient=1.0))
    if mesh is not None and len(mesh.faces):
        thin = thinned(mesh)
        traces.append(_surface("obstacles", thin.vertices, thin.faces, thin.colours, ambient=0.75))
    poses = [row for row in slam.poses if row.component == component]
    size = 0.2 * float(np.median([row.height_m for row in poses])) if poses else 0.1
    for k, robot in enumerate(dict.fromkeys(row.robot for row in poses)):
        rows = [row for row in poses if row.robot == robot]
        traces += _cameras(robot, rows, size, COLOURS[k % len(COLOURS)])
    eye: Json = {"eye": {"x": -0.95, "y": -0.95, "z": 0.75}}
    axes: Json = {f"{a}axis": {"title": {"text": f"{a}, m"}} for a in "xyz"}
    scene: Json = {"aspectmode": "data", "camera": eye, **axes}
    return figure(name, traces, {"scene": scene, "margin": {"l": 0, "r": 0, "t": 36, "b": 0}})


def thinned(mesh: Mesh) -> Mesh:
    """Join vertices that lie in one cell of a grid, if there are more than can be sent."""
    if len(mesh.vertices) <= MOST_VERTICES:
        return mesh
    # a surface crosses cells in proportion to their area
    edges = mesh.vertices[mesh.faces[:, 0]] - mesh.vertices[mesh.faces[:, 1]]
    step = float(np.median(np.linalg.norm(edges, axis=1)))
    step *= 1.3 * np.sqrt(len(mesh.vertices) / MOST_VERTICES)
    cells = np.floor((mesh.vertices - mesh.vertices.min(axis=0)) / step).astype(np.int64)
    _, first, cell = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    faces = cell.ravel()[mesh.faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (a != c)]
    return Mesh(mesh.vertices[first], faces, mesh.normals[first], mesh.colours[first])


def _surface(
    name: str,
    vertices: Float,
    faces: NDArray[np.integer],
    colours: Image,
    ambient: float,
) -> Json:
    """Draw coloured triangles."""
    lighting = {"ambient": ambient, "diffuse": 1 - ambient, "specular": 0.02, "roughness": 0.9}
    trace: Json = {"type": "mesh3d", "name": name, "showlegend": True, "hoverinfo": "skip"}
    trace |= {axis: array(vertices[:, k]) for k, axis in enumerate("xyz")}
    corners = np.asarray(faces, dtype=np.int32)
    trace |= {corner: array(corners[:, k], "i4") for k, corner in enumerate("ijk")}
    trace["vertexcolor"] = [f"#{r:02x}{g:02x}{b:02x}" for r, g, b in colours.tolist()]
    trace["lighting"] = lighting
    return trace


def _cameras(robot: str, rows: Sequence[PoseRow], size: float, colour: str) -> list[Json]:
    """Draw the cameras of one robot as pyramids, with its way from one to the next."""
    corners = size * np.array([[-0.6, -0.45, 1], [0.6, -0.45, 1], [0.6, 0.45, 1], [-0.6, 0.45, 1]])
    lines: list[list[float | None]] = [[], [], []]
    for row in rows:
        tips = corners @ row.R.T + row.t
        order = [row.t, tips[0], tips[1], row.t, tips[2], tips[3], row.t, tips[3], tips[0]]
        order += [tips[1], tips[2]]
        for axis in range(3):
            lines[axis] += [round(float(point[axis]), 4) for point in order]
            lines[axis].append(None)
    group: Json = {"type": "scatter3d", "legendgroup": robot, "name": escape(robot)}
    pyramids: Json = {**group, "mode": "lines", "line": {"color": colour, "width": 2}}
    pyramids |= {"x": lines[0], "y": lines[1], "z": lines[2], "hoverinfo": "skip"}
    places = np.array([row.t for row in rows])
    points: Json = {**group, "mode": "markers+lines", "showlegend": False, "hoverinfo": "text"}
    points |= {"marker": {"color": colour, "size": 3}, "line": {"color": colour, "width": 1}}
    points |= {axis: array(places[:, k]) for k, axis in enumerate("xyz")}
    points["text"] = [pose_text(row) for row in rows]
    return [pyramids, points]
