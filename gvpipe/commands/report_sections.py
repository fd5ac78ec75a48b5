"""The report's sections: each says what it found, or which command would find it."""

from collections.abc import Callable
from statistics import median
from typing import TypeAlias

from gvpipe.chain import STAGES
from gvpipe.commands.report_figures import (
    Json,
    energy_figure,
    map_figure,
    overlap_figure,
)
from gvpipe.commands.report_pairs import pairs
from gvpipe.commands.report_pictures import picture
from gvpipe.commands.report_run import Run
from gvpipe.commands.report_space import scene_figure
from gvpipe.commands.report_text import (
    cell,
    duration,
    image,
    missing,
    number,
    plot,
    significant,
    table,
    text,
)
from gvpipe.configfile import show_config
from gvpipe.formats.ply import read_mesh
from gvpipe.records import (
    MatchBody,
    MosaicBody,
    OverlapBody,
    ReconstructBody,
    SlamBody,
)
from gvpipe.stages.contract import main_component

MOST_WARNINGS = 8
"""Warnings shown at once; the others unfold."""

PICTURES = {
    "turntable.png": "The obstacles from all sides.",
    "evolution.png": "The surface on its way from the first guess to the result.",
    "terms.png": "Weights of the energy's terms.",
}
"""Pictures of the obstacles, and what they show."""


def subtitle(run: Run) -> str:
    """Say in one line what the run was."""
    sources = {
        "height": "the cameras' height",
        "poses": "the known poses",
        "control": "known ground points",
    }
    scale = next((a.header.scale_source for a in run.artefacts.values()), None)
    known = f" · scale from {sources[scale]}" if scale else ""
    robots = len(run.dataset.robots)
    return text(f"{robots} robot{'s' * (robots != 1)}{known} · seed {run.config.seed}")


def cards(run: Run) -> str:
    """Give the numbers that come first."""
    match, slam = run.get(MatchBody), run.get(SlamBody)
    mosaic, found = run.get(MosaicBody), run.get(ReconstructBody)
    shown = [(str(len(run.dataset.entries)), "pictures used")]
    if match:
        good = sum(row.status == "ok" for row in match.body.pairs)
        shown.append((f"{good} / {len(match.body.pairs)}", "pairs matched"))
    if slam:
        shown.append((str(len(slam.body.poses)), "pictures on the map"))
        shown.append((str(slam.body.components), "connected maps"))
    if mosaic:
        shown.append((f"{mosaic.body.coverage_m2:.1f} m²", "ground seen"))
    if found:
        shown.append((str(len(found.body.obstacles)), "obstacles"))
    if run.artefacts:
        total = sum(a.header.wall_s for a in run.artefacts.values())
        shown.append((duration(total), "computing time"))
    return "".join(f"<div><b>{text(b)}</b><span>{text(s)}</span></div>" for b, s in shown)


def warnings(run: Run, figures: list[Json]) -> str:
    """List what a reader should not overlook."""
    found = list(run.warnings())
    if not found:
        return f'<p class="soft">{_nothing_wrong(run)}</p>'
    first, more = _list(found[:MOST_WARNINGS]), found[MOST_WARNINGS:]
    rest = f"<details><summary>{len(more)} more</summary>{_list(more)}</details>" if more else ""
    return first + rest


def _list(lines: list[str]) -> str:
    return f'<ul class="warnings">{"".join(f"<li>{text(line)}</li>" for line in lines)}</ul>'


def _nothing_wrong(run: Run) -> str:
    if run.missing:
        return f"None in the {len(run.artefacts)} of {len(STAGES)} stages shown here."
    return "None: every picture was used."


def maps(run: Run, figures: list[Json]) -> str:
    """Draw the location graph of every component over its mosaic."""
    slam, mosaic = run.get(SlamBody), run.get(MosaicBody)
    if slam is None or mosaic is None:
        return missing(run.missing["mosaic"])
    found = run.get(ReconstructBody)
    content = []
    for k, part in enumerate(mosaic.body.components):
        rows = found.body.obstacles if found and part.component == mosaic.body.component else ()
        figures.append(map_figure(f"map-{k}", part, mosaic, slam.body, rows))
        note = (
            f"{len(part.images)} pictures, {part.coverage_m2:.2f} m² of ground at "
            f"{1000 * mosaic.body.resolution:g} mm a pixel. Drag to move, turn the wheel to zoom."
        )
        content.append(plot(f"map-{k}", "tall", note))
    return "".join([*content, _closing(slam.body)])


def _closing(slam: SlamBody) -> str:
    """Compare the map's loops with what plain concatenation gives."""
    if not slam.closing:
        return ""
    before = 1000 * median(row.concatenated_m for row in slam.closing)
    after = 1000 * median(row.adjusted_m for row in slam.closing)
    return (
        f'<p class="soft">Closing error of the {len(slam.closing)} longest loops of single robots, '
        f"median: {after:.2f} mm; plain concatenation of the motions: {before:.1f} mm.</p>"
    )


