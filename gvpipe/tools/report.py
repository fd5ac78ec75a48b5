"""Command line of ``gvpipe report``."""

import typer

from gvpipe.tools.options import (
    ConfigPath,
    Jobs,
    LogJson,
    OutDir,
    Overrides,
    Quiet,
    Verbose,
    some_jobs,
)


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
    config: ConfigPath,
    out: OutDir = None,
    overrides: Overrides = None,
    jobs: Jobs = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
    log_json: LogJson = False,
) -> None:
    """Write the report of a run."""
    from gvpipe.commands.report import run
    from gvpipe.configfile import load_config
    from gvpipe.report import Reporter

    run(
        load_config(config, tuple(overrides or ()), out),
        Reporter(quiet=quiet, verbose=verbose, log_json=log_json),
        jobs=some_jobs(jobs),
    )
