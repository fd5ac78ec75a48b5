"""Pieces of HTML; every text that comes from outside is escaped here."""

from collections.abc import Iterable, Sequence
from html import escape
from math import floor, log10


def text(value: object) -> str:
    """Escape a text for HTML, inside an element or an attribute."""
    return escape(str(value), quote=True)


def missing(message: str) -> str:
    """Say that something is not there, and what makes it; commands stand in backquotes."""
    parts = text(message).split("`")
    marked = [f"<code>{part}</code>" if k % 2 else part for k, part in enumerate(parts)]
    return f'<p class="missing">{"".join(marked)}</p>'


def plot(name: str, size: str = "", caption: str = "") -> str:
    """Leave room for a diagram."""
    note = f'<p class="soft">{text(caption)}</p>' if caption else ""
    return f'{note}<div class="plot {size}" id="{name}"></div>'


def image(uri: str, caption: str) -> str:
    """Show a picture with its caption."""
    return (
        f'<figure><img src="{uri}" alt="{text(caption)}" loading="lazy">'
        f"<figcaption>{text(caption)}</figcaption></figure>"
    )


def number(value: float | None, digits: int = 2, unit: str = "") -> str:
    """Write a table cell with a number; empty if there is none."""
    if value is None:
        return '<td class="n" data-sort="-1"></td>'
    return f'<td class="n" data-sort="{value:.6f}">{value:,.{digits}f}{unit}</td>'


def significant(value: float, digits: int = 3) -> str:
    """Write a table cell with a number of few digits, however small it is."""
    shown = f"{value:,.{max(digits - 1 - floor(log10(value)), 0)}f}" if value > 0 else f"{value:g}"
    return f'<td class="n" data-sort="{value:.6g}">{shown}</td>'


def cell(value: object, kind: str = "") -> str:
    """Write a table cell with a text."""
    return f'<td class="{kind}">{text(value)}</td>' if kind else f"<td>{text(value)}</td>"


def table(heads: Sequence[str], rows: Iterable[Sequence[str]], *, sortable: bool = False) -> str:
    """Write a table of cells made before; headings of numbers stand over them."""
    rows = list(rows)
    kind = ' class="sortable"' if sortable else ""
    shown = (f"<button>{text(h)}</button>" if sortable and h else text(h) for h in heads)
    right = [
        ' class="n"' if cell.startswith('<td class="n"') else "" for cell in next(iter(rows), ())
    ]
    right += [""] * (len(heads) - len(right))
    head = "".join(f'<th scope="col"{r}>{h}</th>' for h, r in zip(shown, right, strict=True))
    body = "\n".join(f"<tr>{''.join(row)}</tr>" for row in rows)
    table_ = f"<table{kind}><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
    return f'<div class="scroll tall-table">{table_}</div>'


def duration(seconds: float) -> str:
    """Write a time as people do."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s".replace(" ", "\N{NO-BREAK SPACE}")
