"""The chain's files, read by other programs or by their formats' published rules alone."""

import json
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from PIL import Image
from scipy.spatial.transform import Rotation

from tests.conftest import STAGES, TinySet


def poses(chain: TinySet, robot: str) -> list[dict[str, object]]:
    return [row for row in chain.document("slam")["poses"] if row["robot"] == robot]  # type: ignore[attr-defined]


@pytest.mark.parametrize("robot", ["A", "B"])
def test_tum_by_its_rules(chain: TinySet, robot: str) -> None:
    """``timestamp tx ty tz qx qy qz qw``, blanks between, # comments."""
    table = np.loadtxt(chain.out() / "slam" / f"{robot}.tum", comments="#", ndmin=2)
    rows = poses(chain, robot)
    assert table.shape == (len(rows), 8)
    assert (np.diff(table[:, 0]) > 0).all()
    assert table[:, 1:4] == pytest.approx(np.array([row["t"] for row in rows]), abs=1e-9)
    turned = Rotation.from_quat(table[:, 4:]).as_matrix()  # scalar last
    assert turned == pytest.approx(np.array([row["R"] for row in rows]), abs=1e-9)


@pytest.mark.parametrize("robot", ["A", "B"])
def test_kitti_by_its_rules(chain: TinySet, robot: str) -> None:
    """Twelve numbers a line: the first three rows of camera to world, row by row."""
    table = np.loadtxt(chain.out() / "slam" / f"{robot}.kitti.txt", ndmin=2)
    matrices = table.reshape(-1, 3, 4)
    rows = poses(chain, robot)
    assert matrices[:, :, :3] == pytest.approx(np.array([row["R"] for row in rows]), abs=1e-9)
    assert matrices[:, :, 3] == pytest.approx(np.array([row["t"] for row in rows]), abs=1e-9)


def test_ply_and_glb_by_trimesh(chain: TinySet) -> None:
    folder = chain.out() / "reconstruct"
    (row,) = chain.document("reconstruct")["obstacles"]  # type: ignore[misc]
    ply = trimesh.load(folder / "obstacles.ply", process=False)
    glb = trimesh.load(folder / "obstacles.glb", force="mesh", process=False)
    for mesh in (ply, glb):
        assert mesh.is_watertight
        assert mesh.volume == pytest.approx(row["volume_m3"], rel=0.02)
    assert ply.extents[2] == pytest.approx(row["height_m"], abs=0.01)
    assert glb.extents[1] == pytest.approx(row["height_m"], abs=0.01)  # glTF has y up
    points = trimesh.load(folder / "points.ply")
    assert len(points.vertices) > 100
    low, high = ply.bounds
    assert (points.vertices > low - 0.02).all()
    assert (points.vertices < high + 0.02).all()


def ros_map(path: Path) -> tuple[np.ndarray, dict[str, object]]:
    """map_server: darkness p = (255 - v) / 255; over occupied_thresh occupied, under free_thresh
    free, else unknown; the origin is the lower left corner of the lower left cell."""
    meta = yaml.safe_load(path.read_text())
    assert {"image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh"} <= set(
        meta
    )
    with Image.open(path.parent / meta["image"]) as opened:
        values = np.asarray(opened.convert("L"), dtype=float)
    dark = values / 255 if meta["negate"] else (255 - values) / 255
    cells = np.full(dark.shape, -1)
    cells[dark > meta["occupied_thresh"]] = 100
    cells[dark < meta["free_thresh"]] = 0
    return cells[::-1], meta  # rows upwards from the origin


@pytest.mark.parametrize("stage", ["mosaic", "reconstruct"])
def test_ros_maps_by_the_rules_of_map_server(chain: TinySet, stage: str) -> None:
    cells, meta = ros_map(chain.out() / stage / "map.yaml")
    (row,) = chain.document("reconstruct")["obstacles"]  # type: ignore[misc]
    x0, y0, yaw = meta["origin"]  # type: ignore[misc]
    assert yaw == 0
    height, width = cells.shape
    step = meta["resolution"]
    x = x0 + (np.arange(width) + 0.5) * step
    y = y0 + (np.arange(height) + 0.5) * step
    gx, gy = np.meshgrid(x, y)
    near = np.hypot(gx - row["centroid"][0], gy - row["centroid"][1]) < 0.05
    away = np.hypot(gx - row["centroid"][0], gy - row["centroid"][1]) > 0.45
    if stage == "reconstruct":
        assert (cells[near] == 100).all()
    assert (cells[near] != 0).mean() > 0.5
    known = cells[away] >= 0
    assert (cells[away][known] == 0).mean() > 0.95


def numbers_of(value: object) -> Iterator[float]:
    """All numbers of a document."""
    if isinstance(value, dict | list):
        for part in value.values() if isinstance(value, dict) else value:
            yield from numbers_of(part)
    elif isinstance(value, float):
        yield value


def test_json_is_strict_and_holds_finite_numbers(chain: TinySet) -> None:
    constants = []
    for stage in STAGES:
        (path,) = (chain.out() / stage).glob("*.json")
        text = path.read_text(encoding="utf-8")
        read = json.loads(text, parse_constant=constants.append)
        assert read["schema"].startswith("gvpipe/")
        assert all(math.isfinite(number) for number in numbers_of(read))
    assert constants == []  # NaN and infinities, which JSON does not know
