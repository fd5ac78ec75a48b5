"""Command lines of the tools around the chain; what they do is in :mod:`gvpipe.commands`.

Nothing heavy is imported here before a command runs, so that ``gvpipe --help`` stays quick.
"""

import typer

from gvpipe.tools import calibrate, evaluate, init, report, synth


def add_tools(app: typer.Typer) -> None:
    """Give the command line its tools."""
    init.add(app)
    calibrate.add(app)
    synth.add(app)
    evaluate.add(app)
    report.add(app)
