"""``gvpipe init``: look at pictures, guess what can be guessed, write a configuration."""

import re
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from gvpipe.commands.found_robots import Found, find_robots, upright
from gvpipe.commands.ground_calibration import GroundCalibration, from_ground
from gvpipe.commands.init_text import CameraGuess, RobotGuess, config_text
from gvpipe.commands.output import write_file
from gvpipe.configcheck import HIGH_M
from gvpipe.configfile import load_config
from gvpipe.core.calibration.self_calibration import EXPECTED_FOCAL
from gvpipe.core.types import Rejected
from gvpipe.dataset import open_dataset
from gvpipe.errors import OutputError, UsageError
from gvpipe.names import escape
from gvpipe.report import Reporter, shortest

MOST_EXHAUSTIVE = 20
"""So many pictures or fewer are all matched with each other: whoever walks about with a phone
comes by the same place in no order."""

NICE = (1.0, 2.0, 5.0)
"""Leading digits of the map's resolution."""

MOST_MAP_PX = 3000
"""Side of the map, pixels, that the resolution aims below."""

RANGE_HEIGHTS = 4.0
"""Ground seen from one place, in camera heights, when the map's size is guessed."""


def run(
    folders: Sequence[Path],
    reporter: Reporter,
    *,
    out: Path | None,
    heights_m: Mapping[str, float],
    tilt_deg: float | None,
    focal_px: float | None,
    calibrate: bool,
    force: bool,
    jobs: int,
) -> None:
    """Write a configuration for pictures.

    Parameters
    ----------
    folders : sequence of Path
        Folders (or videos, or globs); a folder of folders is one robot each.
    reporter : Reporter
        Says what was found and guessed.
    out : Path, optional
        Configuration to write; default is beside the first folder, under its name.
    heights_m : mapping of str to float
        Measured heights by robot; that of ``""`` is for all others.
    tilt_deg, focal_px : float, optional
        What the user knows better than a guess.
    calibrate : bool
        Self-calibrate from the ground.
    force : bool
        Replace an existing configuration.
    jobs : int
        Threads.

    Raises
    ------
    InputError
        If there are no pictures.
    UsageError
        If a height is given for a robot that there is not.
    OutputError
        If the configuration exists, or cannot be written.
    """
    first = folders[0].absolute()
    path = (
        out or first.parent / f"{re.sub('[*?[].*', '', first.stem) or 'photos'}.yaml"
    ).absolute()
    if path.exists() and not force:
        raise OutputError(f"{escape(str(path))}: exists; --force replaces it, --out names another")
    found = find_robots(folders)
    _check_names(heights_m, [robot.name for robot in found])
    found = [upright(robot, path.parent) for robot in found]
    said: list[tuple[str, str]] = []
    robots, cameras = _guess(found, reporter, said, heights_m, tilt_deg, focal_px, calibrate, jobs)
    count = sum(len(robot.photos) for robot in found)
    exhaustive = count <= MOST_EXHAUSTIVE
    resolution = _resolution(robots, cameras)
    text = config_text(path, cameras, robots, exhaustive, resolution)
    write_file(path, text)
    open_dataset(load_config(path), jobs=jobs)
    said.append(("map", f"{resolution:g} m a pixel"))
    said += _heights(robots)
    config = shlex.quote(shortest(path))
    said += [("next", f"gvpipe run {config}"), ("then", f"gvpipe report {config}")]
    reporter.result("gvpipe init", said, [path])


def _check_names(heights_m: Mapping[str, float], names: Sequence[str]) -> None:
    """Each height is of a robot that there is."""
    for name in heights_m:
        if name and name not in names:
            known = f"expected one of {', '.join(names)}"
            raise UsageError(f"--height {escape(name)}=...: no such robot; {known}")


def _heights(robots: Sequence[RobotGuess]) -> list[tuple[str, str]]:
    """Say what is taken for the height of each robot's camera."""
    unknown = [robot.name for robot in robots if not robot.measured]
    rows = [
        (
            f"{robot.name}: height",
            f"{robot.height_m:g} m, the median of its pictures"
            + ": higher than floors are mapped from; in metres?" * (robot.height_m > HIGH_M),
        )
        for robot in robots
        if robot.measured
    ]
    if unknown:
        whose = ", ".join(f"robots.{name}.height" for name in unknown)
        rows.append(("height", f"NOT MEASURED, taken as 1; set {whose} or give --height METRES"))
    if len(robots) > 1:
        rows.append(("heights", f"--height {robots[-1].name}=METRES is for one robot"))
    return rows


