"""``gvpipe calibrate``: intrinsics from a board, from the ground itself, or from another file."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np

from gvpipe.commands.output import write_file
from gvpipe.commands.photos import (
    Photo,
    evenly,
    list_photos,
    of_one_size,
    read_photo,
    shrink,
)
from gvpipe.core.calibration.board import Board, BoardView, calibrate_board, find_board
from gvpipe.core.calibration.common_plane import ground_pairs
from gvpipe.core.calibration.raw_matching import PlanePair, match_planes, raw_features
from gvpipe.core.calibration.self_calibration import EXPECTED_FOCAL, SelfCalibration, self_calibrate
from gvpipe.core.matching.features import Features
from gvpipe.core.types import Camera, Rejected
from gvpipe.errors import ConfigError, InputError, NoResultError
from gvpipe.formats.calibration import Calibration, read_calibration
from gvpipe.formats.calibration_writers import WRITERS
from gvpipe.formats.colmap import read_cameras
from gvpipe.names import escape
from gvpipe.report import Reporter, log

MOST_PICTURES = 24
"""Pictures used for self-calibration, evenly chosen."""

MOST_PAIRS = 110
"""Pairs of them that are matched: some ten seconds."""

NEAR = 3
"""Pictures at most this far apart in their order are matched first."""

MOST_BOARDS = 200
"""Photographs of a board that are read."""

WORKING_PIXELS = 1_000_000
"""Features are found on pictures of at most this size."""

LEAST_K2_GAIN = 2e-3
"""Distortion below this, as a share of the radius at the corner, is not written."""


@dataclass(frozen=True)
class GroundCalibration:
    """Outcome of self-calibration.

    Attributes
    ----------
    calibration : Calibration
        Intrinsics of the pictures.
    solution : SelfCalibration
        Focal length with its uncertainty; tilts, rolls and heights by number.
    photos : tuple of Photo
        The pictures by number.
    """

    calibration: Calibration
    solution: SelfCalibration
    photos: tuple[Photo, ...]


def from_ground(
    photos: Sequence[Photo],
    reporter: Reporter,
    *,
    jobs: int,
    focal_px: float | None = None,
    seed: int = 0,
) -> GroundCalibration | Rejected:
    """Self-calibrate from pictures of the ground.

    Parameters
    ----------
    photos : sequence of Photo
        Of one size, by one camera.
    reporter : Reporter
        Progress.
    jobs : int
        Threads; the result does not depend on them.
    focal_px : float, optional
        Where the search begins, for example by EXIF.
    seed : int
        For the choice of matches.

    Returns
    -------
    outcome : GroundCalibration or Rejected
    """
    chosen = evenly(photos, MOST_PICTURES)
    with (
        reporter.progress("features", len(chosen)) as ticker,
        ThreadPoolExecutor(max_workers=jobs) as pool,
    ):
        features: list[Features | Rejected] = []
        for found in pool.map(_features, chosen):
            features.append(found)
            ticker.advance()
    usable = [k for k, found in enumerate(features) if not isinstance(found, Rejected)]
    for photo, found in zip(chosen, features, strict=True):
        if isinstance(found, Rejected):
            log.warning("%s: %s", photo.name, found.reason)
    width, height = chosen[0].width, chosen[0].height
    couples = _couples(usable)
    scale = max(width, height) / 1000

    def match(couple: tuple[int, int]) -> list[PlanePair] | Rejected:
        first, second = features[couple[0]], features[couple[1]]
        assert isinstance(first, Features)
        assert isinstance(second, Features)
        return match_planes(*couple, first, second, scale)

    pairs: list[PlanePair] = []
    with (
        reporter.progress("planes", len(couples)) as ticker,
        ThreadPoolExecutor(max_workers=jobs) as pool,
    ):
        for planes in pool.map(match, couples):
            pairs += [] if isinstance(planes, Rejected) else planes
            ticker.advance()
    focal = focal_px or EXPECTED_FOCAL * width
    guess = Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    solution = self_calibrate(
        ground_pairs(pairs, guess),
        len(chosen),
        (width, height),
        np.random.default_rng(seed),
        expected_px=focal_px,
    )
    if isinstance(solution, Rejected):
        return solution
    return GroundCalibration(_calibration(solution, width, height), solution, tuple(chosen))


def _couples(pictures: Sequence[int]) -> list[tuple[int, int]]:
    """Choose pairs: all neighbours, and of the others as many as may be, evenly."""
    places = list(combinations(range(len(pictures)), 2))
    near = [(a, b) for a, b in places if b - a <= NEAR][:MOST_PAIRS]
    far = [(a, b) for a, b in places if b - a > NEAR]
    room = min(MOST_PAIRS - len(near), len(far))
    chosen = sorted({int(k) for k in np.linspace(0, len(far) - 1, room)}) if room > 0 else []
    return [(pictures[a], pictures[b]) for a, b in sorted(near + [far[k] for k in chosen])]


def _calibration(solution: SelfCalibration, width: int, height: int) -> Calibration:
    """Put a solution into a file's terms; distortion that moves nothing is left out."""
    f = solution.focal_px
    corner = float(np.hypot(width, height)) / 2 / f
    bend = abs(solution.k1) * corner**2 + abs(solution.k2) * corner**4
    lens = (solution.k1, solution.k2, 0.0, 0.0) if bend > LEAST_K2_GAIN else ()
    return Calibration(width, height, f, f, (width - 1) / 2, (height - 1) / 2, 0.0, lens)


def _features(photo: Photo) -> Features | Rejected:
    """Keypoints of a picture in pixels of its full size."""
    pixels = read_photo(photo)
    if isinstance(pixels, Rejected):
        return pixels
    smaller, scale = shrink(pixels, WORKING_PIXELS)
    found = raw_features(smaller)
    full = (found.pixels + 0.5) * scale - 0.5
    return replace(found, pixels=full, ground=full)


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

    Raises
    ------
    ConfigError
        If the file is wrong.
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
