"""The command line: six commands, one configuration file, documented exit codes."""

import errno
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand

from gvpipe import __version__
from gvpipe.errors import (
    GvpipeError,
    InputError,
    NoResultError,
    OutputError,
    ResourceError,
    UsageError,
)
from gvpipe.supervisor import Terminated, stopping
from gvpipe.tools import add_tools

if TYPE_CHECKING:  # loaded late: the command line stays quick
    from gvpipe.report import Reporter
    from gvpipe.session import Session

EXIT_INTERRUPTED, EXIT_TERMINATED, EXIT_DEFECT = 130, 143, 1

EXIT_CODES = (
    "Exit codes: 0 done; 1 a defect in gvpipe; 2 wrong command line; 3 wrong configuration or "
    "calibration; 4 an input is missing, unreadable or stale; 5 ran, but there is no result; "
    "6 the output cannot be written; 7 a resource limit was hit; 130 interrupted; 143 terminated."
)

COMMANDS = {
    "match": "Match pairs of pictures through overhead views: ground homographies.",
    "localize": "Relative pose of two views: camera motion, tilts and metric shift of each pair.",
    "overlap": "Find pictures of different robots that show the same ground.",
    "slam": "Put all robots on one metric map; draw the location graph.",
    "mosaic": "Compose the overhead map with the obstacles taken out, and a ROS map.",
    "reconstruct": "Recover the obstacles' shape in 3D.",
}

EXAMPLES = {
    "match": "gvpipe match mine.yaml --jobs 2; gvpipe match mine.yaml --set match.pairs=exhaustive",
    "localize": "gvpipe localize mine.yaml",
    "overlap": "gvpipe overlap team.yaml --set overlap.distance=chi2",
    "slam": "gvpipe slam team.yaml --dry-run; gvpipe slam team.yaml --out runs/other",
    "mosaic": "gvpipe mosaic mine.yaml --set mosaic.resolution=0.002 --memory-limit 2G",
    "reconstruct": "gvpipe reconstruct mine.yaml --set reconstruct.method=visual-hull --force",
}

app = typer.Typer(
    name="gvpipe",
    help="Metric maps and 3D obstacles from ordinary photographs of a floor.",
    epilog=EXIT_CODES,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
config_app = typer.Typer(help="Look at a configuration.", no_args_is_help=True)
app.add_typer(config_app, name="config")

ConfigPath = Annotated[Path, typer.Argument(metavar="CONFIG", help="Configuration, a YAML file.")]
OutDir = Annotated[
    Path | None,
    typer.Option("--out", metavar="DIR", help="Output folder.", show_default="`output` of CONFIG"),
]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Override one key; may be repeated."),
]
Jobs = Annotated[
    int | None,
    typer.Option(
        "--jobs", "-j", min=1, help="Processes at once.", show_default="the number of cores"
    ),
]
MemoryLimit = Annotated[
    str | None,
    typer.Option(
        "--memory-limit",
        metavar="SIZE",
        help="Most memory for all processes together, for example 500M or 2G; exit code 7 beyond.",
        show_default="none",
    ),
]
DryRun = Annotated[
    bool,
    typer.Option(
        "--dry-run", help="Write nothing; say what is fresh, what would run, for how long."
    ),
]
Stages = Annotated[
    str | None,
    typer.Option(
        "--stages", metavar="NAME,...", help="Which of them, by commas.", show_default="all"
    ),
]
Force = Annotated[bool, typer.Option("--force", help="Run even if the artefact is fresh.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing but errors.")]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="Say more.")]
LogJson = Annotated[bool, typer.Option("--log-json", help="Log as JSON lines on standard error.")]


READS = {
    "match": ("match",),
    "localize": (),
    "overlap": ("overlap", "match"),
    "slam": ("slam", "match"),
    "mosaic": ("mosaic",),
    "reconstruct": ("reconstruct",),
}
"""Configuration sections whose keys a command's help lists; all read cameras and robots too."""


class StageCommand(TyperCommand):
    """A command of the chain; its help ends with the configuration keys it reads."""

    def format_help(self, ctx: typer.Context, formatter: Any) -> None:  # type: ignore[override]
        """Print the usual help, then keys, defaults and units."""
        super().format_help(ctx, formatter)
        from gvpipe.report import section_help

        for section in READS[self.name or ""]:
            section_help(section)


def _version(show: bool) -> None:
    if show:
        typer.echo(f"gvpipe {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_version, is_eager=True, help="Show the version."),
    ] = False,
) -> None:
    """Metric maps and 3D obstacles from ordinary photographs of a floor."""


def _stage_command(name: str) -> Callable[..., None]:
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
        says = _Says(quiet=quiet, verbose=verbose, log_json=log_json)
        session, reporter = _prepared(config, out, overrides, jobs, memory_limit, says)
        with session:
            _do(name, session, reporter, force=force, dry_run=dry_run)

    return command


@dataclass(frozen=True)
class _Says:
    """How much is said, and in which form."""

    quiet: bool
    verbose: bool
    log_json: bool


