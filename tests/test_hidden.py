"""What an obstacle hides, against a shadow worked out by hand."""

import numpy as np

from gvpipe.core.geometry.pose import planar_pose
from gvpipe.core.mosaic.hidden import Prism, with_obstacles
from gvpipe.core.mosaic.occupancy import FREE, OCCUPIED, UNKNOWN
from gvpipe.core.mosaic.raster import MosaicRaster, Picture
from gvpipe.core.types import Camera, Mount

CAMERA = Camera(200, 150, 170.0, 165.0, 98.0, 76.0)
RASTER = MosaicRaster(301, 201, 0.01, 0.0, 1.0)  # x 0 to 3, y -1 to 1
ANY = 1, 0.0  # one camera is enough
BOX = Prism(np.array([[1.0, -0.1], [1.2, -0.1], [1.2, 0.1], [1.0, 0.1]]), 0.35)


def camera(x: float, y: float, yaw_deg: float) -> Picture:
    pose = planar_pose(x, y, np.radians(yaw_deg), Mount(np.radians(35), 0.0, 0.7))
    return Picture(CAMERA, pose, lambda: np.zeros((150, 200, 3), np.uint8))


def state(cells: np.ndarray, x: float, y: float) -> int:
    return int(cells[round((1.0 - y) / 0.01), round(x / 0.01)])


def test_ground_behind_an_obstacle_is_unknown_until_another_camera_sees_it():
    free = np.full((201, 301), FREE, np.int8)
    one = with_obstacles(free, [BOX], [camera(0.2, 0.0, 0)], RASTER, *ANY)
    assert state(one, 1.1, 0.0) == OCCUPIED
    # twice as high as the box: its far top edge at 1.2, a metre away, falls 2 m away, at 2.2
    assert state(one, 2.1, 0.0) == UNKNOWN
    assert state(one, 2.3, 0.0) == FREE
    assert state(one, 0.9, 0.0) == FREE
    assert state(one, 1.6, 0.5) == FREE
    both = with_obstacles(free, [BOX], [camera(0.2, 0.0, 0), camera(2.9, 0.0, 180)], RASTER, *ANY)
    assert state(both, 2.0, 0.0) == FREE
    assert state(both, 1.1, 0.0) == OCCUPIED
    assert (free == FREE).all()


def test_unknown_ground_stays_unknown_and_a_high_obstacle_hides_all_behind_it():
    cells = np.full((201, 301), UNKNOWN, np.int8)
    cells[:, 150:] = FREE
    tall = Prism(BOX.footprint, 5.0)
    found = with_obstacles(cells, [tall], [camera(0.2, 0.0, 0)], RASTER, *ANY)
    assert state(found, 0.5, 0.0) == UNKNOWN
    assert state(found, 2.9, 0.0) == UNKNOWN


def test_free_is_only_what_enough_cameras_see_past_the_obstacles():
    free = np.full((201, 301), FREE, np.int8)
    views = [camera(0.2, 0.0, 0), camera(0.2, 0.0, 0), camera(0.4, 0.0, 0), camera(2.9, 0.0, 180)]
    three = with_obstacles(free, [BOX], views, RASTER, 3, 0.0)
    assert state(three, 0.95, 0.0) == FREE
    assert state(three, 2.0, 0.0) == UNKNOWN  # behind the box for all but the last
    assert state(with_obstacles(free, [BOX], views, RASTER, 1, 0.0), 2.0, 0.0) == FREE
    assert state(with_obstacles(free, [], views, RASTER, 4, 0.0), 2.0, 0.0) == FREE
    assert state(with_obstacles(free, [], views[:3], RASTER, 4, 0.0), 2.0, 0.0) == UNKNOWN
    # of four at the best place, a share of two thirds is three
    assert state(with_obstacles(free, [BOX], views, RASTER, 1, 2 / 3), 2.0, 0.0) == UNKNOWN
