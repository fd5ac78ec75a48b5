"""Command line of ``gvpipe init``."""

from pathlib import Path
from typing import Annotated

import typer

from gvpipe.errors import UsageError
from gvpipe.tools.options import Jobs, LogJson, Quiet, Verbose, argument, option, some_jobs

LEAST_M, MOST_M = 1e-3, 1000.0
"""Heights that a camera may have."""


def add(app: typer.Typer) -> None:
    """Add the command."""
    app.command(
        "init",
        help="Look at pictures and write a configuration for them: cameras by self-calibration, "
        "EXIF or a guess, folders as robots, tilts. Asks nothing and says what it guessed; the "
        "one number to measure is the height of the camera.",
        epilog="Example: gvpipe init photos --height 1.35 && gvpipe run photos.yaml",
    )(init)


def init(
    folders: Annotated[list[Path], argument("Folders of pictures, globs or videos.", "FOLDER...")],
    height: Annotated[
        list[str] | None,
        option(
            "--height",
            "Camera above the ground, metres: the median of each robot's pictures. Robots of "
            "different heights: ROBOT=METRES for each, by the name of its folder.",
            metavar="[ROBOT=]METRES",
        ),
    ] = None,
    tilt: Annotated[
        float | None,
        option(
            "--tilt", "Degrees below the horizon, where self-calibration fails.", min=0.1, max=90
        ),
    ] = None,
    focal: Annotated[
        float | None, option("--focal", "Focal length, pixels; no self-calibration.", min=10)
    ] = None,
    calibrate: Annotated[
        bool, option("--calibrate/--no-calibrate", "Self-calibrate from the ground.")
    ] = True,
    out: Annotated[
        Path | None, option("--out", "Configuration to write.", metavar="CONFIG")
    ] = None,
    force: Annotated[bool, option("--force", "Replace an existing configuration.")] = False,
    jobs: Jobs = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
    log_json: LogJson = False,
) -> None:
    """Write a configuration."""
    from gvpipe.commands.init import run
    from gvpipe.report import Reporter

    run(
        folders,
        Reporter(quiet=quiet, verbose=verbose, log_json=log_json),
        out=out,
        heights_m=dict(map(_height, height or ())),
        tilt_deg=tilt,
        focal_px=focal,
        calibrate=calibrate,
        force=force,
        jobs=some_jobs(jobs),
    )


def _height(text: str) -> tuple[str, float]:
    """Read one height, and the robot it is of; no name means all."""
    robot, _, number = text.rpartition("=")
    try:
        metres = float(number)
    except ValueError:
        metres = 0.0
    if not LEAST_M <= metres <= MOST_M:
        expected = f"a number of metres from {LEAST_M:g} to {MOST_M:g}, for example 0.379"
        raise UsageError(f"--height {text!r}: expected {expected}")
    return robot, metres
