"""Pictures of the map show what stands where."""

import numpy as np

from gvpipe.core.geometry.pose import planar_pose
from gvpipe.core.reconstruct.background import GroundModel
from gvpipe.core.reconstruct.mesh import Mesh
from gvpipe.core.reconstruct.render import render, turntable
from gvpipe.core.types import Camera, Mount

CAMERA = Camera(80, 60, 70.0, 70.0, 39.5, 29.5)


def board(x: float, colour: tuple[int, int, int]) -> Mesh:
    """An upright board across the x axis, 0.4 m wide and 0.2 m high."""
    corners = np.array([[x, -0.2, 0], [x, 0.2, 0], [x, 0.2, 0.2], [x, -0.2, 0.2]])
    flat = Mesh.of(corners, np.array([[0, 2, 1], [0, 3, 2]], np.int32))
    colours = np.tile(np.array(colour, np.uint8), (4, 1))
    return Mesh(flat.vertices, flat.faces, flat.normals, colours)


def floor() -> GroundModel:
    """Ten metres of blue around the origin, unseen where y > 1."""
    raster = np.zeros((100, 100, 4), np.uint8)
    raster[...] = (0, 0, 200, 255)
    raster[:40, :, 3] = 0
    return GroundModel(raster, np.array([[0.1, 0, -5.0], [0, -0.1, 5.0], [0, 0, 1]]))


def test_a_board_stands_on_the_floor_and_hides_it() -> None:
    pose = planar_pose(-1.0, 0.0, 0.0, Mount(np.radians(30), 0.0, 0.5))
    picture = render(board(0.0, (200, 0, 0)), floor(), CAMERA, pose)
    camera_from_map = pose.inverse()
    for point, channel in [((0, 0, 0.1), 0), ((-0.4, 0, 0), 2), ((0.9, 0.0, 0), 2)]:
        ray = CAMERA.matrix @ (camera_from_map.rotation @ point + camera_from_map.translation)
        u, v = np.rint(ray[:2] / ray[2]).astype(int)
        assert picture[v, u].argmax() == channel, point
        assert picture[v, u].min() < 30
    unseen = CAMERA.matrix @ (
        camera_from_map.rotation @ (1.5, 1.3, 0) + camera_from_map.translation
    )
    u, v = np.rint(unseen[:2] / unseen[2]).astype(int)
    assert (picture[v, u] == 255).all()


def test_the_nearer_board_is_in_front() -> None:
    near, far = board(-0.3, (200, 0, 0)), board(0.0, (0, 200, 0))
    both = Mesh(
        np.vstack([far.vertices, near.vertices]),
        np.vstack([far.faces, near.faces + 4]),
        np.vstack([far.normals, near.normals]),
        np.vstack([far.colours, near.colours]),
    )
    pose = planar_pose(-1.0, 0.0, 0.0, Mount(np.radians(20), 0.0, 0.35))
    picture = render(both, floor(), CAMERA, pose).astype(int)
    red, green = picture[..., 0] > picture[..., 1] + 50, picture[..., 1] > picture[..., 0] + 50
    assert red.sum() > green.sum() > 0
    assert np.nonzero(red)[0].mean() > np.nonzero(green)[0].mean()


def test_a_turntable_goes_all_round() -> None:
    pictures = turntable(board(0.0, (200, 0, 0)), floor(), 4, (80, 60))
    widths = [(p[..., 0].astype(int) > p[..., 2] + 50).any(axis=0).sum() for p in pictures]
    assert widths[0] > 3 * max(widths[1], 1)
    assert widths[2] > 3 * max(widths[3], 1)