def _guess(
    found: Sequence[Found],
    reporter: Reporter,
    said: list[tuple[str, str]],
    heights_m: Mapping[str, float],
    tilt_deg: float | None,
    focal_px: float | None,
    calibrate: bool,
    jobs: int,
) -> tuple[list[RobotGuess], dict[str, CameraGuess]]:
    """Calibrate each robot's camera, or fall back on EXIF and on the common field of view."""
    robots: list[RobotGuess] = []
    cameras: dict[str, CameraGuess] = {}
    solved: dict[tuple[int, int, str], str] = {}
    for robot in found:
        photo = robot.photos[0]
        said.append((robot.name, f"{len(robot.photos)} pictures of {photo.width}x{photo.height}"))
        key = (photo.width, photo.height, photo.model)
        expected = focal_px or photo.focal_px
        outcome: GroundCalibration | Rejected = Rejected("not tried")
        if calibrate and focal_px is None:
            outcome = from_ground(robot.photos, reporter, jobs=jobs, focal_px=expected)
        camera = f"cam_{robot.name}"
        if isinstance(outcome, GroundCalibration):
            cameras[camera] = CameraGuess.solved(outcome)
            solved.setdefault(key, camera)
        elif calibrate and focal_px is None:
            said.append((f"{robot.name}: no self-calibration", outcome.reason))
        if isinstance(outcome, Rejected):
            known = solved.get(key)
            if known is not None:
                camera = known
                said.append((f"{robot.name}: camera", f"taken to be that of {known}"))
            else:
                focal = expected or EXPECTED_FOCAL * max(photo.width, photo.height)
                source = (
                    "given"
                    if focal_px
                    else f"EXIF, {photo.focal_source}"
                    if photo.focal_px
                    else "a guess: 60 degrees from side to side"
                )
                cameras[camera] = CameraGuess.plain(photo.width, photo.height, focal, source)
        guess = cameras[camera]
        said.append(
            (f"{robot.name}: focal length", f"{guess.calibration.fx:.1f} px ({guess.source})")
        )
        measured = heights_m.get(robot.name, heights_m.get(""))
        robots.append(_robot_guess(robot, camera, outcome, measured, tilt_deg))
        said.append((f"{robot.name}: tilt", robots[-1].said))
    return robots, cameras


def _robot_guess(
    robot: Found,
    camera: str,
    outcome: GroundCalibration | Rejected,
    measured_m: float | None,
    tilt_deg: float | None,
) -> RobotGuess:
    """Say how a robot holds its camera."""
    height_m, measured = measured_m or 1.0, measured_m is not None
    if isinstance(outcome, Rejected):
        tilt = "auto" if tilt_deg is None else f"{tilt_deg:g}"
        said = "auto: found while matching" if tilt_deg is None else f"{tilt_deg:g}°, given"
        return RobotGuess(robot.name, robot.images, camera, height_m, measured, tilt, 0.0, {}, said)
    s = outcome.solution
    tilts = {k: float(np.degrees(v)) for k, v in s.tilt.items()}
    rolls = {k: float(np.degrees(v)) for k, v in s.roll.items()}
    level, roll = float(np.median(list(tilts.values()))), float(np.median(list(rolls.values())))
    overrides = {
        outcome.photos[k].name: (
            round(tilts[k], 1),
            round(height_m * s.height[k], 4),
            round(rolls[k], 1),
        )
        for k in tilts
    }
    spread = max(tilts.values()) - min(tilts.values())
    said = f"{level:.1f}° (from {min(tilts.values()):.1f} to {max(tilts.values()):.1f})"
    steady = spread < 2.0 and max(s.height.values()) < 1.03 and min(s.height.values()) > 0.97
    return RobotGuess(
        robot.name,
        robot.images,
        camera,
        height_m,
        measured,
        f"{level:.1f}",
        round(roll, 1),
        {} if steady else overrides,
        said if steady else f"{said}, held by hand",
    )


def _resolution(robots: Sequence[RobotGuess], cameras: dict[str, CameraGuess]) -> float:
    """Size of the map's pixels: about twice what the pictures show, on a map that stays small."""
    finest = np.inf
    for robot in robots:
        tilt = 40.0 if robot.tilt == "auto" else float(robot.tilt)
        distance = robot.height_m / max(np.sin(np.radians(tilt)), 0.2)
        finest = min(finest, 2 * distance / cameras[robot.camera].calibration.fx)
    reach = 2 * RANGE_HEIGHTS * max(robot.height_m for robot in robots)
    wanted = max(finest, reach / MOST_MAP_PX)
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(
        min((step * power for step in (*NICE, 10.0)), key=lambda m: abs(np.log(m / wanted)))
    )
