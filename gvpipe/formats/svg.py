"""Small SVG drawings: the same input gives the same bytes, and all text is escaped."""

from collections.abc import Iterable, Sequence
from html import escape

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

    Attributes of elements are keyword arguments; ``stroke_width`` becomes ``stroke-width``.

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

    def add(
        self,
        element: str,
        *,
        text: str | None = None,
        tooltip: str | None = None,
        **attributes: str | float,
    ) -> None:
        """Append one element; `text` is its content, `tooltip` shows on hovering."""
        written = "".join(
            f' {name.rstrip("_").replace("_", "-")}="'
            f'{escape(value) if isinstance(value, str) else number(value)}"'
            for name, value in attributes.items()
        )
        inside = "" if tooltip is None else f"<title>{escape(tooltip)}</title>"
        inside += "" if text is None else escape(text, quote=False)
        self._lines.append(
            f"<{element}{written}>{inside}</{element}>" if inside else f"<{element}{written}/>"
        )

    def line(self, start: Sequence[float], end: Sequence[float], **attributes: str | float) -> None:
        """Draw a straight line between two points."""
        self.add("line", x1=start[0], y1=start[1], x2=end[0], y2=end[1], **attributes)

    def polygon(
        self,
        points: Iterable[Sequence[float]],
        tooltip: str | None = None,
        **attributes: str | float,
    ) -> None:
        """Draw a closed polygon."""
        path = " ".join(f"{number(p[0])},{number(p[1])}" for p in points)
        self.add("polygon", tooltip=tooltip, points=path, **attributes)

    def text(self, at: Sequence[float], text: str, **attributes: str | float) -> None:
        """Write text whose baseline starts at a point."""
        self.add("text", text=text, x=at[0], y=at[1], **attributes)

    def to_svg(self) -> str:
        """Return the whole document, ending in a newline."""
        return "\n".join([*self._lines, "</svg>"]) + "\n"
