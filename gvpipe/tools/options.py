"""Options that several commands share."""

import os
from pathlib import Path
from typing import Annotated

import typer


def option(name: str, help_text: str, **more: object) -> typer.models.OptionInfo:
    """Make an option, its help first."""
    made: typer.models.OptionInfo = typer.Option(name, help=help_text, **more)  # type: ignore[arg-type]
    return made


def argument(help_text: str, metavar: str) -> typer.models.ArgumentInfo:
    """Make a positional argument."""
    made: typer.models.ArgumentInfo = typer.Argument(help=help_text, metavar=metavar)
    return made


def some_jobs(jobs: int | None) -> int:
    """Take the number of cores where `--jobs` is left out."""
    return jobs or len(os.sched_getaffinity(0))


ConfigPath = Annotated[Path, argument("Configuration, a YAML file.", "CONFIG")]
OutDir = Annotated[
    Path | None,
    option("--out", "Output folder.", metavar="DIR", show_default="`output` of CONFIG"),
]
Overrides = Annotated[
    list[str] | None, option("--set", "Override one key; may be repeated.", metavar="KEY=VALUE")
]
Jobs = Annotated[
    int | None, typer.Option("--jobs", "-j", min=1, help="Cores to use.", show_default="all")
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing but errors.")]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="Say more.")]
LogJson = Annotated[bool, typer.Option("--log-json", help="Log as JSON lines on standard error.")]
JsonPath = Annotated[
    Path | None, option("--json", "Write the numbers to this file.", metavar="FILE")
]
