"""The report's interactive diagrams, as plotly reads them."""

import base64
from collections.abc import Iterable, Sequence
from html import escape
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from gvpipe.artefacts import Artefact
from gvpipe.commands.report_pictures import picture
from gvpipe.formats.plots import COLOURS
from gvpipe.records import (
    MosaicBody,
    MosaicPart,
    ObstacleRow,
    OverlapRow,
    PoseRow,
    ReconstructBody,
    SlamBody,
)

Json: TypeAlias = dict[str, object]

EDGE_STYLE = {"odometry": "#cfd8dc", "loop": "#ffd24d", "overlap": "#ff6f91"}
"""Colours of the location graph's edges over photographs of ground."""

MARK_SHARE = 0.02
"""Room round a camera's arrow, as a share of the map's width."""

LEGEND: Json = {"orientation": "h", "y": 1.02, "yanchor": "bottom"}


def figure(name: str, traces: Sequence[Json], layout: Json) -> Json:
    """Join a diagram with the place it is drawn at."""
    base: Json = {"margin": {"l": 56, "r": 16, "t": 36, "b": 44}, "legend": LEGEND}
    return {"id": name, "data": list(traces), "layout": {**base, **layout}}


def map_figure(
    name: str,
    part: MosaicPart,
    mosaic: Artefact[MosaicBody],
    slam: SlamBody,
    obstacles: Iterable[ObstacleRow],
) -> Json:
    """Draw the location graph of one component over its overhead map."""
    poses = [row for row in slam.poses if row.component == part.component]
    step_x, step_y = part.map_from_pixel[0, 0], part.map_from_pixel[1, 1]
    left = part.map_from_pixel[0, 2] - step_x / 2
    top = part.map_from_pixel[1, 2] - step_y / 2
    image: Json = {
        "source": picture(mosaic.folder / f"mosaic{part.suffix}.png"),
        "xref": "x",
        "yref": "y",
        "x": left,
        "y": top,
        "sizex": part.width * step_x,
        "sizey": -part.height * step_y,
        "sizing": "stretch",
        "layer": "below",
    }
    traces = [_footprint(row, k == 0) for k, row in enumerate(obstacles)]
    traces += _edges(slam, {row.image: row for row in poses})
    traces += _robots(poses)
    plain: Json = {"showgrid": False, "zeroline": False, "constrain": "domain"}
    # cameras that look ahead stand outside the ground they see
    held = MARK_SHARE * part.width * step_x
    xs = [left, left + part.width * step_x, *(row.x + s for row in poses for s in (-held, held))]
    ys = [top + part.height * step_y, top, *(row.y + s for row in poses for s in (-held, held))]
    across: Json = {**plain, "title": {"text": "x, m"}, "range": [min(xs), max(xs)]}
    up: Json = {**plain, "title": {"text": "y, m"}, "range": [min(ys), max(ys)]}
    up["scaleanchor"] = "x"
    layout: Json = {"images": [image], "xaxis": across, "yaxis": up, "dragmode": "pan"}
    layout["hovermode"] = "closest"
    return figure(name, traces, layout)


def _footprint(row: ObstacleRow, first: bool) -> Json:
    outline = np.vstack([row.footprint, row.footprint[:1]])
    return {
        "type": "scatter",
        "mode": "lines",
        "x": array(outline[:, 0]),
        "y": array(outline[:, 1]),
        "fill": "toself",
        "fillcolor": "rgba(214,94,0,.35)",
        "line": {"color": "#d65e00", "width": 2},
        "name": "obstacles",
        "legendgroup": "obstacles",
        "showlegend": first,
        "hoveron": "fills",
        "text": f"obstacle {row.id}: {row.height_m:.2f} m high",
        "hoverinfo": "text",
    }


def _edges(slam: SlamBody, poses: dict[str, PoseRow]) -> list[Json]:
    """Draw each kind of edge as one broken line, with its residuals halfway."""
    traces: list[Json] = []
    for kind, colour in EDGE_STYLE.items():
        rows = [e for e in slam.edges if e.kind == kind and {e.image_i, e.image_j} <= poses.keys()]
        ends = [(poses[e.image_i], poses[e.image_j]) for e in rows]
        if not rows:
            continue
        line: Json = {"color": colour, "width": 2 if kind == "odometry" else 1}
        line["dash"] = "solid" if kind == "odometry" else "dot"
        common: Json = {"type": "scatter", "legendgroup": kind, "name": f"{kind} ({len(rows)})"}
        traces.append(
            {
                **common,
                "mode": "lines",
                "line": line,
                "opacity": 1.0 if kind == "odometry" else 0.6,
                "x": [value for a, b in ends for value in (a.x, b.x, None)],
                "y": [value for a, b in ends for value in (a.y, b.y, None)],
                "hoverinfo": "skip",
            }
        )
        traces.append(
            {
                **common,
                "mode": "markers",
                "showlegend": False,
                "marker": {"color": colour, "size": 4},
                "x": [(a.x + b.x) / 2 for a, b in ends],
                "y": [(a.y + b.y) / 2 for a, b in ends],
                "text": [
                    f"{kind}: {escape(e.image_i)} to {escape(e.image_j)}"
                    f"<br>residual {1000 * e.residual_m:.2f} mm"
                    for e in rows
                ],
                "hoverinfo": "text",
            }
        )
    return traces


