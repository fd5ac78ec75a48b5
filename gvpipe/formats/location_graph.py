"""The location graph drawn to scale: where each picture was taken and what links them."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from gvpipe.core.types import Float
from gvpipe.formats.svg import Drawing, Point, Style, number

SIZE_PX = 900.0
"""Longer side of the space for the graph."""

MARGIN_PX = 70.0
"""Space around the graph, enough for axes and labels."""

LEGEND_PX = 190.0
"""Width of the legend."""

CONFIDENCE_95 = 2.4477
"""Deviations that hold 95 % of a two-dimensional Gaussian: sqrt(-2 ln 0.05)."""

ELLIPSE_PX = 26.0
"""Largest half axis an uncertainty ellipse may have on paper."""

EDGE_STYLES: dict[str, Style] = {
    "odometry": {"stroke": "#777777", "stroke-width": 1.6},
    "loop": {"stroke": "#d55e00", "stroke-width": 1.8, "stroke-dasharray": "6 3"},
    "overlap": {"stroke": "#0072b2", "stroke-width": 1.8, "stroke-dasharray": "2 3"},
}
"""How each kind of link is drawn, colours that colour-blind readers tell apart (Okabe, Ito)."""

ROBOT_COLOURS = ("#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#882255", "#44aa99", "#999933")

LABEL_PX = 10.0
"""Height of image labels."""

CELL_PX = 20.0
"""Side of the cells in which labels look for others that are in the way."""

Box = tuple[float, float, float, float]
"""Left, top, right and bottom."""


@dataclass(frozen=True)
class GraphNode:
    """An image in the graph.

    Attributes
    ----------
    image, robot, label : str
        Image id, its robot, and the short name written beside it.
    component : int
        Maps that are not connected are drawn beside each other.
    x, y, yaw : float
        Position (metres) and heading (radians) in the map.
    covariance : (2, 2) float64
        Of the position, square metres.
    """

    image: str
    robot: str
    label: str
    component: int
    x: float
    y: float
    yaw: float
    covariance: Float


@dataclass(frozen=True)
class GraphEdge:
    """A link between two images, by their ids, of a kind in ``EDGE_STYLES``."""

    image_i: str
    image_j: str
    kind: str


def draw(nodes: Sequence[GraphNode], edges: Sequence[GraphEdge]) -> str:
    """Draw the location graph.

    Parameters
    ----------
    nodes : sequence of GraphNode
        Registered images, at least one.
    edges : sequence of GraphEdge
        Links between them.

    Returns
    -------
    svg : str
        The picture, x to the right and y up, with a scale bar and a legend.

    Raises
    ------
    ValueError
        If there are no nodes, or an edge names an image that is not among them.
    """
    if not nodes:
        raise ValueError("a location graph needs at least one image")
    sheet = _Sheet(nodes)
    drawing = Drawing(sheet.width + LEGEND_PX, sheet.height, "Location graph")
    drawing.add("rect", {"width": drawing.width, "height": drawing.height, "fill": "#ffffff"})
    sheet.draw_axes(drawing)
    at = {node.image: sheet.at(node) for node in nodes}
    for edge in edges:
        if edge.image_i not in at or edge.image_j not in at:
            raise ValueError(f"edge {edge.image_i} - {edge.image_j} has no node")
        drawing.line(at[edge.image_i], at[edge.image_j], EDGE_STYLES[edge.kind])
    robots = list(dict.fromkeys(node.robot for node in nodes))
    colours = {r: ROBOT_COLOURS[k % len(ROBOT_COLOURS)] for k, r in enumerate(robots)}
    enlarged = _enlargement(nodes, sheet.scale)
    for node in nodes:
        _draw_ellipse(drawing, node, at[node.image], sheet.scale * enlarged, colours[node.robot])
    for node in nodes:
        _draw_camera(drawing, node, at[node.image], colours[node.robot])
    _draw_labels(drawing, nodes, at)
    kinds = [kind for kind in EDGE_STYLES if any(edge.kind == kind for edge in edges)]
    _draw_legend(drawing, sheet, colours, kinds, enlarged)
    return drawing.to_svg()


class _Sheet:
    """Where metres go on the paper; components stand side by side at one scale."""

    def __init__(self, nodes: Sequence[GraphNode]) -> None:
        self._boxes: dict[int, tuple[Float, Float]] = {}
        for component in dict.fromkeys(n.component for n in nodes):
            xy = np.array([(n.x, n.y) for n in nodes if n.component == component])
            # the frame's origin, the reference image, is in every component
            xy = np.vstack([xy, [0.0, 0.0]])
            self._boxes[component] = xy.min(axis=0), xy.max(axis=0)
        spans = np.array([high - low for low, high in self._boxes.values()])
        gaps = MARGIN_PX * (len(spans) - 1)
        longest = max(float(spans[:, 0].sum()), float(spans[:, 1].max()))
        self.scale = (SIZE_PX - min(gaps, SIZE_PX / 2)) / longest if longest > 1e-9 else SIZE_PX
        self._left, left = {}, MARGIN_PX
        for component, span in zip(self._boxes, spans, strict=True):
            self._left[component] = left
            left += float(span[0]) * self.scale + MARGIN_PX
        self.width = left
        self.height = max(float(spans[:, 1].max()) * self.scale + 2 * MARGIN_PX, 320.0)

    def at(self, node: GraphNode) -> Point:
        """Paper position of a node."""
        return self.place(node.component, node.x, node.y)

    def place(self, component: int, x: float, y: float) -> Point:
        """Paper position of a point of a component's map."""
        low, high = self._boxes[component]
        middle = (self.height - (high[1] - low[1]) * self.scale) / 2.0
        return (
            self._left[component] + (x - float(low[0])) * self.scale,
            middle + (float(high[1]) - y) * self.scale,
        )

    def draw_axes(self, drawing: Drawing) -> None:
        """Axes of each component's map frame, at its origin."""
        for component in self._boxes:
            origin = self.place(component, 0.0, 0.0)
            for name, dx, dy in (("x", 1.0, 0.0), ("y", 0.0, -1.0)):
                tip = (origin[0] + 42.0 * dx, origin[1] + 42.0 * dy)
                drawing.line(origin, tip, {"stroke": "#bbbbbb", "stroke-width": 1.2})
                wing = [(tip[0] + 7 * dx, tip[1] + 7 * dy)] + [
                    (tip[0] + 3 * side * dy, tip[1] + 3 * side * dx) for side in (-1, 1)
                ]
                drawing.polygon(wing, {"fill": "#bbbbbb"})
                label = (tip[0] + 12 * dx - 3 * abs(dy), tip[1] + 12 * dy + 3 * abs(dx))
                drawing.text(label, name, {"font-size": 11.0, "fill": "#999999"})


