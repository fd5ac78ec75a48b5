"""What ``gvpipe synth`` is asked to photograph, and from where."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from gvpipe.core.geometry.pose import mount_of
from gvpipe.core.synthesis.camera_path import (
    circle,
    ground_sampling,
    line,
    mower,
    poses,
    shared_ground,
)
from gvpipe.core.synthesis.solids import Kind, Solid
from gvpipe.core.types import Camera, Mount, Pose
from gvpipe.errors import InputError, UsageError
from gvpipe.formats.tum import read_tum
from gvpipe.names import escape

COLOURS = ((0.95, 0.6, 0.4), (0.45, 0.65, 0.95), (0.95, 0.9, 0.45), (0.55, 0.9, 0.5))
"""Tints of the solids in turn: far from each other and from grey ground."""

ROBOTS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"

LEAST_SHARED = 0.35
"""Consecutive pictures that share less of their ground than this match badly."""


@dataclass(frozen=True)
class Plan:
    """What to photograph and how; lengths in metres, angles in radians.

    Attributes
    ----------
    solids : tuple of Solid
        What stands on the ground.
    ground : str
        A name of :data:`TEXTURES` or the path of a picture.
    path : str
        ``circle``, ``line``, ``mower`` or the path of a TUM file.
    images, robots, rows : int
        How many pictures, how many robots share them, and rows of the mower.
    radius, spacing : float
        Of the circle; between stops and rows.
    camera : Camera
        Intrinsics.
    distortion : tuple of float
        OpenCV order, empty for none.
    mount : Mount
        How the camera is held.
    shake : float
        Standard deviation of tilt, roll and heading.
    noise : float
        Standard deviation of the sensor's noise, grey levels.
    seed : int
        Fixes everything that is random.
    png : bool
        Write PNG rather than JPEG.
    """

    solids: tuple[Solid, ...]
    ground: str
    path: str
    images: int
    robots: int
    rows: int
    radius: float
    spacing: float
    camera: Camera
    distortion: tuple[float, ...]
    mount: Mount
    shake: float
    noise: float
    seed: int
    png: bool


@dataclass(frozen=True)
class Shot:
    """One picture to take."""

    robot: str
    name: str
    timestamp: float
    map_from_camera: Pose


def parse_solid(kind: Kind, text: str, number: int) -> Solid:
    """Read a solid from the command line.

    Parameters
    ----------
    kind : {'box', 'cylinder', 'sphere'}
        Which option it was given with.
    text : str
        ``x,y,width,depth,height[,yaw in degrees]`` of a box, ``x,y,radius,height`` of a
        cylinder, ``x,y,radius`` of a sphere; metres.
    number : int
        Its place among the solids, for its colour.

    Raises
    ------
    UsageError
        If the text is something else.
    """
    expected = {"box": "x,y,width,depth,height[,yaw]", "cylinder": "x,y,radius,height"}
    counts = {"box": (5, 6), "cylinder": (4,), "sphere": (3,)}[kind]
    wanted = expected.get(kind, "x,y,radius")
    try:
        values = [float(word) for word in text.split(",")]
    except ValueError:
        values = []
    sizes = values[2:5]
    if len(values) not in counts or not np.isfinite(values).all() or min(sizes) <= 0:
        raise UsageError(f"--{kind} {escape(text)}: expected {wanted} in metres, sizes above 0")
    colour = COLOURS[number % len(COLOURS)]
    x, y = values[:2]
    if kind == "box":
        yaw = np.radians(values[5]) if len(values) == 6 else 0.0
        return Solid("box", x, y, (sizes[0], sizes[1], sizes[2]), float(yaw), colour)
    height = sizes[1] if kind == "cylinder" else 2 * sizes[0]
    return Solid(kind, x, y, (2 * sizes[0], 2 * sizes[0], height), 0.0, colour)


def default_solids() -> tuple[Solid, ...]:
    """One of each kind, about the origin."""
    texts: list[tuple[Kind, str]] = [
        ("box", "0.05,-0.12,0.26,0.18,0.22,25"),
        ("cylinder", "0.02,0.22,0.08,0.3"),
        ("sphere", "-0.22,0.02,0.09"),
    ]
    return tuple(parse_solid(kind, text, k) for k, (kind, text) in enumerate(texts))


def take_shots(plan: Plan) -> list[Shot]:
    """Work out every camera pose."""
    rng = np.random.default_rng([plan.seed, 1])
    stamped: list[tuple[float, Pose]]
    if plan.path in ("circle", "line", "mower"):
        stops = {
            "circle": lambda: circle(plan.images, plan.radius),
            "line": lambda: line(plan.images, plan.spacing),
            "mower": lambda: mower(plan.images, plan.spacing, plan.rows),
        }[plan.path]()
        carried = poses(stops, plan.mount, plan.shake, rng)
        stamped = [(float(k), pose) for k, pose in enumerate(carried)]
    else:
        if not Path(plan.path).is_file():
            expected = "circle, line, mower or a TUM file of camera poses"
            raise InputError(f"--path {escape(plan.path)}: no such file; expected {expected}")
        stamped = read_tum(Path(plan.path))
        low = [k for k, (_, pose) in enumerate(stamped) if pose.translation[2] <= 0]
        if not stamped or low:
            problem = f"pose {low[0] + 1} is not above the ground" if low else "holds no pose"
            raise InputError(f"{escape(plan.path)}: {problem}; expected camera to map, z up")
    end = "png" if plan.png else "jpg"
    shots = []
    for robot, part in zip(ROBOTS, np.array_split(np.arange(len(stamped)), plan.robots)):  # noqa: B905
        shots += [Shot(robot, f"{n:04d}.{end}", *stamped[k]) for n, k in enumerate(part)]
    return shots


def advice(plan: Plan, shots: Sequence[Shot]) -> list[tuple[str, str]]:
    """Say what the plan means for matching: rows of the closing table."""
    lower, middle = ground_sampling(plan.camera, mount_of(shots[0].map_from_camera))
    shared = [
        shared_ground(plan.camera, i.map_from_camera, j.map_from_camera)
        for i, j in pairwise(shots)
        if i.robot == j.robot
    ]
    rows = [
        ("a pixel on the ground", f"{1e3 * lower:.2f} mm nearest, {1e3 * middle:.2f} mm middle")
    ]
    if shared:
        low, mean = 100 * min(shared), 100 * float(np.mean(shared))
        rows.append(
            ("consecutive pictures share", f"{mean:.0f} % of their ground, least {low:.0f} %")
        )
        if min(shared) < LEAST_SHARED:
            hint = f"below {100 * LEAST_SHARED:.0f} % pairs may fail: stop more often or tilt less"
            rows.append(("advice", hint))
    return rows