def space(run: Run, figures: list[Json]) -> str:
    """Show obstacles, ground and cameras in 3D."""
    slam, found = run.get(SlamBody), run.get(ReconstructBody)
    if slam is None:
        return missing(run.missing["slam"])
    note = ""
    if found is None:
        note = missing(run.missing["reconstruct"])
    elif found.header.reason:
        note = missing(f"No obstacles: {found.header.reason}.")
    mesh = read_mesh(found.folder / "obstacles.ply") if found and found.body.obstacles else None
    component = main_component(slam.body)
    figures.append(scene_figure("space", slam.body, component, run.get(MosaicBody), mesh))
    rows = found.body.obstacles if found else ()
    listed = table(
        ["obstacle", "height, m", "volume, l", "x, m", "y, m", "confidence", "views", "within, °"],
        [
            (
                cell(row.id),
                number(row.height_m, 3),
                significant(1000 * row.volume_m3),
                number(row.centroid[0], 3),
                number(row.centroid[1], 3),
                number(row.confidence, 2),
                number(row.views, 0),
                number(row.azimuth_span_deg, 0),
            )
            for row in rows
        ],
    )
    said = "Drag to turn, turn the wheel to zoom; the legend switches parts on and off."
    return note + plot("space", "tall", said) + (listed if rows else "")


def overlaps(run: Run, figures: list[Json]) -> str:
    """Draw the heat map of every pair of robots."""
    artefact = run.get(OverlapBody)
    if artefact is None:
        return missing(run.missing["overlap"])
    if not artefact.body.overlaps:
        return '<p class="soft">There is one robot only, so nothing to compare.</p>'
    distance = run.config.overlap.distance
    arrays = artefact.arrays("overlap.npz")
    robots = run.dataset.robots
    content = []
    for k, row in enumerate(artefact.body.overlaps):
        first, second = row.robots
        ids = ([e.image_id for e in robots[first]], [e.image_id for e in robots[second]])
        values = arrays[f"{first}-{second}/{distance}"]
        figures.append(overlap_figure(f"overlap-{k}", row, values, ids))
        valid = sum(c.validated for c in row.candidates)
        note = f"{first} and {second}: {valid} of {len(row.candidates)} candidates hold."
        content.append(f"<div>{plot(f'overlap-{k}', '', note)}</div>")
    said = f"Distance between colour histograms ({distance}); small means alike. Rings: validated."
    return f'<p class="soft">{text(said)}</p><div class="two">{"".join(content)}</div>'


def evolution(run: Run, figures: list[Json]) -> str:
    """Draw the energy curve and show the stage's own pictures."""
    artefact = run.get(ReconstructBody)
    if artefact is None:
        return missing(run.missing["reconstruct"])
    body = artefact.body
    content = []
    if body.energy:
        figures.append(energy_figure("energy", body))
        state = "converged" if body.converged else "stopped"
        note = f"{body.method}: {state} after {body.iterations} iterations."
        content.append(plot("energy", "low", note))
    else:
        content.append(f'<p class="soft">{text(body.method)}: has no energy to draw.</p>')
    for name, caption in PICTURES.items():
        if name in artefact.header.files:
            content.append(image(picture(artefact.folder / name), caption))
    return "".join(content)


def timings(run: Run, figures: list[Json]) -> str:
    """Show how long every stage took."""
    longest = max((a.header.wall_s for a in run.artefacts.values()), default=1.0) or 1.0
    rows = []
    for stage in STAGES:
        artefact = run.artefacts.get(stage)
        if artefact is None:
            rows.append(f'<span>{stage}</span><span></span><span class="soft">not run</span>')
            continue
        share = 100 * artefact.header.wall_s / longest
        bar = f'<i style="width:{share:.1f}%"></i>'
        rows.append(f"<span>{stage}</span>{bar}<span>{duration(artefact.header.wall_s)}</span>")
    return f'<div class="bars">{"".join(rows)}</div>'


def settings(run: Run, figures: list[Json]) -> str:
    """Print the whole configuration."""
    shown = text(show_config(run.config))
    return (
        f"<details><summary>Every key, its value and its unit</summary><pre>{shown}</pre></details>"
    )


def provenance(run: Run, figures: list[Json]) -> str:
    """Say from what everything was made, with checksums."""
    rows = [
        (cell(f"{stage}/{name}", "name"), cell(digest, "hash"))
        for stage, artefact in run.artefacts.items()
        for name, digest in [(artefact.body.file, artefact.digest), *artefact.header.files.items()]
    ]
    inputs = [
        (cell(entry.image_id, "name"), cell(entry.sha256, "hash")) for entry in run.dataset.entries
    ]
    kept = "".join(missing(reason) for reason in dict.fromkeys(run.missing.values()))
    results = table(["result", "sha256"], rows) if rows else ""
    return (
        f"{kept}<details><summary>{len(rows)} files of results</summary>{results}</details>"
        f"<details><summary>{len(inputs)} pictures</summary>"
        f"{table(['picture', 'sha256'], inputs)}</details>"
    )


Section: TypeAlias = Callable[[Run, list[Json]], str]

SECTIONS: tuple[tuple[str, str, Section], ...] = (
    ("warnings", "Warnings and skipped items", warnings),
    ("maps", "Map and location graph", maps),
    ("obstacles", "Obstacles in 3D", space),
    ("pairs", "Pairs", pairs),
    ("overlaps", "Overlaps", overlaps),
    ("evolution", "Evolution", evolution),
    ("timings", "Timings", timings),
    ("settings", "Settings", settings),
    ("provenance", "Provenance", provenance),
)
"""Anchor, title and maker of every section; a maker adds its diagrams to the list it is given."""
