"""``gvpipe report``: one page with everything a run found."""

import time
from importlib.resources import files
from pathlib import Path
from string import Template

from gvpipe import __version__
from gvpipe.artefacts import canonical_json, publish, schema_of, staging
from gvpipe.chain import STAGES, Chain, scale_source, stage_module, unreadable
from gvpipe.commands.report_figures import Json
from gvpipe.commands.report_pairs import thumbnails
from gvpipe.commands.report_pictures import packed_library
from gvpipe.commands.report_run import Run
from gvpipe.commands.report_sections import SECTIONS, cards, subtitle
from gvpipe.commands.report_text import text
from gvpipe.config import Config
from gvpipe.configfile import section_sha256
from gvpipe.errors import InputError
from gvpipe.output import locked, writing_to
from gvpipe.records import Header, ReportBody, ReportedStage
from gvpipe.report import Reporter, log
from gvpipe.session import open_images

PAGE = "report.html"


def run(config: Config, reporter: Reporter, *, jobs: int) -> None:
    """Write the report of a run, of whatever stages have been run.

    Parameters
    ----------
    config : Config
        The loaded configuration.
    reporter : Reporter
        Says what was written.
    jobs : int
        Threads that read pictures.

    Raises
    ------
    InputError
        If there is no usable picture.
    OutputError
        If the report cannot be written.
    """
    started = time.monotonic()
    out = Path(config.output)
    with writing_to(out):
        out.mkdir(parents=True, exist_ok=True)
    with locked(out, "report"):
        shown = collect(config, jobs)
        body = ReportBody(
            stages=tuple(
                ReportedStage(stage=s, shown=s in shown.artefacts, reason=shown.missing.get(s))
                for s in STAGES
            ),
            warnings=tuple(shown.warnings()),
        )
        header = Header(
            schema_id=schema_of(ReportBody),
            gvpipe_version=__version__,
            config_sha256=section_sha256(config, tuple(Config.model_fields)),
            inputs={f"{s}/{a.body.file}": a.digest for s, a in shown.artefacts.items()},
            files={},
            seed=config.seed,
            scale_source=scale_source(config),
            wall_s=round(time.monotonic() - started, 3),
            skipped=unreadable(shown.dataset),
        )
        with writing_to(out / "report"), staging(out, "report") as staged:
            (staged / PAGE).write_text(page(shown), encoding="utf-8")
            publish(staged, out / "report", header, body)
    if shown.missing:
        which = ", ".join(shown.missing)
        log.warning("not shown, for missing or stale: %s; `gvpipe run CONFIG` makes them", which)
    rows = [("stages", f"{len(shown.artefacts)} of {len(STAGES)} shown")]
    rows += [(f"no {stage}", reason) for stage, reason in shown.missing.items()]
    rows += [("warnings", str(len(body.warnings)))]
    reporter.result("gvpipe report", rows, [out / "report" / PAGE, out / "report" / body.file])


def collect(config: Config, jobs: int) -> Run:
    """Read every artefact that is fresh; say of the others why they are not shown."""
    dataset = open_images(config, jobs)
    chain = Chain(config, dataset)
    shown = Run(config, dataset, {}, {})
    for stage in STAGES:
        try:
            shown.artefacts[stage] = chain.fresh(stage_module(stage).BODY)
        except InputError as error:
            shown.missing[stage] = _without_folder(str(error), config)
    return shown


def _without_folder(message: str, config: Config) -> str:
    """Name files from the output folder on: the page may be read on another machine."""
    return message.replace(f"{config.output}/", "")


def page(run: Run) -> str:
    """Write the page, the same bytes for the same artefacts."""
    figures: list[Json] = []
    sections, links = [], []
    for name, title, make in SECTIONS:
        content = make(run, figures)
        if content:
            sections.append(f'<section id="{name}"><h2>{text(title)}</h2>{content}</section>')
            links.append(f'<a href="#{name}">{text(title)}</a>')
    template = files("gvpipe.commands").joinpath(PAGE).read_text(encoding="utf-8")
    # "<" would end the script element that carries the diagrams
    packed = canonical_json(figures).replace("<", "\\u003c")
    return Template(template).substitute(
        version=__version__,
        title=text(run.title),
        subtitle=subtitle(run),
        cards=cards(run),
        links="\n".join(links),
        thumbnails=thumbnails(run),
        sections="\n".join(sections),
        figures=packed,
        library=packed_library() if figures else "",
    )
