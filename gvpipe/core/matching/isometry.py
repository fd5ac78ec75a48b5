"""Isometry between two overhead views from pairs of corners (thesis 3.3.2)."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gvpipe.core.geometry.homography import apply
from gvpipe.core.kernels.matching import segment_trial
from gvpipe.core.matching.features import Features, MatchOptions
from gvpipe.core.matching.invariants import describe, invariant_overhead
from gvpipe.core.types import Float, View

_CONFIDENCE = 0.99  # of having drawn two corners of common ground (thesis eq. 3.5.11)

_KEPT = 6  # hypotheses worth refining: with a tilt off by degrees the best one may be a wrong one


@dataclass(frozen=True)
class Isometry:
    """The isometries that fit best and what was counted on the way.

    Attributes
    ----------
    fits : tuple of (support, yaw, x, y)
        Best first: corners of i with a like neighbour in j, and the pose of robot i in the
        ground frame of robot j (radians, metres).
    trials, candidates : int
        Random segments tried; corner pairs whose invariants agree.
    distance : (N, M) float64
        Distances of the invariant vectors.
    """

    fits: tuple[tuple[float, float, float, float], ...]
    trials: int
    candidates: int
    distance: Float


def distances(a: Float, b: Float) -> Float:
    """Euclidean distances (N, M) between two sets of vectors."""
    square = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1) - 2.0 * (a @ b.T)
    return np.asarray(np.sqrt(np.maximum(square, 0.0)))


def corner_windows(corners: Float, shape: tuple[int, ...], side: int) -> NDArray[np.int32]:
    """Raster of which corner's window covers each pixel, -1 where none does."""
    near = np.full(shape, -1, np.int32)
    u, v = np.rint(corners).astype(int).T
    inside = (u >= 0) & (v >= 0) & (u < shape[1]) & (v < shape[0])
    reach = side // 2
    for k in np.flatnonzero(inside)[::-1]:  # the strongest corner is written last
        near[max(v[k] - reach, 0) : v[k] + reach + 1, max(u[k] - reach, 0) : u[k] + reach + 1] = k
    return near


def find_isometry(
    view_i: View,
    view_j: View,
    features_i: Features,
    features_j: Features,
    options: MatchOptions,
    rng: np.random.Generator,
) -> Isometry:
    """Try random segments of i against all of j; keep the isometry that most corners confirm.

    Parameters
    ----------
    view_i, view_j : View
        The views.
    features_i, features_j : Features
        From :func:`gvpipe.core.matching.invariants.extract_invariants`.
    options : MatchOptions
        Gates and the number of trials.
    rng : Generator
        Draws the segments.

    Returns
    -------
    found : Isometry
        With no `fits` if nothing passed the gates.
    """
    scale = min(features_i.pixels_per_metre, features_j.pixels_per_metre)
    vectors = [
        f.descriptors if f.pixels_per_metre == scale else describe(v, f.pixels, scale, options)
        for v, f in ((view_i, features_i), (view_j, features_j))
    ]
    distance = distances(*(np.asarray(v, dtype=np.float64) for v in vectors))
    overheads = [invariant_overhead(v, scale, options.max_range) for v in (view_i, view_j)]
    (grey_i, raster_i), (grey_j, raster_j) = (
        (cv2.cvtColor(o, cv2.COLOR_RGB2GRAY).astype(np.uint8), g.overhead_from_ground)
        for o, g in overheads
    )
    near_j = corner_windows(apply(raster_j, features_j.ground), grey_j.shape, options.window_px)
    chance = float((near_j >= 0).mean()) * float((distance < options.min_colour).mean())
    within = distances(*(np.asarray(vectors[0], dtype=np.float64),) * 2)
    fits: list[tuple[float, float, float, float]] = []
    best, needed, trial = 0.0, float(options.max_trials), 0
    while trial < min(needed, options.max_trials) and len(features_i.ground) > 1:
        trial += 1
        p = int(rng.integers(len(within)))
        unlike = np.flatnonzero(within[p] > 2 * options.min_colour)
        if not len(unlike):
            continue
        q = int(unlike[rng.integers(len(unlike))])
        found, _ = segment_trial(
            p, q, features_i.ground, features_j.ground, distance,
            grey_i, raster_i, grey_j, raster_j, near_j,
            options.min_colour, options.max_stretch, options.min_correlation,
        )  # fmt: skip
        if found[0] > 0:
            fits.append(tuple(found.tolist()))
        if found[0] > best:
            best = float(found[0])
            common = np.clip(best / len(within) - chance, 1e-3, 1 - 1e-9)
            needed = np.log(1 - _CONFIDENCE) / np.log1p(-(common**2))
    return Isometry(
        fits=tuple(sorted(fits, reverse=True)[:_KEPT]),
        trials=trial,
        candidates=int((distance < options.min_colour).sum()),
        distance=distance,
    )
