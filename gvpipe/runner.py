"""Run one stage: check what it needs, skip it if fresh, else compute and publish."""

import time
from pathlib import Path
from typing import Any

from gvpipe import __version__
from gvpipe.artefacts import Artefact, publish, read_artefact, schema_of, staging
from gvpipe.chain import Chain, Expectation, scale_source, stage_module
from gvpipe.checkpoint import Checkpoints
from gvpipe.errors import InputError, NoResultError
from gvpipe.output import locked, writing_to
from gvpipe.records import Header
from gvpipe.report import Reporter, log
from gvpipe.session import Session
from gvpipe.stages.contract import Context, Outcome


def run_stage(name: str, session: Session, reporter: Reporter, *, force: bool = False) -> None:
    """Run one command of the chain.

    Parameters
    ----------
    name : str
        One of :data:`gvpipe.chain.STAGES`.
    session : Session
        Configuration and images, shared by the commands of one run.
    reporter : Reporter
        Progress and results.
    force : bool
        Run even if the artefact is fresh.

    Raises
    ------
    InputError, NoResultError, OutputError, ConfigError
        See :mod:`gvpipe.errors`.
    """
    out = Path(session.config.output)
    with writing_to(out):
        out.mkdir(parents=True, exist_ok=True)
    with locked(out, name):
        started = time.monotonic()
        chain = Chain(session.config, session.dataset)
        upstream = chain.needed(name)
        expected = chain.expectation(name)
        folder = chain.folder(name)
        checkpoints = Checkpoints(out / f".{name}.checkpoints")
        fresh = None if force else _fresh(folder, name, expected)
        if force or fresh:
            checkpoints.sweep()  # not wanted, or of a run killed right after it had published
        if fresh:
            with writing_to(folder):
                (folder / fresh.body.file).touch()  # Make goes by time
            unchanged = ("fresh", "nothing has changed since it was made")
            reporter.result(f"gvpipe {name}", [unchanged], [])
            return _conclude(name, fresh.header.reason)
        if stage_module(name).PARALLEL == "threads":
            session.make_room()
        context = Context(
            config=session.config,
            dataset=session.dataset,
            upstream=upstream,
            jobs=session.jobs,
            workers=session.workers,
            progress=reporter.progress,
            checkpoints=checkpoints,
            features=session.features,
        )
        outcome, written = _made(name, context, expected, folder, started)
        checkpoints.sweep()
    used, skipped = len(session.dataset.entries), len(expected.skipped)
    rows = [
        ("images", f"{used} used, {skipped} skipped"),
        *outcome.summary,
        ("time", f"{time.monotonic() - started:.1f} s"),
    ]
    if checkpoints.reused:
        rows.append(("resumed", f"{checkpoints.reused} items were done by an interrupted run"))
    reporter.result(f"gvpipe {name}", rows, written)
    return _conclude(name, outcome.no_result)


def _made(
    name: str, context: Context, expected: Expectation, folder: Path, started: float
) -> tuple[Outcome[Any, Any], list[Path]]:
    """Compute a stage's result and publish it; returns the files as well, the JSON first."""
    stage = stage_module(name)
    outcome = stage.run(context)
    log.debug("computed in %.1f s", time.monotonic() - started)
    header = Header(
        schema_id=schema_of(stage.BODY),
        gvpipe_version=__version__,
        config_sha256=expected.config_sha256,
        inputs=expected.inputs,
        files={},
        seed=context.config.seed,
        scale_source=scale_source(context.config),
        wall_s=round(time.monotonic() - started, 3),
        skipped=expected.skipped,
        reason=outcome.no_result,
    )
    with writing_to(folder), staging(folder.parent, name) as staged:
        stage.write(outcome, staged)
        names = sorted(p.name for p in staged.iterdir())
        publish(staged, folder, header, outcome.body)
    log.debug("written after %.1f s", time.monotonic() - started)
    return outcome, [folder / n for n in (outcome.body.file, *names)]


def _conclude(name: str, no_result: str | None) -> None:
    """End without an error only if there is a result."""
    if no_result:
        raise NoResultError(f"{name}: no result: {no_result}")


def _fresh(folder: Path, name: str, expected: Expectation) -> Artefact[Any] | None:
    """Read the artefact that is there, if it is what would be made."""
    try:
        artefact = read_artefact(folder, stage_module(name).BODY)
    except InputError as error:
        log.debug("runs: %s", error)
        return None
    changed = expected.mismatch(artefact.header)
    if changed:
        log.debug("runs anew: its artefact %s", changed)
    return None if changed else artefact
