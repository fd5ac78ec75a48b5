"""A tiny captured set with known truth, and the chain run on it once."""

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest

from gvpipe.cli import run
from gvpipe.core.geometry.pose import planar_pose
from gvpipe.core.types import Mount, Pose
from tests.synthetic import CAMERA, Box, Scene, texture

STAGES = ("match", "localize", "overlap", "slam", "mosaic", "reconstruct")
TILT_DEG, HEIGHT = 42.0, 0.6
BOX_LOW, BOX_HIGH = (-0.11, -0.08, 0.0), (0.11, 0.08, 0.16)
RADIUS = 0.75
HEADINGS = {"A": (0, 30, 60, 90, 120, 150), "B": (150, 180, 210, 240, 270, 300, 330)}
"""Robots stand on a circle round the box and look at it, at these bearings in degrees."""


@dataclass(frozen=True)
class TinySet:
    """A folder with a configuration, and where each picture was taken."""

    config: Path
    poses: dict[str, Pose]

    def out(self) -> Path:
        return self.config.parent / "run"

    def document(self, stage: str) -> dict[str, object]:
        name = "obstacles" if stage == "reconstruct" else stage
        document = json.loads((self.out() / stage / f"{name}.json").read_text())
        assert isinstance(document, dict)
        return document


def make_tiny_set(folder: Path) -> TinySet:
    rng = np.random.default_rng(7)
    faces = np.clip(texture(rng, 512).astype(int) @ np.diag([1.1, 0.7, 0.5]), 0, 255)
    scene = Scene(texture(rng), boxes=(Box(BOX_LOW, BOX_HIGH, faces.astype(np.uint8)),))
    poses = {}
    for robot, bearings in HEADINGS.items():
        (folder / robot).mkdir(parents=True)
        for k, bearing in enumerate(bearings):
            angle = np.radians(bearing + (5 if robot == "B" else 0))
            mount = Mount(np.radians(TILT_DEG), 0.0, HEIGHT)
            pose = planar_pose(
                -RADIUS * np.cos(angle), -RADIUS * np.sin(angle), float(angle), mount
            )
            picture = scene.photograph(pose, noise=1.0, rng=rng)
            ok, png = cv2.imencode(".png", picture[..., ::-1])
            assert ok
            (folder / robot / f"{k}.png").write_bytes(png.tobytes())
            poses[f"{robot}/{k}.png"] = pose
    config = folder / "tiny.yaml"
    config.write_text(
        f"""cameras:
  cam: {{width: {CAMERA.width}, height: {CAMERA.height}, fx: {CAMERA.fx}, fy: {CAMERA.fy},
        cx: {CAMERA.cx}, cy: {CAMERA.cy}}}
robots:
  A: {{images: A, camera: cam, height: {HEIGHT}, tilt: {TILT_DEG + 2}}}
  B: {{images: B, camera: cam, height: {HEIGHT}, tilt: {TILT_DEG - 2}}}
output: run
mosaic: {{resolution: 0.008}}
reconstruct: {{grid: [64, 64, 40]}}
"""
    )
    return TinySet(config, poses)


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> TinySet:
    """The tiny set, nothing run yet; read only."""
    return make_tiny_set(tmp_path_factory.mktemp("tiny"))


@pytest.fixture(scope="session")
def chain(tmp_path_factory: pytest.TempPathFactory) -> TinySet:
    """The tiny set after the whole chain."""
    made = make_tiny_set(tmp_path_factory.mktemp("chain"))
    for stage in STAGES:
        assert run([stage, str(made.config), "--jobs", "1", "-q"]) == 0, stage
    return made