def _robots(poses: Sequence[PoseRow]) -> list[Json]:
    """Draw every camera as an arrow that looks where it looks."""
    traces: list[Json] = []
    for k, robot in enumerate(dict.fromkeys(row.robot for row in poses)):
        rows = [row for row in poses if row.robot == robot]
        traces.append(
            {
                "type": "scatter",
                "mode": "markers",
                "name": escape(robot),
                "x": [row.x for row in rows],
                "y": [row.y for row in rows],
                "marker": {
                    "symbol": "arrow",
                    "angle": [90 - row.yaw_deg for row in rows],
                    "size": 15,
                    "color": COLOURS[k % len(COLOURS)],
                    "line": {"color": "white", "width": 1.2},
                },
                "text": [pose_text(row) for row in rows],
                "hoverinfo": "text",
            }
        )
    return traces


def pose_text(row: PoseRow) -> str:
    """Say where a camera is and how sure that is."""
    sigma = 1000 * float(np.sqrt(max(np.trace(row.covariance[3:5, 3:5]), 0.0)))
    return (
        f"{escape(row.image)}<br>x {row.x:.3f} m, y {row.y:.3f} m, ± {sigma:.1f} mm"
        f"<br>yaw {row.yaw_deg:.1f}°, tilt {row.tilt_deg:.2f}°, roll {row.roll_deg:.2f}°"
        f"<br>height {row.height_m:.3f} m"
    )


def overlap_figure(
    name: str, row: OverlapRow, distances: NDArray[np.floating], ids: tuple[list[str], list[str]]
) -> Json:
    """Draw the histogram distances of two robots' pictures, validated pairs ringed."""
    names = [[escape(image) for image in robot] for robot in ids]
    where = ({image: k for k, image in enumerate(robot)} for robot in ids)
    place_i, place_j = where
    valid = [c for c in row.candidates if c.validated]
    heat: Json = {
        "type": "heatmap",
        "z": np.round(np.asarray(distances, np.float64), 4).tolist(),
        "colorscale": "Viridis",
        "colorbar": {"title": {"text": "distance"}, "thickness": 14},
        "text": [[f"{i}<br>{j}" for j in names[1]] for i in names[0]],
        "hovertemplate": "%{text}<br>distance %{z:.3f}<extra></extra>",
    }
    rings: Json = {
        "type": "scatter",
        "mode": "markers",
        "name": f"validated ({len(valid)})",
        "x": [place_j[c.image_j] for c in valid],
        "y": [place_i[c.image_i] for c in valid],
        "marker": {"symbol": "circle-open", "size": 12, "color": "#fff", "line": {"width": 2.5}},
        "text": [f"{escape(c.image_i)}, {escape(c.image_j)}: {c.inliers} inliers" for c in valid],
        "hoverinfo": "text",
    }
    first, second = (escape(robot) for robot in row.robots)
    across: Json = {"title": {"text": f"picture of {second}"}, "constrain": "domain"}
    down: Json = {"title": {"text": f"picture of {first}"}, "autorange": "reversed"}
    return figure(name, [heat, rings], {"xaxis": across, "yaxis": down, "hovermode": "closest"})


def energy_figure(name: str, body: ReconstructBody) -> Json:
    """Draw the energy of the evolution."""
    trace: Json = {
        "type": "scatter",
        "mode": "lines+markers",
        "x": [step for step, _ in body.energy],
        "y": [energy for _, energy in body.energy],
        "line": {"color": COLOURS[0], "width": 2},
        "marker": {"size": 4},
        "name": "energy",
    }
    axes: Json = {"xaxis": {"title": {"text": "iteration"}}, "yaxis": {"title": {"text": "energy"}}}
    return figure(name, [trace], axes)


def array(values: NDArray[np.generic], kind: str = "f4") -> Json:
    """Pack numbers as plotly's typed array."""
    raw = np.ascontiguousarray(values, dtype=f"<{kind}").tobytes()
    return {"dtype": kind, "bdata": base64.b64encode(raw).decode("ascii")}
