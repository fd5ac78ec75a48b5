"""Command line of ``gvpipe report``."""

import os
from pathlib import Path
from typing import Annotated

import typer

from gvpipe.tools.options import LogJson, Quiet, Verbose, argument, option, use_one_blas_thread


def add(app: typer.Typer) -> None:
    """Add the command."""
    app.command(
        "report",
        help="Write one self-contained page about a run: map and location graph, pairs, overlaps, "
        "obstacles in 3D, energy, timings, warnings, settings and provenance. It opens without a "
        "network. Stages that have not been run are left out, with the command that runs them.",
        epilog="Example: gvpipe report configs/example.yaml",
    )(report)


def report(
    config: Annotated[Path, argument("Configuration, a YAML file.", "CONFIG")],
    out: Annotated[
        Path | None,
        option("--out", "Output folder.", metavar="DIR", show_default="`output` of CONFIG"),
    ] = None,
    overrides: Annotated[
        list[str] | None,
        option("--set", "Override one key; may be repeated.", metavar="KEY=VALUE"),
    ] = None,
    jobs: Annotated[
        int | None, typer.Option("--jobs", "-j", min=1, help="Threads.", show_default="all cores")
    ] = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
    log_json: LogJson = False,
) -> None:
    """Write the report of a run."""
    use_one_blas_thread()
    from gvpipe.commands.report import run
    from gvpipe.configfile import load_config
    from gvpipe.report import Reporter

    run(
        load_config(config, tuple(overrides or ()), out),
        Reporter(quiet=quiet, verbose=verbose, log_json=log_json),
        jobs=jobs or len(os.sched_getaffinity(0)),
    )
