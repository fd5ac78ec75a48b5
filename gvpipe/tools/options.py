"""Options that several tools share."""

import os
from pathlib import Path
from typing import Annotated

import typer


def use_one_blas_thread() -> None:
    """Keep small linear systems on one core; must run before numpy is imported.

    On a busy machine the threads that wait for each other cost many times what they save, and
    sums would depend on their number.
    """
    for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(name, "1")


def option(name: str, help_text: str, **more: object) -> typer.models.OptionInfo:
    """Make an option, its help first."""
    made: typer.models.OptionInfo = typer.Option(name, help=help_text, **more)  # type: ignore[arg-type]
    return made


def argument(help_text: str, metavar: str) -> typer.models.ArgumentInfo:
    """Make a positional argument."""
    made: typer.models.ArgumentInfo = typer.Argument(help=help_text, metavar=metavar)
    return made


Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing but errors.")]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="Say more.")]
LogJson = Annotated[bool, typer.Option("--log-json", help="Log as JSON lines on standard error.")]
JsonPath = Annotated[
    Path | None, option("--json", "Write the numbers to this file.", metavar="FILE")
]
