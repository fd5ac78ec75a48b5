"""``gvpipe synth``: photographs of a made-up scene with everything known about it."""

import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from gvpipe.artefacts import canonical_json
from gvpipe.core.camera_path import circle, ground_sampling, line, mower, poses, shared_ground
from gvpipe.core.mesh import join
from gvpipe.core.pose import mount_of
from gvpipe.core.scene import Scene, make_scene, photograph
from gvpipe.core.solids import Kind, Solid
from gvpipe.core.texture import TEXTURES, of_picture
from gvpipe.core.types import Camera, Float, Image, Mount, Pose, Rejected
from gvpipe.errors import InputError, OutputError, UsageError
from gvpipe.formats.images import read_image
from gvpipe.formats.jpeg import jpeg_bytes
from gvpipe.formats.ply import encode_mesh
from gvpipe.formats.raster import png_bytes
from gvpipe.formats.strict_yaml import format_value
from gvpipe.formats.tum import format_tum, read_tum
from gvpipe.names import escape
from gvpipe.report import Reporter

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


def run(plan: Plan, folder: Path, reporter: Reporter) -> None:
    """Render the plan into a new folder.

    Parameters
    ----------
    plan : Plan
        What to photograph.
    folder : Path
        Must not exist, or be empty.
    reporter : Reporter
        Progress and the closing table.

    Raises
    ------
    OutputError
        If the folder holds something or cannot be written.
    InputError
        If the path's file or the ground's picture cannot be read.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise OutputError(f"{escape(str(folder))}: is not empty; name a new folder")
    shots = take_shots(plan)
    rng = np.random.default_rng([plan.seed, 2])
    scene = make_scene(_ground(plan), plan.solids, rng=rng)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        staged = Path(tempfile.mkdtemp(prefix=f".{folder.name}.writing-", dir=folder.parent))
        try:
            _write(plan, scene, shots, staged, reporter)
            staged.chmod(0o755)
            staged.replace(folder)
        finally:
            shutil.rmtree(staged, ignore_errors=True)
    except OSError as error:
        where = escape(str(error.filename or folder))
        raise OutputError(f"{where}: cannot be written: {error.strerror}") from error
    rows = (("images", f"{len(shots)} of {len(plan.solids)} solids"), *advice(plan, shots))
    names = ("config.yaml", "groundtruth.json", "obstacles.ply")
    reporter.result("gvpipe synth", rows, [folder / name for name in names])


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


def _ground(plan: Plan) -> Image:
    """Texture of the ground: made up, or a picture of the user's."""
    if plan.ground in TEXTURES:
        return TEXTURES[plan.ground](np.random.default_rng([plan.seed, 0]))
    picture = read_image(Path(plan.ground))
    if isinstance(picture, Rejected):
        known = ", ".join(TEXTURES)
        raise InputError(
            f"--ground {escape(plan.ground)}: {picture.reason}; expected {known} or a picture"
        )
    return of_picture(picture.pixels)


def _write(
    plan: Plan, scene: Scene, shots: Sequence[Shot], folder: Path, reporter: Reporter
) -> None:
    """Write everything into a folder of its own."""
    rng = np.random.default_rng([plan.seed, 3])
    for robot in dict.fromkeys(shot.robot for shot in shots):
        (folder / "images" / robot).mkdir(parents=True)
        (folder / "masks" / robot).mkdir(parents=True)
        own = [(s.timestamp, s.map_from_camera) for s in shots if s.robot == robot]
        (folder / f"{robot}.tum").write_text(format_tum(own), encoding="utf-8")
    with reporter.progress("render", len(shots)) as ticker:
        for shot in shots:
            seen = photograph(scene, plan.camera, shot.map_from_camera, plan.distortion)
            noisy = seen.pixels + rng.normal(scale=plan.noise, size=seen.pixels.shape)
            pixels = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
            data = png_bytes(pixels) if plan.png else jpeg_bytes(pixels)
            (folder / "images" / shot.robot / shot.name).write_bytes(data)
            mask = np.clip(seen.solids + 1, 0, 255).astype(np.uint8)
            path = folder / "masks" / shot.robot / Path(shot.name).with_suffix(".png")
            path.write_bytes(png_bytes(mask[..., None]))
            ticker.advance()
    surface = join([solid.surface for solid in plan.solids])
    (folder / "obstacles.ply").write_bytes(encode_mesh(surface))
    (folder / "groundtruth.json").write_text(canonical_json(_truth(plan, shots)), encoding="utf-8")
    (folder / "config.yaml").write_text(config_text(plan, shots), encoding="utf-8")