def _enlargement(nodes: Sequence[GraphNode], scale: float) -> float:
    """Round factor (1, 2, 5, 10, ...) by which the ellipses are drawn larger than true."""
    largest = max(float(np.linalg.eigvalsh(n.covariance)[-1]) for n in nodes)
    half_axis = CONFIDENCE_95 * np.sqrt(max(largest, 0.0)) * scale
    return _round_down(ELLIPSE_PX / half_axis) if 0 < half_axis < ELLIPSE_PX else 1.0


def _round_down(value: float) -> float:
    """Largest of 1, 2, 5 times a power of ten that is not above a positive value."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(
        max(step for step in (1.0, 2.0, 5.0) if step * power <= value * (1 + 1e-9)) * power
    )


def _draw_ellipse(drawing: Drawing, node: GraphNode, at: Point, scale: float, colour: str) -> None:
    """Ellipse that holds 95 % of a position, `scale` pixels to the metre."""
    values, vectors = np.linalg.eigh(node.covariance)
    if values[1] <= 0:
        return
    half = CONFIDENCE_95 * np.sqrt(np.maximum(values, 0.0)) * scale
    angle = -np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1]))
    drawing.add(
        "ellipse",
        {
            "cx": at[0],
            "cy": at[1],
            "rx": float(half[1]),
            "ry": float(half[0]),
            "transform": f"rotate({number(angle)} {number(at[0])} {number(at[1])})",
            "fill": colour,
            "fill-opacity": 0.15,
            "stroke": colour,
            "stroke-opacity": 0.6,
            "stroke-width": 0.8,
        },
    )


def _draw_camera(drawing: Drawing, node: GraphNode, at: Point, colour: str) -> None:
    """Arrow head at the position, pointing where the camera looks."""
    c, s = np.cos(node.yaw), -np.sin(node.yaw)
    outline = [(11.0, 0.0), (-5.0, 5.5), (-2.0, 0.0), (-5.0, -5.5)]
    drawing.polygon(
        [(at[0] + c * x - s * y, at[1] + s * x + c * y) for x, y in outline],
        {"fill": colour, "stroke": "#ffffff", "stroke-width": 0.6},
        tooltip=f"{node.image}: x {node.x:.3f} m, y {node.y:.3f} m, "
        f"heading {np.degrees(node.yaw):.1f} deg",
    )


def _draw_labels(drawing: Drawing, nodes: Sequence[GraphNode], at: dict[str, Point]) -> None:
    """Write each label at the first free place around its image; leave out what does not fit."""
    taken: dict[tuple[int, int], list[Box]] = {}
    for x, y in at.values():
        _take((x - 6.0, y - 6.0, x + 6.0, y + 6.0), taken)
    for node in nodes:
        x, y = at[node.image]
        width = 0.6 * LABEL_PX * len(node.label)
        for turn in (90, -90, 180, 135, -135, 45, -45, 0):
            angle = -node.yaw + np.radians(turn)
            cx = x + np.cos(angle) * (12.0 + width / 2)
            cy = y + np.sin(angle) * (8.0 + LABEL_PX / 2)
            box = (cx - width / 2, cy - LABEL_PX / 2, cx + width / 2, cy + LABEL_PX / 2)
            near = (other for cell in _cells(box) for other in taken.get(cell, ()))
            if not any(_cross(box, other) for other in near):
                _take(box, taken)
                drawing.text(
                    (cx, cy + 0.35 * LABEL_PX),
                    node.label,
                    {"font-size": LABEL_PX, "fill": "#333333", "text-anchor": "middle"},
                )
                break


def _take(box: Box, taken: dict[tuple[int, int], list[Box]]) -> None:
    """Note a box in every cell that it touches."""
    for cell in _cells(box):
        taken.setdefault(cell, []).append(box)


def _cells(box: Box) -> Iterator[tuple[int, int]]:
    """Cells of a square grid that a box touches."""
    left, top, right, bottom = (int(side // CELL_PX) for side in box)
    return itertools.product(range(left, right + 1), range(top, bottom + 1))


def _cross(a: Box, b: Box) -> bool:
    """Whether two boxes overlap."""
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def _draw_legend(
    drawing: Drawing,
    sheet: _Sheet,
    colours: dict[str, str],
    kinds: Sequence[str],
    enlarged: float,
) -> None:
    """Robots, kinds of links, ellipses and the scale bar, down the right side."""
    x, y = sheet.width, MARGIN_PX
    style: Style = {"font-size": 12.0, "fill": "#333333"}
    bar: Style = {"stroke": "#333333", "stroke-width": 2.0}
    for robot, colour in colours.items():
        arrow = [(x + 18, y), (x + 4, y + 5), (x + 7, y), (x + 4, y - 5)]
        drawing.polygon(arrow, {"fill": colour})
        drawing.text((x + 34, y + 4), f"robot {robot}", style)
        y += 20.0
    for kind in kinds:
        drawing.line((x, y), (x + 26, y), EDGE_STYLES[kind])
        drawing.text((x + 34, y + 4), kind, style)
        y += 20.0
    size: Style = {"cx": x + 13, "cy": y, "rx": 12.0, "ry": 6.0}
    drawing.add("ellipse", {**size, "fill": "#999999", "fill-opacity": 0.2})
    drawing.text((x + 34, y + 4), "95 % of position", style)
    if enlarged != 1:
        y += 15.0
        drawing.text((x + 34, y + 4), f"{enlarged:g} times enlarged", style)
    y += 36.0
    length = _round_down(140.0 / sheet.scale)
    end = x + length * sheet.scale
    drawing.line((x, y), (end, y), bar)
    for tick in (x, end):
        drawing.line((tick, y - 4), (tick, y + 4), bar)
    drawing.text((x, y + 18), f"{length:g} m", style)
