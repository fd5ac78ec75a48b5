"""Command lines of the six stages, and of ``gvpipe run``, which does several."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand

from gvpipe.errors import EXIT_CODES, InputError, NoResultError, UsageError
from gvpipe.tools.options import (
    ConfigPath,
    Jobs,
    LogJson,
    OutDir,
    Overrides,
    Quiet,
    Verbose,
    option,
    some_jobs,
)

if TYPE_CHECKING:  # loaded late: the command line stays quick
    from gvpipe.report import Reporter
    from gvpipe.session import Session

COMMANDS = {
    "match": "Match pairs of pictures through overhead views: ground homographies.",
    "localize": "Relative pose of two views: camera motion, tilts and metric shift of each pair.",
    "overlap": "Find pictures of different robots that show the same ground.",
    "slam": "Put all robots on one metric map; draw the location graph.",
    "mosaic": "Compose the overhead map, obstacles taken out where a picture sees the ground.\n\n"
    "An obstacle seen from one side only leaves a smear. The ROS map is of the ground alone "
    "and may call footprints free: drive by the one of `gvpipe reconstruct`.",
    "reconstruct": "Recover the obstacles' shape in 3D, and the ROS map to drive by.",
}

EXAMPLES = {
    "match": "gvpipe match mine.yaml --jobs 2; gvpipe match mine.yaml --set match.pairs=exhaustive",
    "localize": "gvpipe localize mine.yaml",
    "overlap": "gvpipe overlap team.yaml --set overlap.distance=chi2",
    "slam": "gvpipe slam team.yaml --dry-run; gvpipe slam team.yaml --out runs/other",
    "mosaic": "gvpipe mosaic mine.yaml --set mosaic.resolution=0.002 --memory-limit 2G",
    "reconstruct": "gvpipe reconstruct mine.yaml --set reconstruct.method=visual-hull --force",
}

RUN_EXAMPLES = "gvpipe run mine.yaml; gvpipe run mine.yaml --stages match,overlap,slam"

READS = {
    "match": ("match",),
    "localize": (),
    "overlap": ("overlap", "match"),
    "slam": ("slam", "match"),
    "mosaic": ("mosaic",),
    "reconstruct": ("reconstruct",),
}
"""Configuration sections whose keys a command's help lists; all read cameras and robots too."""

MemoryLimit = Annotated[
    str | None,
    option(
        "--memory-limit",
        "Most memory for all processes together, for example 500M or 2G; exit code 7 beyond.",
        metavar="SIZE",
        show_default="none",
    ),
]
DryRun = Annotated[
    bool, option("--dry-run", "Write nothing; say what is fresh, what would run, for how long.")
]
Stages = Annotated[
    str | None,
    option("--stages", "Which of them, by commas.", metavar="NAME,...", show_default="all"),
]
Force = Annotated[bool, option("--force", "Run even if the artefact is fresh.")]


def add(app: typer.Typer) -> None:
    """Add the commands."""
    for name, text in COMMANDS.items():
        epilog = f"Examples: {EXAMPLES[name]}\n\n{EXIT_CODES}"
        app.command(name, cls=StageCommand, help=text, epilog=epilog)(_stage_command(name))
    app.command("run", epilog=f"Examples: {RUN_EXAMPLES}\n\n{EXIT_CODES}")(run_stages)


class StageCommand(TyperCommand):
    """A command of the chain; its help ends with the configuration keys it reads."""

    def format_help(self, ctx: typer.Context, formatter: Any) -> None:  # type: ignore[override]
        """Print the usual help, then keys, defaults and units."""
        super().format_help(ctx, formatter)
        from gvpipe.report import section_help

        for section in READS[self.name or ""]:
            section_help(section)


def _stage_command(name: str) -> Callable[..., None]:
    """Make the command line of one stage."""

    def command(
        config: ConfigPath,
        out: OutDir = None,
        overrides: Overrides = None,
        jobs: Jobs = None,
        memory_limit: MemoryLimit = None,
        force: Force = False,
        dry_run: DryRun = False,
        quiet: Quiet = False,
        verbose: Verbose = False,
        log_json: LogJson = False,
    ) -> None:
        from gvpipe.report import Reporter

        reporter = Reporter(quiet=quiet, verbose=verbose, log_json=log_json)
        with _session(config, out, overrides, jobs, memory_limit) as session:
            if dry_run:
                _plan([name], session, reporter, force=force)
            else:
                _run(name, session, reporter, force=force)

    return command


def run_stages(
    config: ConfigPath,
    stages: Stages = None,
    out: OutDir = None,
    overrides: Overrides = None,
    jobs: Jobs = None,
    memory_limit: MemoryLimit = None,
    force: Force = False,
    dry_run: DryRun = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    log_json: LogJson = False,
) -> None:
    """Run all six commands, or those named, one after the other in one process.

    One that ends without a result (exit code 5) does not keep the others from running, unless
    they need it. What they read and neither make nor find is an error before the first begins.
    """
    from gvpipe.report import Reporter

    chosen = _chosen(stages)
    reporter = Reporter(quiet=quiet, verbose=verbose, log_json=log_json)
    missing: NoResultError | None = None
    with _session(config, out, overrides, jobs, memory_limit) as session:
        if dry_run:
            return _plan(chosen, session, reporter, force=force)
        _require(chosen, session)
        for name in chosen:
            try:
                _run(name, session, reporter, force=force)
            except NoResultError as error:
                missing = missing or error
            except InputError as error:
                if missing is None:
                    raise
                # most likely a consequence, and the cause is what helps
                raise NoResultError(f"{missing}\n{name}: {error}") from error
    if missing:
        raise missing


def _chosen(stages: str | None) -> list[str]:
    """Read the names between commas; in the chain's order, whatever theirs."""
    names = list(COMMANDS) if stages is None else [s.strip() for s in stages.split(",")]
    for name in names:
        if name not in COMMANDS:
            raise UsageError(f"--stages: {name!r} is none of {', '.join(COMMANDS)}")
    return [name for name in COMMANDS if name in names]


def _require(chosen: Sequence[str], session: "Session") -> None:
    """Refuse at once what would be refused halfway."""
    from gvpipe.chain import Chain

    Chain(session.config, session.dataset).require(chosen)


def _session(
    config: ConfigPath, out: OutDir, overrides: Overrides, jobs: Jobs, memory_limit: MemoryLimit
) -> "Session":
    """Check what a command was given, and keep within the memory it may take."""
    from gvpipe.memory import jobs_within, keep_within, parse_size

    count = some_jobs(jobs)
    if memory_limit is not None:
        limit = parse_size(memory_limit)
        count = jobs_within(limit, count)
        keep_within(limit)
    from gvpipe.configfile import load_config
    from gvpipe.session import Session

    return Session(load_config(config, tuple(overrides or ()), out), count)


def _run(name: str, session: "Session", reporter: "Reporter", *, force: bool) -> None:
    """Run one stage."""
    from gvpipe.runner import run_stage

    run_stage(name, session, reporter, force=force)


def _plan(names: Sequence[str], session: "Session", reporter: "Reporter", *, force: bool) -> None:
    """Say what some stages would do."""
    from gvpipe.plan import plan_stages

    plan_stages(names, session, reporter, force=force)
