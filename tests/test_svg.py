from xml.etree import ElementTree

import numpy as np
import pytest

from gvpipe.formats.location_graph import GraphEdge, GraphNode, draw
from gvpipe.formats.svg import Drawing, number

SVG = "{http://www.w3.org/2000/svg}"


def node(image: str, x: float, y: float, component: int = 0, sigma: float = 0.01) -> GraphNode:
    robot = image.split("/")[0]
    covariance = np.diag([sigma**2, (2 * sigma) ** 2])
    return GraphNode(image, robot, image, component, x, y, 0.5, covariance)


def test_numbers_are_short_and_finite() -> None:
    assert [number(v) for v in (1.0, -0.001, 2.345678, 1e6, -3.5)] == [
        "1",
        "0",
        "2.35",
        "1000000",
        "-3.5",
    ]
    for bad in (float("nan"), float("inf")):
        with pytest.raises(ValueError, match="cannot be drawn"):
            number(bad)


def test_text_is_escaped_everywhere() -> None:
    nasty = "<script>\"&'"
    drawing = Drawing(10, 10, nasty)
    drawing.text((1, 2), nasty, {"fill": nasty})
    drawing.polygon([(0, 0), (1, 1)], {}, tooltip=nasty)
    root = ElementTree.fromstring(drawing.to_svg())
    assert root.findtext(f"{SVG}title") == nasty
    text = root.find(f"{SVG}text")
    assert text is not None
    assert text.text == nasty
    assert text.attrib["fill"] == nasty
    assert root.findtext(f"{SVG}polygon/{SVG}title") == nasty


def test_the_graph_is_to_scale() -> None:
    nodes = [node("A/0", 0, 0), node("A/1", 2, 0), node("A/2", 2, 1), node("B/0", 0, 1)]
    edges = [
        GraphEdge("A/0", "A/1", "odometry"),
        GraphEdge("A/1", "A/2", "loop"),
        GraphEdge("A/2", "B/0", "overlap"),
    ]
    root = ElementTree.fromstring(draw(nodes, edges))
    lines = root.findall(f"{SVG}line")
    by_colour = {line.attrib["stroke"]: line.attrib for line in lines}
    spans = {
        colour: np.hypot(
            float(line["x2"]) - float(line["x1"]), float(line["y2"]) - float(line["y1"])
        )
        for colour, line in {x.attrib["stroke"]: x.attrib for x in reversed(lines)}.items()
    }
    assert spans["#777777"] == pytest.approx(2 * spans["#d55e00"], abs=0.05)
    assert spans["#777777"] == pytest.approx(spans["#0072b2"], abs=0.05)
    # x to the right, y up
    assert float(by_colour["#d55e00"]["x1"]) > 0
    loop = next(x.attrib for x in lines if x.attrib["stroke"] == "#d55e00")
    assert float(loop["y2"]) < float(loop["y1"])
    written = {text.text for text in root.findall(f"{SVG}text")}
    assert {"A/0", "B/0", "robot A", "robot B", "loop", "overlap"} <= written
    assert any(text and text.endswith(" m") for text in written)
    assert len(root.findall(f"{SVG}ellipse")) == len(nodes) + 1


def test_the_same_graph_gives_the_same_bytes() -> None:
    nodes = [node("A/0", 0, 0), node("A/1", 1, 0), node("B/0", 0, 0, 1), node("B/1", 0, 2, 1)]
    edges = [GraphEdge("A/0", "A/1", "odometry"), GraphEdge("B/0", "B/1", "odometry")]
    assert draw(nodes, edges) == draw(nodes, edges)


def test_components_do_not_overlap() -> None:
    nodes = [node("A/0", 0, 0), node("A/1", 1, 0), node("B/0", 0, 0, 1), node("B/1", 1, 0, 1)]
    root = ElementTree.fromstring(draw(nodes, []))
    arrows = [p.attrib["points"].split() for p in root.findall(f"{SVG}polygon") if len(p)]
    lefts = [float(points[0].split(",")[0]) for points in arrows]
    assert len(arrows) == 4
    assert max(lefts[:2]) < min(lefts[2:])


def test_one_image_without_uncertainty_can_be_drawn() -> None:
    root = ElementTree.fromstring(draw([node("A/0", 0, 0, sigma=0.0)], []))
    assert len([p for p in root.findall(f"{SVG}polygon") if len(p)]) == 1


def test_impossible_graphs_are_errors() -> None:
    with pytest.raises(ValueError, match="at least one"):
        draw([], [])
    with pytest.raises(ValueError, match="has no node"):
        draw([node("A/0", 0, 0)], [GraphEdge("A/0", "A/1", "loop")])
