"""``gvpipe calibrate``: intrinsics from a board, from the ground itself, or from another file."""

from pathlib import Path

import numpy as np

from gvpipe.commands.ground_calibration import MOST_PICTURES, from_ground
from gvpipe.commands.output import write_file
from gvpipe.commands.photos import evenly, list_photos, of_one_size, read_photo
from gvpipe.core.calibration.board import Board, BoardView, calibrate_board, find_board
from gvpipe.core.types import Rejected
from gvpipe.errors import ConfigError, InputError, NoResultError
from gvpipe.formats.calibration import Calibration, read_calibration
from gvpipe.formats.calibration_writers import WRITERS
from gvpipe.formats.colmap import read_cameras
from gvpipe.names import escape
from gvpipe.report import Reporter, log

MOST_BOARDS = 200
"""Photographs of a board that are read."""


def ground(
    path: Path,
    reporter: Reporter,
    *,
    jobs: int,
    focal_px: float | None,
    out: Path | None,
    style: str | None,
) -> None:
    """Self-calibrate and write the result.

    Parameters
    ----------
    path : Path
        Folder, glob or video.
    reporter : Reporter
        Progress and the table.
    jobs : int
        Threads.
    focal_px : float, optional
        Where the search begins; else EXIF, else a field of view of 60 degrees.
    out : Path, optional
        File to write.
    style : str, optional
        A key of :data:`WRITERS`; by default OpenCV's in a file, lines for CONFIG on the screen.

    Raises
    ------
    InputError
        If there are no pictures.
    NoResultError
        If the pictures leave the focal length open.
    """
    where = escape(str(path))
    photos = of_one_size(list_photos(path, MOST_PICTURES), where)
    expected = focal_px or photos[0].focal_px
    outcome = from_ground(photos, reporter, jobs=jobs, focal_px=expected)
    if isinstance(outcome, Rejected):
        raise NoResultError(f"{where}: {outcome.reason}")
    s, c = outcome.solution, outcome.calibration
    tilts = np.degrees(list(s.tilt.values()))
    rows = [
        ("pictures", f"{len(s.tilt)} of {len(photos)}, {s.matches} matches, {s.error_px:.2f} px"),
        ("focal length", f"{s.focal_px:.1f} ± {s.focal_sigma_px:.1f} px"),
        ("distortion", f"k1 {s.k1:.4f}, k2 {s.k2:.4f}"),
        ("tilt", f"{np.median(tilts):.1f}° (from {tilts.min():.1f} to {tilts.max():.1f})"),
    ]
    rows += [
        (
            outcome.photos[k].name,
            f"tilt {np.degrees(s.tilt[k]):.2f} ± {np.degrees(s.tilt_sigma[k]):.2f}°, "
            f"roll {np.degrees(s.roll[k]):.2f}°, height {s.height[k]:.3f} of the median",
        )
        for k in s.tilt
    ]
    _write(c, out, style, "ground", rows, reporter)


def board(
    path: Path, pattern: Board, reporter: Reporter, *, out: Path | None, style: str | None
) -> None:
    """Calibrate from photographs of a board and write the result.

    Parameters
    ----------
    path : Path
        Folder, glob or video.
    pattern : Board
        What was printed.
    reporter : Reporter
        Progress and the table.
    out : Path, optional
        File to write.
    style : str, optional
        A key of :data:`WRITERS`; by default OpenCV's in a file, lines for CONFIG on the screen.

    Raises
    ------
    InputError
        If there are no pictures.
    NoResultError
        If too few show the board.
    """
    where = escape(str(path))
    photos = evenly(of_one_size(list_photos(path, MOST_BOARDS), where), MOST_BOARDS)
    views: list[BoardView] = []
    names: list[str] = []
    with reporter.progress("boards", len(photos)) as ticker:
        for photo in photos:
            pixels = read_photo(photo)
            view = pixels if isinstance(pixels, Rejected) else find_board(pixels, pattern)
            ticker.advance()
            if isinstance(view, Rejected):
                log.warning("%s: %s", photo.name, view.reason)
                continue
            views.append(view)
            names.append(photo.name)
    width, height = photos[0].width, photos[0].height
    found = calibrate_board(views, (width, height))
    if isinstance(found, Rejected):
        raise NoResultError(f"{where}: {found.reason}")
    k, s = found.matrix, found.sigma
    rows = [
        ("pictures", f"{len(views)} of {len(photos)}, {found.error_px:.3f} px"),
        ("focal length", f"{k[0, 0]:.2f} ± {s[0]:.2f}, {k[1, 1]:.2f} ± {s[1]:.2f} px"),
        ("principal point", f"{k[0, 2]:.2f} ± {s[2]:.2f}, {k[1, 2]:.2f} ± {s[3]:.2f} px"),
        ("distortion", ", ".join(f"{v:.4g}" for v in found.distortion)),
        *zip(names, (f"{e:.3f} px" for e in found.view_errors_px), strict=True),
    ]
    fx, fy, cx, cy = (float(v) for v in (k[0, 0], k[1, 1], k[0, 2], k[1, 2]))
    calibration = Calibration(width, height, fx, fy, cx, cy, 0.0, found.distortion)
    _write(calibration, out, style, "board", rows, reporter)


def convert(
    path: Path, reporter: Reporter, *, name: str, out: Path | None, style: str | None
) -> None:
    """Read a calibration in one format, write it in another.

    Parameters
    ----------
    path : Path
        What :func:`gvpipe.formats.calibration.read_calibration` reads, or COLMAP's `cameras.txt`.
    reporter : Reporter
        The table.
    name : str
        Which camera, where the file holds several; else the first, if it is COLMAP's.
    out : Path, optional
        File to write.
    style : str, optional
        As for :func:`board`.

    Raises
    ------
    ConfigError, InputError
        If the file is wrong, or the other format has no place for what it says.
    """
    if path.name == "cameras.txt":
        cameras = read_cameras(path)
        key = int(name) if name.isdecimal() else next(iter(cameras), 0)
        if key not in cameras:
            known = ", ".join(map(str, cameras)) or "none"
            raise ConfigError(f"{escape(str(path))}: no camera {escape(name)} (known: {known})")
        calibration = cameras[key]
    else:
        calibration = read_calibration(path, name)
    size = f"{calibration.width}x{calibration.height}"
    rows = [("camera", f"{size}, focal length {calibration.fx:.2f}, {calibration.fy:.2f} px")]
    _write(calibration, out, style, "convert", rows, reporter)


def _write(
    calibration: Calibration,
    out: Path | None,
    style: str | None,
    what: str,
    rows: list[tuple[str, str]],
    reporter: Reporter,
) -> None:
    """Write the file, print the table; without a file, what it would hold."""
    style = style or ("opencv" if out is not None else "gvpipe")
    try:
        text = WRITERS[style](calibration, "cam" if style != "kalibr" else "cam0")
    except ValueError as error:
        raise InputError(f"--format {style}: {error}") from error
    if out is not None:
        write_file(out, text)
    reporter.result(f"gvpipe calibrate {what}", rows, [out] if out else [])
    if out is None:
        reporter.text(text)
