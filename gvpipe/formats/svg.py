"""Small SVG drawings: the same input gives the same bytes, and all text is escaped."""

from collections.abc import Iterable, Mapping
from html import escape

Style = Mapping[str, str | float]
"""SVG attributes; numbers are written by :func:`number`."""

Point = tuple[float, float]
"""Position in pixels, x right and y down."""

DECIMALS = 2
"""Digits kept of coordinates: a hundredth of a pixel."""


def number(value: float) -> str:
    """Shortest text of a coordinate, without a negative zero or an exponent.

    Raises
    ------
    ValueError
        If it is not finite.
    """
    rounded = round(float(value), DECIMALS)
    if not abs(rounded) < float("inf"):
        raise ValueError(f"{value} cannot be drawn")
    return f"{rounded + 0.0:.{DECIMALS}f}".rstrip("0").rstrip(".")


class Drawing:
    """An SVG picture that grows element by element, later ones on top.

    Parameters
    ----------
    width, height : float
        Size in pixels; the origin is the upper left corner, y points down.
    title : str
        What the picture shows, for screen readers and tooltips.
    """

    def __init__(self, width: float, height: float, title: str) -> None:
        self.width, self.height = width, height
        self._lines = [
            '<svg xmlns="http://www.w3.org/2000/svg" '
            f'width="{number(width)}" height="{number(height)}" '
            f'viewBox="0 0 {number(width)} {number(height)}" '
            'font-family="Helvetica, Arial, sans-serif">',
            f"<title>{escape(title)}</title>",
        ]

    def add(self, element: str, attributes: Style, *, text: str = "", tooltip: str = "") -> None:
        """Append one element; `text` is its content, `tooltip` shows on hovering."""
        written = "".join(
            f' {name}="{escape(value) if isinstance(value, str) else number(value)}"'
            for name, value in attributes.items()
        )
        inside = f"<title>{escape(tooltip)}</title>" if tooltip else ""
        inside += escape(text, quote=False)
        self._lines.append(
            f"<{element}{written}>{inside}</{element}>" if inside else f"<{element}{written}/>"
        )

    def line(self, start: Point, end: Point, style: Style) -> None:
        """Draw a straight line between two points."""
        ends = {"x1": start[0], "y1": start[1], "x2": end[0], "y2": end[1]}
        self.add("line", {**ends, **style})

    def polygon(self, points: Iterable[Point], style: Style, *, tooltip: str = "") -> None:
        """Draw a closed polygon."""
        path = " ".join(f"{number(x)},{number(y)}" for x, y in points)
        self.add("polygon", {"points": path, **style}, tooltip=tooltip)

    def text(self, at: Point, text: str, style: Style) -> None:
        """Write text whose baseline starts at a point."""
        self.add("text", {"x": at[0], "y": at[1], **style}, text=text)

    def to_svg(self) -> str:
        """Return the whole document, ending in a newline."""
        return "\n".join([*self._lines, "</svg>"]) + "\n"
