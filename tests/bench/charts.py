"""Small diagrams of the benches as SVG: lines and dots over linear or logarithmic axes."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, floor, log10

import numpy as np

from gvpipe.core.types import Float
from gvpipe.formats.plots import COLOURS
from gvpipe.formats.svg import Drawing, Point, Style

WIDTH, HEIGHT = 300.0, 250.0
LEFT, RIGHT, TOP, BOTTOM = 46.0, 14.0, 30.0, 40.0


@dataclass(frozen=True)
class Curve:
    """Values over places.

    Attributes
    ----------
    name : str
        For the legend.
    x, y : (n,) float64
    colour : int
        Number of one of ``gvpipe.formats.plots.COLOURS``.
    look : str
        "line", "pale" (a thin line) or "dots".
    """

    name: str
    x: Float
    y: Float
    colour: int = 0
    look: str = "line"


@dataclass(frozen=True)
class Panel:
    """One diagram.

    Attributes
    ----------
    title, x_label : str
    x_range, y_range : (float, float)
        Ends of the axes.
    curves : sequence of Curve
    log : bool
        Whether both axes are logarithmic.
    low_legend : bool
        Whether the names stand below, where curves that rise leave room.
    """

    title: str
    x_label: str
    x_range: tuple[float, float]
    y_range: tuple[float, float]
    curves: Sequence[Curve]
    log: bool = False
    low_legend: bool = False


def ticks(low: float, high: float, log: bool) -> Float:
    """Round numbers within a range: decades, or some five steps of 1, 2 or 5."""
    if log:
        marks = np.outer(10.0 ** np.arange(floor(log10(low)), ceil(log10(high)) + 1), [1, 3])
        return np.array([m for m in marks.ravel() if low <= m * 1.0001 and m <= high * 1.0001])
    step = 10.0 ** floor(log10(high - low))
    step *= next(s for s in (0.1, 0.2, 0.5, 1.0, 2.0) if (high - low) / (s * step) <= 6)
    return np.arange(ceil(low / step), floor(high / step + 1e-9) + 1) * step


def draw(title: str, panels: Sequence[Panel]) -> str:
    """Draw panels beside each other."""
    drawing = Drawing(WIDTH * len(panels), HEIGHT, title)
    size: Style = {"width": drawing.width, "height": HEIGHT}
    drawing.add("rect", {"x": 0, "y": 0, **size, "fill": "white"})
    for k, panel in enumerate(panels):
        _panel(drawing, panel, k * WIDTH)
    return drawing.to_svg()


def _panel(drawing: Drawing, panel: Panel, left: float) -> None:
    scale = np.log10 if panel.log else np.asarray
    (x0, x1), (y0, y1) = scale(panel.x_range), scale(panel.y_range)
    across, high = WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM

    def at(x: float, y: float) -> Point:
        share = (float(scale(x)) - x0) / (x1 - x0), (float(scale(y)) - y0) / (y1 - y0)
        return left + LEFT + share[0] * across, HEIGHT - BOTTOM - share[1] * high

    grey: Style = {"stroke": "#dddddd", "stroke-width": 1}
    small: Style = {"font-size": 10, "fill": "#444444"}
    for x in ticks(*panel.x_range, panel.log):
        drawing.line(at(x, panel.y_range[0]), at(x, panel.y_range[1]), grey)
        u, v = at(x, panel.y_range[0])
        drawing.text((u, v + 14), f"{x:g}", {**small, "text-anchor": "middle"})
    for y in ticks(*panel.y_range, panel.log):
        drawing.line(at(panel.x_range[0], y), at(panel.x_range[1], y), grey)
        u, v = at(panel.x_range[0], y)
        drawing.text((u - 4, v + 4), f"{y:g}", {**small, "text-anchor": "end"})
    drawing.text((left + LEFT, 18), panel.title, {"font-size": 12})
    label: Style = {"font-size": 11, "text-anchor": "middle"}
    drawing.text((left + LEFT + across / 2, HEIGHT - 8), panel.x_label, label)
    row = HEIGHT - BOTTOM - 13.0 * len(panel.curves) if panel.low_legend else TOP + 12.0
    indent = 0.35 * across if panel.low_legend else 8.0
    for curve in panel.curves:
        colour = COLOURS[curve.colour % len(COLOURS)]
        shown = (curve.x >= panel.x_range[0]) & (curve.x <= panel.x_range[1])
        shown &= (curve.y >= panel.y_range[0]) & (curve.y <= panel.y_range[1])
        points = [at(x, y) for x, y in zip(curve.x[shown], curve.y[shown], strict=True)]
        _curve(drawing, points, curve, colour)
        drawing.text((left + LEFT + indent, row), curve.name, {"font-size": 10, "fill": colour})
        row += 13.0


def _curve(drawing: Drawing, points: list[Point], curve: Curve, colour: str) -> None:
    if curve.look == "dots":
        for u, v in points:
            drawing.add("circle", {"cx": u, "cy": v, "r": 3, "fill": colour})
        return
    thin = curve.look == "pale"
    style: Style = {"fill": "none", "stroke": colour, "stroke-width": 1.0 if thin else 2.0}
    path = " ".join(f"{u:.1f},{v:.1f}" for u, v in points)
    drawing.add("polyline", {"points": path, **style, "stroke-opacity": 0.6 if thin else 1.0})
