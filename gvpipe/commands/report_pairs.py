"""The report's table of pairs, each with its matches drawn over both photographs."""

import numpy as np

from gvpipe.artefacts import Members
from gvpipe.commands.report_figures import Json
from gvpipe.commands.report_pictures import THUMB_WIDTH, thumbnail
from gvpipe.commands.report_run import Run
from gvpipe.commands.report_text import cell, missing, number, table, text
from gvpipe.records import MatchBody, PairRow

MOST_PAIR_PICTURES = 400
"""Pairs shown with their pictures; the others have their numbers only."""

MOST_LINES = 24
"""Matches drawn in one pair's picture."""

KNOWN = "The poses were taken from the files: the map does not need these pairs to match."
"""Said over the pairs of a run with known poses."""


def pairs(run: Run, figures: list[Json]) -> str:
    """List all pairs with their match pictures."""
    match = run.get(MatchBody)
    if match is None:
        return missing(run.missing["match"])
    if not match.body.pairs:
        return '<p class="soft">No pair was asked for.</p>'
    points = match.arrays("match.npz")
    number_of = {name: k for k, name in enumerate(_pictured(run))}
    rows = []
    for k, row in enumerate(match.body.pairs):
        drawn = _pair_picture(run, row, k, points, number_of) if k < MOST_PAIR_PICTURES else ""
        rows.append((f"<td>{drawn}</td>", *_pair_cells(run, row)))
    heads = ["", "pictures", "verdict", "inliers", "of", "error, px", "distance, m", "yaw, °"]
    more = len(rows) - MOST_PAIR_PICTURES
    note = f'<p class="soft">The last {more} have no pictures here.</p>' if more > 0 else ""
    if run.known:
        note = f'<p class="soft">{KNOWN}</p>{note}'
    return note + table(heads, rows, sortable=True)


def _pair_cells(run: Run, row: PairRow) -> tuple[str, ...]:
    motion = run.motions.get((row.image_i, row.image_j))
    good = row.status == "ok"
    verdict = "matched" if good else (row.reason or "rejected")
    return (
        f'<td class="name">{text(row.image_i)}<br>{text(row.image_j)}</td>',
        cell(verdict, "good" if good else "soft" if run.known else "bad"),
        number(row.inliers, 0),
        number(row.candidates, 0),
        number(row.error_px),
        number(motion.distance_m if motion else None, 3),
        number(motion.yaw_deg if motion else None, 1),
    )


def _pair_picture(
    run: Run, row: PairRow, k: int, points: Members, number_of: dict[str, int]
) -> str:
    """Draw two photographs side by side, with some of their matches."""
    scales, heights = [], []
    for name in (row.image_i, row.image_j):
        camera = run.dataset.entry(name).camera
        scales.append(THUMB_WIDTH / camera.width)
        heights.append(round(camera.height * scales[-1]))
    gap = 4
    left, right = (
        points[f"{k}/points_{side}"] * scale for side, scale in zip("ij", scales, strict=True)
    )
    chosen = np.unique(np.linspace(0, len(left) - 1, MOST_LINES).round().astype(int))
    lines = "".join(
        f"M{left[n, 0]:.0f} {left[n, 1]:.0f}L{right[n, 0] + THUMB_WIDTH + gap:.0f} "
        f"{right[n, 1]:.0f}"
        for n in (chosen if len(left) else ())
    )
    width = 2 * THUMB_WIDTH + gap
    label = text(f"{row.image_i} and {row.image_j}, {row.inliers} matches")
    return (
        f'<svg class="pair" viewBox="0 0 {width} {max(heights)}" role="img" aria-label="{label}">'
        f'<use href="#t{number_of[row.image_i]}"/>'
        f'<use href="#t{number_of[row.image_j]}" x="{THUMB_WIDTH + gap}"/>'
        f'<path d="{lines}" stroke="#21e6c1" stroke-width=".8" opacity=".85" fill="none"/></svg>'
    )


def thumbnails(run: Run) -> str:
    """Define the small pictures that the table of pairs uses, each once."""
    defined = []
    for k, image_id in enumerate(_pictured(run)):
        uri, height = thumbnail(run.dataset.view(image_id).pixels)
        defined.append(f'<image id="t{k}" width="{THUMB_WIDTH}" height="{height}" href="{uri}"/>')
    return "\n".join(defined)


def _pictured(run: Run) -> list[str]:
    """Images of the pairs that are shown with pictures, in order."""
    match = run.get(MatchBody)
    pairs = match.body.pairs[:MOST_PAIR_PICTURES] if match else ()
    return list(dict.fromkeys(name for row in pairs for name in (row.image_i, row.image_j)))