def config_text(plan: Plan, shots: Sequence[Shot]) -> str:
    """Write a configuration that runs on the pictures, as a careful user would."""
    cam, held = plan.camera, plan.mount
    intrinsics: dict[str, Any] = {"width": cam.width, "height": cam.height}
    intrinsics |= {k: round(float(getattr(cam, k)), 6) for k in ("fx", "fy", "cx", "cy")}
    if plan.distortion:
        intrinsics["distortion"] = list(plan.distortion)
    lines = [
        "# Made-up photographs; what is true of them is in groundtruth.json and *.tum.",
        "cameras:",
    ]
    lines += [f"  cam: {format_value(intrinsics)}", "robots:"]
    for robot in dict.fromkeys(shot.robot for shot in shots):
        mounts = [mount_of(s.map_from_camera) for s in shots if s.robot == robot]
        if plan.path not in ("circle", "line", "mower"):
            held = replace(
                held,
                tilt=float(np.median([m.tilt for m in mounts])),
                roll=float(np.median([m.roll for m in mounts])),
                height=float(np.median([m.height for m in mounts])),
            )
        entry = {"images": f"images/{robot}", "camera": "cam", "height": round(held.height, 4)}
        entry |= {"tilt": round(float(np.degrees(held.tilt)), 3)}
        entry |= {"roll": round(float(np.degrees(held.roll)), 3)}
        lines.append(f"  {robot}: {format_value(entry)}")
    lines += ["output: run", f"seed: {plan.seed}"]
    return "\n".join(lines) + "\n"


def _truth(plan: Plan, shots: Sequence[Shot]) -> dict[str, Any]:
    """Everything known, in the conventions of the artefacts; world is the map, ground z = 0."""
    images = []
    for shot in shots:
        held = mount_of(shot.map_from_camera)
        camera_from_map = shot.map_from_camera.inverse()
        images.append(
            {
                "file": f"images/{shot.robot}/{shot.name}",
                "image": f"{shot.robot}/{shot.name}",
                "robot": shot.robot,
                "width": plan.camera.width,
                "height": plan.camera.height,
                "K": plan.camera.matrix.tolist(),
                "dist": list(plan.distortion),
                "R": camera_from_map.rotation.tolist(),
                "t": camera_from_map.translation.tolist(),
                "C": shot.map_from_camera.translation.tolist(),
                "tilt_deg": float(np.degrees(held.tilt)),
                "roll_deg": float(np.degrees(held.roll)),
                "height_m": held.height,
            }
        )
    return {
        "schema": "gvpipe/groundtruth/1",
        "units": "metre",
        "frames": "x_camera = R X_map + t; camera x right, y down; map z up, ground z = 0",
        "nominal_height_m": plan.mount.height,
        "robots": list(dict.fromkeys(shot.robot for shot in shots)),
        "images": images,
        "obstacles": [_obstacle(k, solid) for k, solid in enumerate(plan.solids)],
    }


def _obstacle(number: int, solid: Solid) -> dict[str, Any]:
    corners: Float = solid.surface.vertices
    return {
        "id": number,
        "mask_value": number + 1,
        "kind": solid.kind,
        "x": solid.x,
        "y": solid.y,
        "yaw_deg": float(np.degrees(solid.yaw)),
        "size": list(solid.size),
        "bbox_min": corners.min(axis=0).tolist(),
        "bbox_max": corners.max(axis=0).tolist(),
    }
