"""A very small set, commands run on it as processes, and what must hold of what they leave."""

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from gvpipe.core.geometry.pose import planar_pose
from gvpipe.core.types import Camera, Mount
from tests.synthetic import Box, Scene, texture

STAGES = ("match", "localize", "overlap", "slam", "mosaic", "reconstruct")
COMMANDS: dict[str, tuple[str, ...]] = {stage: (stage,) for stage in STAGES} | {"run": STAGES}
"""The stages that each command makes."""
CAMERA = Camera(width=200, height=150, fx=170.0, fy=170.0, cx=99.5, cy=74.5)
TILT_DEG, HEIGHT, RADIUS = 42.0, 0.6, 0.75
HEADINGS = {"A": (0, 40, 80), "B": (100, 140, 180)}
REPOSITORY = Path(__file__).parents[2]


def make_small_set(folder: Path) -> Path:
    """Photograph a box from six places; return the configuration."""
    rng = np.random.default_rng(3)
    faces = np.clip(texture(rng, 512).astype(int) @ np.diag([1.1, 0.7, 0.5]), 0, 255)
    box = Box((-0.11, -0.08, 0.0), (0.11, 0.08, 0.16), faces.astype(np.uint8))
    scene = Scene(texture(rng), boxes=(box,))
    for robot, bearings in HEADINGS.items():
        (folder / robot).mkdir(parents=True)
        for k, bearing in enumerate(bearings):
            angle = float(np.radians(bearing))
            mount = Mount(np.radians(TILT_DEG), 0.0, HEIGHT)
            pose = planar_pose(-RADIUS * np.cos(angle), -RADIUS * np.sin(angle), angle, mount)
            picture = scene.photograph(pose, CAMERA, noise=1.0, rng=rng)
            write_png(folder / robot / f"{k}.png", picture)
    c = CAMERA
    config = folder / "small.yaml"
    config.write_text(
        f"""cameras:
  cam: {{width: {c.width}, height: {c.height}, fx: {c.fx}, fy: {c.fy}, cx: {c.cx}, cy: {c.cy}}}
robots:
  A: {{images: A, camera: cam, height: {HEIGHT}, tilt: {TILT_DEG + 1}}}
  B: {{images: B, camera: cam, height: {HEIGHT}, tilt: {TILT_DEG - 1}}}
output: run
mosaic: {{resolution: 0.01}}
reconstruct: {{grid: [32, 32, 20], iterations: 60}}
"""
    )
    return config


def write_png(path: Path, picture: np.ndarray) -> None:
    """Write RGB pixels."""
    ok, png = cv2.imencode(".png", picture[..., ::-1])
    assert ok
    path.write_bytes(png.tobytes())


@dataclass(frozen=True)
class Ended:
    """How a command ended."""

    code: int
    out: str
    err: str


def start(stage: str, config: Path, *options: str, **environment: str) -> subprocess.Popen[str]:
    """Start a command in a session of its own, so that everything it starts can be found."""
    command = [sys.executable, "-m", "gvpipe", stage, str(config), *options]
    return subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        cwd=REPOSITORY,
        env={**os.environ, **environment},
        start_new_session=True,
    )


def run(stage: str, config: Path, *options: str, **environment: str) -> Ended:
    """Run a command to its end."""
    process = start(stage, config, *options, **environment)
    out, err = process.communicate(timeout=300)
    return Ended(process.returncode, out, err)


def session_members(session: int) -> list[int]:
    """Processes of a session that still run."""
    members = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, _, of = path.read_text().rpartition(")")[2].split()[:4]
        except OSError:  # it ended meanwhile
            continue
        if int(of) == session and state != "Z":
            members.append(int(path.parent.name))
    return members


def snapshot(out: Path, stages: tuple[str, ...] = STAGES) -> dict[str, bytes]:
    """Bytes of every artefact file, wall time aside."""
    files = {}
    for stage in stages:
        for path in sorted((out / stage).glob("*")):
            content = path.read_bytes()
            if path.suffix == ".json":
                document = json.loads(content)
                document.pop("wall_s")
                content = json.dumps(document).encode()
            files[f"{stage}/{path.name}"] = content
    return files
