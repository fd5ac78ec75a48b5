"""Command lines of ``gvpipe calibrate``."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from gvpipe.errors import UsageError
from gvpipe.tools.options import Jobs, LogJson, Quiet, Verbose, argument, option, some_jobs

Style = Annotated[
    Literal["opencv", "ros", "kalibr", "colmap", "gvpipe"] | None,
    option(
        "--format",
        "Format of the file; gvpipe reads all but `gvpipe`, which is for pasting.",
        show_default="opencv; without --out gvpipe",
    ),
]
Out = Annotated[Path | None, option("--out", "File to write; else it is printed.", metavar="FILE")]
Photos = Annotated[Path, argument("Folder, glob or video.", "PHOTOS")]


def add(app: typer.Typer) -> None:
    """Add the commands."""
    calibrate = typer.Typer(
        help="Find a camera's intrinsics: from a board, from the ground, or from another file.",
        no_args_is_help=True,
    )
    app.add_typer(calibrate, name="calibrate")
    calibrate.command(
        "ground",
        help="Self-calibration: focal length, radial distortion and tilts from three or more "
        "pictures of textured ground, taken with one camera in different directions. Exit code "
        "5 if the motion leaves the focal length open.",
        epilog="Example: gvpipe calibrate ground photos --out camera.yaml",
    )(calibrate_ground)
    calibrate.command(
        "board",
        help="Intrinsics from photographs of a chessboard or, with --marker, a ChArUco board.",
        epilog="Example: gvpipe calibrate board photos --board 9x6 --square 0.025",
    )(calibrate_board)
    calibrate.command(
        "convert",
        help="Rewrite a calibration (OpenCV, ROS camera_info, Kalibr, COLMAP cameras.txt).",
        epilog="Example: gvpipe calibrate convert camchain.yaml --format ros --out cam.yaml",
    )(calibrate_convert)


def calibrate_ground(
    photos: Photos,
    focal: Annotated[
        float | None,
        option("--focal", "Where to begin, pixels.", min=10, show_default="EXIF, else 60° wide"),
    ] = None,
    out: Out = None,
    style: Style = None,
    jobs: Jobs = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
    log_json: LogJson = False,
) -> None:
    """Calibrate from the ground."""
    from gvpipe.commands.calibrate import ground
    from gvpipe.report import Reporter

    reporter = Reporter(quiet=quiet, verbose=verbose, log_json=log_json)
    ground(photos, reporter, jobs=some_jobs(jobs), focal_px=focal, out=out, style=style)


def calibrate_board(
    photos: Photos,
    board: Annotated[
        str, option("--board", "COLUMNSxROWS: inner corners of a chessboard, squares of ChArUco.")
    ],
    square: Annotated[float, option("--square", "Side of a square, metres.", min=1e-4)],
    marker: Annotated[
        float, option("--marker", "Side of a ChArUco marker (4x4_250), metres; 0 = chessboard.")
    ] = 0.0,
    out: Out = None,
    style: Style = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
    log_json: LogJson = False,
) -> None:
    """Calibrate from a board."""
    columns, cross, rows = board.partition("x")
    if not cross or not columns.isdecimal() or not rows.isdecimal():
        raise UsageError(f"--board {board!r}: expected COLUMNSxROWS, for example 9x6")
    if not 3 <= int(columns) <= 99 or not 3 <= int(rows) <= 99 or not 0 <= marker < square:
        raise UsageError("--board, --marker: expected 3 to 99 columns and rows, marker < square")
    from gvpipe.commands.calibrate import board as run
    from gvpipe.core.calibration.board import Board
    from gvpipe.report import Reporter

    reporter = Reporter(quiet=quiet, verbose=verbose, log_json=log_json)
    pattern = Board(int(columns), int(rows), square, marker)
    run(photos, pattern, reporter, out=out, style=style)


def calibrate_convert(
    source: Annotated[Path, argument("Calibration to read.", "FILE")],
    name: Annotated[str, option("--name", "Which camera, where the file holds several.")] = "",
    out: Out = None,
    style: Style = None,
    quiet: Quiet = False,
) -> None:
    """Convert a calibration."""
    from gvpipe.commands.calibrate import convert
    from gvpipe.report import Reporter

    convert(source, Reporter(quiet=quiet), name=name, out=out, style=style)
