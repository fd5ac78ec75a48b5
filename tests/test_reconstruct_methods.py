"""All methods of reconstruction on one rendered ball, and what is kept of an evolution."""

from pathlib import Path
from typing import get_args

import cv2
import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from gvpipe.config import ReconstructConfig
from gvpipe.core.reconstruct.background import GroundModel
from gvpipe.core.reconstruct.grid import VoxelGrid
from gvpipe.core.reconstruct.history import (
    FRAME_VOXELS,
    MOST_FRAMES,
    Recorder,
    nearest_frame,
    restored,
)
from gvpipe.core.reconstruct.mesh import find_obstacles, surface
from gvpipe.formats.figures import layer_picture, sheet
from gvpipe.stages.reconstruct_files import Scene, SolvedRegion, write_scene
from gvpipe.stages.reconstruct_methods import METHODS
from tests.test_carving import CENTRE, GRID, RADIUS, ball_view

SHOTS = [ball_view(k * 2 * np.pi / 7) for k in range(7)]
VIEWS, MASKS = [v for v, _ in SHOTS], [m for _, m in SHOTS]
BALL_VOLUME = 4 / 3 * np.pi * RADIUS**3


def scene_of(settings: ReconstructConfig) -> Scene:
    solution = METHODS[settings.method](GRID, VIEWS, MASKS, settings, 1)
    floor = np.full((100, 100, 4), 200, np.uint8)
    ground = GroundModel(floor, np.array([[0.02, 0, -1.0], [0, -0.02, 1.0], [0, 0, 1]]))
    found = find_obstacles(solution.u, GRID)
    return Scene((SolvedRegion(GRID, solution),), tuple(found), tuple(VIEWS), ground)


def test_every_configured_method_is_there() -> None:
    assert METHODS.keys() == set(get_args(ReconstructConfig.model_fields["method"].annotation))


@pytest.mark.parametrize(
    ("method", "evolution"), [("level-set", "layers"), *((method, "volume") for method in METHODS)]
)
def test_every_method_finds_the_ball_and_writes_the_same_files(
    method: str, evolution: str, tmp_path: Path
) -> None:
    scene = scene_of(ReconstructConfig(method=method, evolution=evolution))  # type: ignore[arg-type]
    (ball,) = scene.obstacles
    assert 0.9 * BALL_VOLUME < ball.volume_m3 < 1.6 * BALL_VOLUME
    assert ball.centroid == pytest.approx(CENTRE, abs=0.03)
    write_scene(scene, tmp_path)
    names = {p.name for p in tmp_path.iterdir()}
    common = {"obstacles.ply", "obstacles.glb", "points.ply", "volume.npz", "turntable.png"}
    evolved = {"evolution.png", "terms.png"} if method == "level-set" else set()
    assert names == common | evolved
    for name in ("obstacles.ply", "obstacles.glb"):
        mesh = trimesh.load(tmp_path / name, force="mesh")
        assert mesh.is_watertight, name
        assert mesh.volume == pytest.approx(ball.volume_m3, rel=1e-3)
    for name in evolved:
        picture = cv2.imdecode(np.fromfile(tmp_path / name, np.uint8), cv2.IMREAD_COLOR)
        assert picture.std() > 20


def test_a_region_in_which_nothing_stands_can_be_written(tmp_path: Path) -> None:
    solution = METHODS["level-set"](
        GRID, VIEWS, [np.zeros_like(m) for m in MASKS], ReconstructConfig(), 1
    )
    floor = GroundModel(np.full((10, 10, 4), 200, np.uint8), np.eye(3))
    assert find_obstacles(solution.u, GRID) == []
    for k, regions in enumerate([(SolvedRegion(GRID, solution),), ()]):
        folder = tmp_path / str(k)
        folder.mkdir()
        write_scene(Scene(regions, (), tuple(VIEWS), floor), folder)
        assert len(trimesh.load(folder / "obstacles.glb").geometry) == 0
        with np.load(folder / "volume.npz", allow_pickle=False) as volume:
            assert not (volume["u"] > 0).any()


def falling_ball(grid: VoxelGrid, radius: float) -> NDArray[np.float32]:
    distance = np.linalg.norm(grid.centres() - CENTRE, axis=-1)
    return (radius - distance).astype(np.float32)


def test_kept_surfaces_are_those_of_their_iterations_and_few() -> None:
    recorder = Recorder(GRID)
    for k in range(200):
        recorder(10 * k, falling_ball(GRID, 0.14 - 0.0002 * k))
    assert recorder.iterations[0] == 0
    assert MOST_FRAMES / 2 <= len(recorder.iterations) <= MOST_FRAMES
    assert len(set(np.diff(recorder.iterations))) == 1
    k = nearest_frame(recorder.iterations, 1000)
    radius = 0.14 - 0.0002 * recorder.iterations[k] / 10
    mesh = surface(*restored(recorder.stacked()[k], GRID))
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.02)


def test_large_grids_are_kept_coarsely() -> None:
    grid = VoxelGrid.over(np.array([-0.3, -0.3, 0]), np.array([0.3, 0.3, 0.3]), (210, 210, 105))
    recorder = Recorder(grid)
    recorder(0, falling_ball(grid, RADIUS))
    assert max(recorder.stacked().shape) <= FRAME_VOXELS
    mesh = surface(*restored(recorder.stacked()[0], grid))
    assert mesh.volume == pytest.approx(BALL_VOLUME, rel=0.03)


def test_a_layer_is_drawn_from_above_with_its_outline() -> None:
    x, y = np.meshgrid(np.arange(40.0), np.arange(20.0), indexing="ij")
    inside = (4 - np.hypot(x - 30, y - 6)).astype(np.float32)
    values = np.where(inside > 0, -0.5, 0.25).astype(np.float32)
    picture, limits = layer_picture(values, [inside], 400, signed=True)
    assert limits == (-0.5, 0.5)
    # 200 high, centred in 400; x to the right, y up
    centre, far = picture[300 - 65, 305], picture[120, 40]
    assert centre[2] > centre[0]
    assert far[0] > far[2]
    black = np.argwhere((picture[:400] == 0).all(axis=-1)).mean(axis=0)
    assert black == pytest.approx([300 - 65, 305], abs=4)
    page = sheet([(picture, "one"), (picture, "two"), (picture, "three")], columns=2)
    assert page.shape[0] > 2 * picture.shape[0]
    assert page.shape[1] < 3 * picture.shape[1]
