"""Run one stage: check what it needs, skip it if fresh, else compute and publish."""

import time
from pathlib import Path
from typing import Any

from gvpipe import __version__
from gvpipe.artefacts import Artefact, publish, read_artefact, schema_of, staging
from gvpipe.chain import Chain, Expectation, Session, scale_source, stage_module
from gvpipe.checkpoint import Checkpoints
from gvpipe.errors import InputError, NoResultError
from gvpipe.output import locked, writing_to
from gvpipe.records import Header
from gvpipe.report import Reporter, log
from gvpipe.stages.contract import Context


def run_stage(
    name: str,
    session: Session,
    reporter: Reporter,
    *,
    force: bool = False,
) -> None:
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
    config = session.config
    out = Path(config.output)
    with writing_to(out):
        out.mkdir(parents=True, exist_ok=True)
    with locked(out, name):
        started = time.monotonic()
        dataset = session.dataset
        chain = Chain(config, dataset)
        upstream = chain.needed(name)
        expected = chain.expectation(name)
        folder = chain.folder(name)
        checkpoints = Checkpoints(out / f".{name}.checkpoints")
        fresh = None if force else _fresh(folder, name, expected)
        if fresh:
            checkpoints.sweep()  # a run killed right after it had published left them
            with writing_to(folder):
                (folder / fresh.body.file).touch()  # Make goes by time
            unchanged = ("fresh", "nothing has changed since it was made")
            reporter.result(f"gvpipe {name}", (unchanged,), [])
            return _conclude(name, fresh.header.reason)
        if force:
            checkpoints.sweep()
        context = Context(
            config=config,
            dataset=dataset,
            upstream=upstream,
            jobs=session.jobs,
            workers=session.workers,
            progress=reporter.progress,
            checkpoints=checkpoints,
            features=session.features,
        )
        stage = stage_module(name)
        outcome = stage.run(context)
        log.debug("computed in %.1f s", time.monotonic() - started)
        header = Header(
            schema_id=schema_of(stage.BODY),
            gvpipe_version=__version__,
            config_sha256=expected.config_sha256,
            inputs=expected.inputs,
            files={},
            seed=config.seed,
            scale_source=scale_source(config),
            wall_s=round(time.monotonic() - started, 3),
            skipped=expected.skipped,
            reason=outcome.no_result,
        )
        with writing_to(folder), staging(out, name) as staged:
            stage.write(outcome, staged)
            names = sorted(p.name for p in staged.iterdir())
            publish(staged, folder, header, outcome.body)
        log.debug("written after %.1f s", time.monotonic() - started)
        checkpoints.sweep()
    rows = [
        ("images", f"{len(dataset.entries)} used, {len(header.skipped)} skipped"),
        *outcome.summary,
        ("time", f"{time.monotonic() - started:.1f} s"),
    ]
    if checkpoints.reused:
        rows.append(("resumed", f"{checkpoints.reused} items were done by an interrupted run"))
    reporter.result(f"gvpipe {name}", rows, [folder / n for n in (outcome.body.file, *names)])
    return _conclude(name, outcome.no_result)


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
