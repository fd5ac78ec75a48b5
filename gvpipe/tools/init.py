"""Command line of ``gvpipe init``."""

from pathlib import Path
from typing import Annotated

import typer

from gvpipe.tools.options import Jobs, LogJson, Quiet, Verbose, argument, option, some_jobs


def add(app: typer.Typer) -> None:
    """Add the command."""
    app.command(
        "init",
        help="Look at pictures and write a configuration for them: cameras by self-calibration, "
        "EXIF or a guess, folders as robots, tilts. Asks nothing and says what it guessed; the "
        "one number to measure is the height of the camera.",
        epilog="Example: gvpipe init photos --height 1.35 && make run CONFIG=photos.yaml",
    )(init)


def init(
    folders: Annotated[list[Path], argument("Folders of pictures, globs or videos.", "FOLDER...")],
    height: Annotated[
        float | None,
        option(
            "--height",
            "Camera above the ground, metres (of all pictures: the median).",
            min=1e-3,
            max=1000,
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
        height_m=height,
        tilt_deg=tilt,
        focal_px=focal,
        calibrate=calibrate,
        force=force,
        jobs=some_jobs(jobs),
    )
