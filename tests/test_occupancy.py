"""Occupancy grids and the files map_server reads, read back by its documented rules."""

from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from gvpipe.core.mosaic.occupancy import FREE, OCCUPIED, UNKNOWN, draw_footprints, occupancy
from gvpipe.errors import InputError
from gvpipe.formats.occupancy import pgm_bytes, yaml_text
from gvpipe.stages.reconstruct_map import read_map


def read_by_the_rules(pgm: bytes, text: str) -> tuple[np.ndarray, dict]:
    """map_server: p = (255 - v) / 255 (v / 255 if negated), above occupied_thresh = occupied,
    below free_thresh = free, else unknown; the first row of the picture has the highest y."""
    meta = yaml.safe_load(text)
    magic, size, depth, values = pgm.split(b"\n", 3)
    assert magic == b"P5"
    assert depth == b"255"
    width, height = map(int, size.split())
    v = np.frombuffer(values, np.uint8).reshape(height, width)
    p = v / 255 if meta["negate"] else (255.0 - v) / 255
    cells = np.full(v.shape, -1)
    cells[p > meta["occupied_thresh"]] = 100
    cells[p < meta["free_thresh"]] = 0
    return cells, meta


def test_files_read_back_by_the_rules_of_map_server():
    rng = np.random.default_rng(0)
    cells = rng.choice(np.array([FREE, OCCUPIED, UNKNOWN], np.int8), (13, 29))
    text = yaml_text("map.pgm", 0.005, -1.25, 0.5)
    got, meta = read_by_the_rules(pgm_bytes(cells), text)
    np.testing.assert_array_equal(got, cells)
    assert meta["image"] == "map.pgm"
    assert meta["mode"] == "trinary"
    assert meta["resolution"] == 0.005
    np.testing.assert_allclose(meta["origin"], [-1.2525, 0.4975, 0.0])
    assert meta["negate"] == 0


def test_pgm_values_are_those_map_server_saves():
    values = pgm_bytes(np.array([[FREE, OCCUPIED, UNKNOWN]], np.int8)).split(b"\n", 3)[3]
    assert list(values) == [254, 0, 205]


def test_cells_follow_the_evidence():
    seen = np.zeros((100, 100), bool)
    seen[:, 10:] = True
    log_odds = np.full((100, 100), -2.0, np.float32)
    log_odds[30:50, 40:60] = 3.0  # 10 cm
    log_odds[70, :] = 3.0  # a line
    log_odds[30:50, 0:5] = 3.0  # never seen
    cells = occupancy(seen, log_odds, 0.005)
    assert (cells[:, :10] == UNKNOWN).all()
    assert (cells[32:48, 42:58] == OCCUPIED).all()
    assert (cells[70, 10:] == UNKNOWN).all()
    assert (cells[80:, 10:] == FREE).all()
    assert (cells == OCCUPIED).sum() <= 400


def test_footprints_are_drawn_where_they_stand():
    cells = np.full((40, 60), FREE, np.int8)
    map_from_pixel = np.array([[0.1, 0, -1.0], [0, -0.1, 2.0], [0, 0, 1]])
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    drawn = draw_footprints(cells, [square], map_from_pixel)
    rows, columns = np.nonzero(drawn == OCCUPIED)
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (10, 20, 10, 20)
    assert (cells == FREE).all()


@pytest.mark.parametrize("resolution", [0.0, -0.01, 0.02])
def test_a_map_whose_place_does_not_fit_is_refused(tmp_path, resolution):
    (tmp_path / "map.pgm").write_bytes(pgm_bytes(np.zeros((2, 3), np.int8)))
    place = np.array([[0.01, 0, 0.5], [0, -0.01, 1.5], [0, 0, 1]])
    body = SimpleNamespace(
        width=3, height=2, resolution=0.01, map_from_pixel=place, file="mosaic.json"
    )
    mosaic = SimpleNamespace(body=body, folder=tmp_path)
    assert read_map(mosaic).cells.shape == (2, 3)
    body.resolution = resolution
    with pytest.raises(InputError, match=r"mosaic\.json: map_from_pixel"):
        read_map(mosaic)
