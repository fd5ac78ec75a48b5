"""The command line: how it is called, and the exit code that each end of it has."""

import errno
import sys
from collections.abc import Sequence
from typing import Annotated

import typer

from gvpipe import __version__
from gvpipe.errors import (
    EXIT_CODES,
    EXIT_DEFECT,
    EXIT_INTERRUPTED,
    EXIT_TERMINATED,
    GvpipeError,
    OutputError,
    ResourceError,
)
from gvpipe.supervisor import Terminated, stopping
from gvpipe.tools import add_commands

app = typer.Typer(
    name="gvpipe",
    help="Metric maps and 3D obstacles from ordinary photographs of a floor.",
    epilog=EXIT_CODES,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


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


add_commands(app)


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
