"""Histograms and candidate lists: definitions, identities, bounds."""

import numpy as np
import pytest

from gvpipe.core.overlap.candidates import Candidate, candidate_pairs, shortlist
from gvpipe.core.overlap.histogram import (
    BINS,
    DISTANCES,
    colour_histogram,
    ground_histogram,
)
from gvpipe.core.types import Camera, Mount, View

CAMERA = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)
MOUNT = Mount(tilt=np.radians(40), roll=0.0, height=0.6)


def definitions(h: np.ndarray, g: np.ndarray) -> dict[str, float]:
    """Table 4.3 of the thesis, written out one pair at a time."""
    mean = (h + g) / 2
    used = mean > 0
    return {
        "absolute": sum(abs(a - b) for a, b in zip(h, g, strict=True)),
        "squared": sum((a - b) ** 2 for a, b in zip(h, g, strict=True)),
        "intersection": sum(b - min(a, b) for a, b in zip(h, g, strict=True)) / g.sum(),
        "chi2": float((((h - mean) ** 2)[used] / mean[used]).sum()),
    }


def some_histograms(n: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    h = rng.dirichlet(np.full(BINS, 0.2), n)
    h[:, rng.integers(0, BINS, 20)] = 0.0
    return h / h.sum(axis=1, keepdims=True)


@pytest.mark.parametrize("name", DISTANCES)
def test_distance_is_its_definition(name):
    h, g = some_histograms(7, 1), some_histograms(5, 2)
    got = DISTANCES[name](h, g)
    assert got.shape == (7, 5)
    expected = [[definitions(a, b)[name] for b in g] for a in h]
    np.testing.assert_allclose(got, expected, atol=2e-6)


@pytest.mark.parametrize("name", DISTANCES)
def test_distance_identity_symmetry_bounds(name):
    h = some_histograms(9, 3)
    d = DISTANCES[name](h, h)
    assert np.abs(np.diag(d)).max() == 0.0
    np.testing.assert_allclose(d, d.T, atol=1e-6)
    assert d.min() >= 0.0
    assert d.max() <= (2.0 if name in ("absolute", "squared") else 1.0) + 1e-6
    disjoint = np.zeros((2, BINS))
    disjoint[0, 3] = disjoint[1, 60] = 1.0
    assert DISTANCES[name](disjoint[:1], disjoint[1:])[0, 0] == pytest.approx(
        1.0 if name in ("intersection", "chi2") else 2.0
    )


def test_intersection_is_half_the_absolute_distance_for_unit_sums():
    h, g = some_histograms(6, 4), some_histograms(8, 5)
    np.testing.assert_allclose(
        DISTANCES["intersection"](h, g), DISTANCES["absolute"](h, g) / 2, atol=1e-6
    )


def test_intersection_of_raw_counts_asks_how_much_of_g_is_covered():
    small, large = np.zeros((1, BINS)), np.zeros((1, BINS))
    small[0, 0], large[0, 0], large[0, 1] = 10, 10, 30
    assert DISTANCES["intersection"](small, large)[0, 0] == pytest.approx(0.75)
    assert DISTANCES["intersection"](large, small)[0, 0] == 0.0


@pytest.mark.parametrize("name", DISTANCES)
def test_distance_does_not_depend_on_the_blocks(name):
    h, g = some_histograms(300, 6), some_histograms(2100, 7)
    whole = DISTANCES[name](h, g)
    for rows, columns in ((slice(250, 262), slice(2040, 2055)), (slice(0, 1), slice(2099, 2100))):
        np.testing.assert_array_equal(whole[rows, columns], DISTANCES[name](h[rows], g[columns]))


def test_distances_of_nothing_and_of_wrong_shapes():
    for distance in DISTANCES.values():
        assert distance(np.empty((0, BINS)), some_histograms(3, 8)).shape == (0, 3)
        with pytest.raises(ValueError, match="bins"):
            distance(np.ones((2, BINS)), np.ones((2, BINS // 2)))


def test_empty_histogram_is_far_from_everything():
    h = some_histograms(1, 9)
    assert DISTANCES["intersection"](h, np.zeros((1, BINS)))[0, 0] == 1.0


def test_bins_are_the_two_leading_bits_of_each_channel():
    pixels = np.array([[[0, 0, 0], [255, 64, 191], [63, 128, 255], [9, 9, 9]]], np.uint8)
    seen = np.array([[True, True, True, False]])
    expected = np.zeros(BINS)
    expected[[0, 48 + 4 + 2, 8 + 3]] = 1 / 3
    np.testing.assert_allclose(colour_histogram(pixels, seen), expected)
    assert colour_histogram(pixels, np.zeros_like(seen)).sum() == 0.0


def test_only_seen_ground_is_counted():
    """A black surround or the sky above the horizon would add a black or a blue bin."""
    pixels = np.full((120, 160, 3), (210, 80, 40), np.uint8)
    pixels[:4] = (0, 0, 255)  # far beyond the range at a low tilt
    view = View("A/0", pixels, CAMERA, Mount(tilt=np.radians(20), roll=0.0, height=0.6))
    h = ground_histogram(view)
    assert h[16 * 3 + 4 * 1 + 0] == pytest.approx(1.0)
    assert h.sum() == pytest.approx(1.0)


def test_histogram_does_not_change_with_the_exposure():
    rng = np.random.default_rng(3)
    floor = rng.uniform(20, 110, (120, 160, 3))
    views = [View("A/0", (gain * floor).astype(np.uint8), CAMERA, MOUNT) for gain in (0.5, 1, 2)]
    dark, plain, bright = map(ground_histogram, views)
    assert np.abs(dark - plain).sum() < 0.05
    assert np.abs(bright - plain).sum() < 0.05


def test_histogram_does_not_change_with_the_height_unit_or_the_tilt():
    """Half the floor is red, half green, seen along the border: any height and tilt halves it."""
    pixels = np.zeros((120, 160, 3), np.uint8)
    pixels[:, :80, 0], pixels[:, 80:, 1] = 255, 255
    mounts = [MOUNT, Mount(MOUNT.tilt, 0.0, 60.0), Mount(np.radians(65), 0.0, 0.6)]
    for mount in mounts:
        h = ground_histogram(View("A/0", pixels, CAMERA, mount))
        assert h[48] == pytest.approx(0.5, abs=0.02)
        assert h[12] == pytest.approx(0.5, abs=0.02)


def test_camera_that_sees_no_ground():
    up = Mount(tilt=np.radians(-60), roll=0.0, height=0.6)
    assert ground_histogram(View("A/0", np.zeros((120, 160, 3), np.uint8), CAMERA, up)).sum() == 0


def by_histograms_alone(distances: np.ndarray, threshold: float) -> list[Candidate]:
    """Candidates of a whole matrix (n, m) of distances."""
    i, j = (grid.ravel() for grid in np.indices(distances.shape))
    return candidate_pairs(i, j, distances.ravel(), threshold, np.zeros(distances.size))


def test_candidates_are_the_local_minima_best_first():
    d = np.array([[0.5, 0.1, 0.3], [0.15, 0.4, 0.9], [0.6, 0.12, 0.19]])
    pairs = [(c.i, c.j) for c in by_histograms_alone(d, 0.2)]
    assert pairs == [(0, 1), (2, 1), (1, 0), (2, 2)]
    assert [c.distance for c in by_histograms_alone(d, 0.13)] == [0.1, 0.12]
    assert by_histograms_alone(d, 0.1) == []
    assert by_histograms_alone(np.empty((0, 3)), 1.0) == []


def test_shortlist_holds_the_nearest_of_every_image():
    rng = np.random.default_rng(4)
    h, g = rng.dirichlet(np.full(64, 0.3), 70), rng.dirichlet(np.full(64, 0.3), 50)
    d = DISTANCES["absolute"](h, g)
    i, j, distances = shortlist(h, g, DISTANCES["absolute"], 3, block=16)
    wanted = {(a, b) for a in range(70) for b in np.argsort(d[a])[:3]}
    wanted |= {(a, b) for b in range(50) for a in np.argsort(d[:, b])[:3]}
    assert set(zip(i.tolist(), j.tolist(), strict=True)) == wanted
    np.testing.assert_allclose(distances, d[i, j])
    assert list(zip(i, j, strict=True)) == sorted(zip(i, j, strict=True))
