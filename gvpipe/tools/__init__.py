"""Command lines, one group a module; what they do is in the layers below.

Nothing heavy is imported here before a command runs, so that ``gvpipe --help`` stays quick.
"""

import typer

from gvpipe.tools import calibrate, chain, config, evaluate, init, report, synth


def add_commands(app: typer.Typer) -> None:
    """Give the command line all it can do."""
    for group in (config, chain, init, calibrate, synth, evaluate, report):
        group.add(app)