def _prepared(
    path: Path,
    out: Path | None,
    overrides: list[str] | None,
    jobs: int | None,
    memory_limit: str | None,
    says: _Says,
) -> "tuple[Session, Reporter]":
    """Check what a command was given: its configuration and jobs, where it reports."""
    if says.quiet and says.verbose:
        raise UsageError("--quiet and --verbose exclude each other")
    from gvpipe.memory import jobs_within, keep_within, parse_size

    jobs = jobs or len(os.sched_getaffinity(0))
    if memory_limit is not None:
        limit = parse_size(memory_limit)
        jobs = jobs_within(limit, jobs)
        keep_within(limit)
    from gvpipe.configfile import load_config
    from gvpipe.report import Reporter
    from gvpipe.session import Session

    reporter = Reporter(quiet=says.quiet, verbose=says.verbose, log_json=says.log_json)
    return Session(load_config(path, tuple(overrides or ()), out), jobs), reporter


def _do(
    name: str,
    session: "Session",
    reporter: "Reporter",
    *,
    force: bool,
    dry_run: bool,
    before: Sequence[str] = (),
) -> None:
    """Run one stage, or say what it would do once those before it have run."""
    if dry_run:
        from gvpipe.plan import plan_stage

        plan_stage(name, session, reporter, force=force, before=before)
        return
    from gvpipe.runner import run_stage

    run_stage(name, session, reporter, force=force)


for _name, _help in COMMANDS.items():
    _epilog = f"Examples: {EXAMPLES[_name]}\n\n{EXIT_CODES}"
    app.command(_name, cls=StageCommand, help=_help, epilog=_epilog)(_stage_command(_name))

RUN_EXAMPLES = "gvpipe run mine.yaml; gvpipe run mine.yaml --stages match,overlap,slam"


@app.command("run", epilog=f"Examples: {RUN_EXAMPLES}\n\n{EXIT_CODES}")
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
    they need it.
    """
    names = list(COMMANDS) if stages is None else [s.strip() for s in stages.split(",")]
    for name in names:
        if name not in COMMANDS:
            raise UsageError(f"--stages: {name!r} is none of {', '.join(COMMANDS)}")
    says = _Says(quiet=quiet, verbose=verbose, log_json=log_json)
    session, reporter = _prepared(config, out, overrides, jobs, memory_limit, says)
    chosen = [name for name in COMMANDS if name in names]
    missing: NoResultError | None = None
    with session:
        for k, name in enumerate(chosen):
            try:
                _do(name, session, reporter, force=force, dry_run=dry_run, before=chosen[:k])
            except NoResultError as error:
                missing = missing or error
            except InputError as error:
                if missing is None:
                    raise
                # most likely a consequence, and the cause is what helps
                raise NoResultError(f"{missing}\n{name}: {error}") from error
    if missing:
        raise missing


add_tools(app)


@config_app.command("show", epilog="Example: gvpipe config show configs/example.yaml")
def config_show(config: ConfigPath, overrides: Overrides = None, out: OutDir = None) -> None:
    """Print the whole configuration: every key, its value or default, its unit."""
    from gvpipe.configfile import load_config, show_config

    typer.echo(show_config(load_config(config, tuple(overrides or ()), out)), nl=False)


@config_app.command("check", epilog="Example: gvpipe config check configs/example.yaml")
def config_check(config: ConfigPath, overrides: Overrides = None, out: OutDir = None) -> None:
    """Check a configuration and its calibrations; list every error."""
    from gvpipe.configfile import load_config

    load_config(config, tuple(overrides or ()), out)
    typer.echo(f"{config}: no errors")


def run(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code.

    Parameters
    ----------
    arguments : sequence of str, optional
        Without the program's name; `sys.argv` if left out.
    """
    try:
        app(args=arguments, prog_name="gvpipe")
    except SystemExit as stop:  # typer prints usage errors itself and exits with 2
        return stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    except GvpipeError as error:
        return _failed(error)
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    except Terminated:
        return EXIT_TERMINATED
    except MemoryError:
        return _failed(ResourceError("memory ran out; fewer --jobs need less"))
    except OSError as error:
        if error.errno in _EXHAUSTED:
            return _failed(ResourceError(f"the system has no more resources: {error.strerror}"))
        if error.errno in _UNWRITABLE:  # files have raised their own errors
            return _failed(OutputError(f"standard output: cannot be written: {error.strerror}"))
        return _defect()
    except Exception:
        return _defect()
    return 0


_EXHAUSTED = frozenset({errno.ENOMEM, errno.EAGAIN, errno.EMFILE, errno.ENFILE})
"""What the system says when there is no more memory, or there are too many processes or files."""

_UNWRITABLE = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EIO})


def _failed(error: GvpipeError) -> int:
    """Print an expected error, every line of it safe for a terminal."""
    from gvpipe.report import printable

    message = "\n".join(printable(line) for line in str(error).split("\n"))
    print(f"gvpipe: {message}", file=sys.stderr)  # noqa: T201
    return error.exit_code


def _defect() -> int:
    """Print the traceback of an unexpected error, without the values of variables."""
    if stopping():
        return EXIT_DEFECT
    import traceback

    from gvpipe.report import printable

    for line in traceback.format_exc().splitlines():
        print(printable(line), file=sys.stderr)  # noqa: T201
    print(  # noqa: T201
        "gvpipe: this is a defect in gvpipe; please report it with the lines above",
        file=sys.stderr,
    )
    return EXIT_DEFECT
