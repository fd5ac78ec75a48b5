"""The configuration that ``gvpipe init`` writes: few keys, each with a word on where it is from."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from gvpipe.commands.ground_calibration import GroundCalibration
from gvpipe.formats.calibration import Calibration
from gvpipe.formats.calibration_writers import format_gvpipe
from gvpipe.formats.strict_yaml import format_value


@dataclass(frozen=True)
class CameraGuess:
    """Intrinsics, and where they come from in words."""

    calibration: Calibration
    source: str

    @classmethod
    def solved(cls, outcome: GroundCalibration) -> "CameraGuess":
        """Take self-calibrated intrinsics."""
        s = outcome.solution
        source = f"self-calibrated from {len(s.tilt)} pictures, ± {s.focal_sigma_px:.1f} px"
        return cls(outcome.calibration, source)

    @classmethod
    def plain(cls, width: int, height: int, focal_px: float, source: str) -> "CameraGuess":
        """Make a camera of a focal length alone."""
        f, cx, cy = round(focal_px, 2), (width - 1) / 2, (height - 1) / 2
        return cls(Calibration(width, height, f, f, cx, cy), source)


@dataclass(frozen=True)
class RobotGuess:
    """One robot of the configuration.

    Attributes
    ----------
    name : str
        Its name.
    images : Path
        Absolute.
    camera : str
        Name of its camera.
    height_m : float
        Of the camera.
    measured : bool
        Whether somebody measured that.
    tilt : str
        Degrees, or ``auto``.
    roll_deg : float
        Degrees.
    overrides : mapping of str to (float, float, float)
        Tilt, height and roll of single pictures, by file name.
    said : str
        The tilt in words.
    """

    name: str
    images: Path
    camera: str
    height_m: float
    measured: bool
    tilt: str
    roll_deg: float
    overrides: Mapping[str, tuple[float, float, float]]
    said: str


def config_text(
    path: Path,
    cameras: Mapping[str, CameraGuess],
    robots: Sequence[RobotGuess],
    exhaustive: bool,
    resolution_m: float,
) -> str:
    """Write the configuration.

    Parameters
    ----------
    path : Path
        Where it will lie; paths in it are relative to its folder.
    cameras, robots
        What was guessed.
    exhaustive : bool
        Match all pictures with each other.
    resolution_m : float
        Of the map.
    """
    lines = [
        "# Written by `gvpipe init`. Lengths in metres, angles in degrees; `gvpipe config show`",
        "# lists every other key with its default. Change what you know better.",
        "cameras:",
    ]
    for name, guess in cameras.items():
        lines.append(f"  # {guess.source}")
        lines += ["  " + line for line in format_gvpipe(guess.calibration, name).splitlines()]
    lines.append("robots:")
    for robot in robots:
        lines += _robot_lines(robot, path.parent)
    pairs = "exhaustive" if exhaustive else "consecutive"
    unit = "metres a pixel of the map"
    if not all(robot.measured for robot in robots):
        unit += "; in proportion to height: change both"
    why = "few pictures: all with each other" if exhaustive else "each with the next"
    lines += [
        f"output: {format_value('runs/' + path.stem)}",
        f"match: {{pairs: {pairs}}}  # {why}",
        f"mosaic: {{resolution: {resolution_m:g}}}  # {unit}",
    ]
    return "\n".join(lines) + "\n"


def _robot_lines(robot: RobotGuess, base: Path) -> list[str]:
    """Lines of one robot."""
    relative = Path(os.path.relpath(robot.images, base))
    where = robot.images if relative.parts[:3] == ("..", "..", "..") else relative
    told = "metres, as measured; every length scales with it"
    if not robot.measured:
        told = "NOT MEASURED: set it, in metres; every length scales with it"
    lines = [
        f"  {format_value(robot.name)}:",
        f"    images: {format_value(str(where))}",
        f"    camera: {format_value(robot.camera)}",
        f"    height: {robot.height_m:g}  # {told}",
        f"    tilt: {robot.tilt}  # below the horizon",
    ]
    if robot.roll_deg:
        lines.append(f"    roll: {robot.roll_deg:g}  # clockwise seen from behind the camera")
    if robot.overrides:
        lines.append("    overrides:  # held by hand: each picture's own, from self-calibration")
        if not robot.measured:  # absolute heights would not follow the one to be set
            lines.append(
                "      # no heights while that of the robot is not measured: slam finds them"
            )
        for name, (tilt, height, roll) in robot.overrides.items():
            own = f"height: {height:g}, " if robot.measured else ""
            lines.append(f"      {format_value(name)}: {{tilt: {tilt:g}, {own}roll: {roll:g}}}")
    return lines
