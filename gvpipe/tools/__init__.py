"""Command lines of the tools around the chain; what they do is in :mod:`gvpipe.commands`.

Nothing heavy is imported here before a command runs, so that ``gvpipe --help`` stays quick.
"""

import typer

from gvpipe.tools import evaluate, synth


def add_tools(app: typer.Typer) -> None:
    """Give the command line its tools."""
    synth.add(app)
    evaluate.add(app)
