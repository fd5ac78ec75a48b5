"""Tiled TIFF with overviews, read back by tifffile."""

import numpy as np
import tifffile

from gvpipe.formats.plots import EDGE, curves_svg, heat_map
from gvpipe.formats.pyramid import TILE, write_pyramid


def test_pyramid_holds_the_picture_its_overviews_and_its_place(tmp_path):
    height, width = 1300, 2100
    v, u = np.mgrid[0:height, 0:width]
    picture = np.stack([u // 9, v // 6, (u + v) // 14, np.full_like(u, 255)], axis=-1)
    picture = picture.astype(np.uint8)
    picture[:, :700] = 0
    strips = (picture[row : row + TILE] for row in range(0, height, TILE))
    place = np.array([[0.01, 0.0, -3.0], [0.0, -0.01, 5.0], [0.0, 0.0, 1.0]])
    write_pyramid(tmp_path / "m.tif", width, height, strips, place)
    with tifffile.TiffFile(tmp_path / "m.tif") as file:
        assert file.is_bigtiff
        assert [p.shape for p in file.pages] == [(1300, 2100, 4), (650, 1050, 4), (325, 525, 4)]
        assert [p.subfiletype for p in file.pages] == [0, 1, 1]
        whole, half = file.pages[0], file.pages[1]
        assert whole.is_tiled
        np.testing.assert_array_equal(whole.asarray(), picture)
        assert whole.tags[33550].value == (0.01, 0.01, 0.0)
        np.testing.assert_allclose(whole.tags[33922].value, (0, 0, 0, -3.005, 5.005, 0))
        seen = half.asarray()
        assert (seen[:, :350] == 0).all()
        mean = picture[:, 700:].reshape(650, 2, 700, 2, 4).mean(axis=(1, 3))
        assert np.abs(seen[:, 350:] - mean).max() <= 0.5


def test_diagrams():
    curves = {"absolute": np.array([0.4, 0.1, 0.2]), "chi2": np.array([0.2, 0.05, 0.2])}
    svg = curves_svg("A & B", "image", ["B/0", "B/1", "B/2"], curves)
    assert "A &amp; B" in svg
    assert "chi2: B/1, 0.05" in svg
    assert curves_svg("one", "image", ["B/0"], {"a": np.zeros(1)}).endswith("</svg>\n")


def test_a_matrix_is_coloured_and_its_edges_say_which_row_is_which():
    matrix = np.array([[0.0, 0.5], [1.0, 0.2], [0.1, 0.1]])
    plain, named = heat_map(matrix), heat_map(matrix, "A", "B")
    squares = plain[EDGE : EDGE + 510, EDGE : EDGE + 340]
    assert (squares.reshape(3, 170, 2, 170, 3) == squares[::170, None, ::170, None]).all()
    sums = squares[::170, ::170].astype(int).sum(axis=2)
    assert sums[1, 0] == sums.max()
    assert sums[0, 0] == sums.min()

    def written(strip):
        """Middles of what is written, as shares of the strip."""
        ink = np.flatnonzero((strip < 128).all(axis=2).any(axis=0))
        return [
            part.mean() / strip.shape[1]
            for part in np.split(ink, np.flatnonzero(np.diff(ink) > 20) + 1)
        ]

    across = written(plain[:EDGE, EDGE : EDGE + 340])
    np.testing.assert_allclose(across, [1 / 4, 3 / 4], atol=0.01)
    down = written(plain[EDGE : EDGE + 510, :EDGE].transpose(1, 0, 2))
    np.testing.assert_allclose(down, [1 / 6, 3 / 6, 5 / 6], atol=0.01)
    below = np.s_[EDGE + 510 :]
    assert (plain[below] == 255).all()
    assert (named[below] < 128).any()
    assert heat_map(np.ones((1, 1))).shape == (512 + 2 * EDGE, 512 + 2 * EDGE, 3)
    assert heat_map(np.ones((900, 2))).shape[0] == 900 + 2 * EDGE
