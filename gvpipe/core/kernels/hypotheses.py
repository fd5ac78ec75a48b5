"""Similarities of the ground from two matches, and how many matches agree with each."""

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.kernels.jit import kernel
from gvpipe.core.types import Float


@kernel
def _turn(a: float, b: float) -> float:
    """Absolute difference of two angles."""
    turns = (a - b) / (2.0 * np.pi)
    return 2.0 * np.pi * abs(turns - np.rint(turns))


@kernel
def _through(pixel_from_ground: Float, c: float, s: float, x: float, y: float, out: Float) -> None:
    """Fill `out` with the map that applies a similarity before another map."""
    for r in range(3):
        p, q, o = pixel_from_ground[r, 0], pixel_from_ground[r, 1], pixel_from_ground[r, 2]
        out[r, 0], out[r, 1], out[r, 2] = p * c + q * s, q * c - p * s, p * x + q * y + o


@kernel
def _agreement(
    h: Float, ground_i: Float, pixels_j: Float, turn: Float, log_growth: Float,
    yaw: float, log_scale: float, max_turn: float, max_log_growth: float, square: float,
) -> float:  # fmt: skip
    """Sum of what the matches count that a map takes near their counterparts."""
    score = 0.0
    for n in range(len(ground_i)):
        gx, gy = ground_i[n, 0], ground_i[n, 1]
        w = h[2, 0] * gx + h[2, 1] * gy + h[2, 2]
        if w <= 1e-9:
            continue
        du = (h[0, 0] * gx + h[0, 1] * gy + h[0, 2]) / w - pixels_j[n, 0]
        dv = (h[1, 0] * gx + h[1, 1] * gy + h[1, 2]) / w - pixels_j[n, 1]
        error = du * du + dv * dv
        if (
            error < square
            and abs(log_growth[n] - log_scale) < max_log_growth
            and _turn(turn[n], yaw) < max_turn
        ):
            score += 1.0 - error / square
    return score


@kernel
def score_pairs(
    draws: NDArray[np.int64], ground_i: Float, ground_j: Float, pixels_j: Float,
    turn: Float, log_growth: Float, pixel_j_from_ground_j: Float,
    max_log_scale: float, max_turn: float, max_log_growth: float,
    tolerance_px: float, enough: float,
) -> Float:  # fmt: skip
    """Similarity ground_j_from_ground_i of pairs of matches, scored by all matches.

    Parameters
    ----------
    draws : (T, 2) int64
        Pairs of matches.
    ground_i, ground_j, pixels_j : (N, 2) float64
        Matched points on the ground (metres) and in picture j.
    turn, log_growth : (N,) float64
        Orientation of the feature in j against i, and logarithm of their sizes' ratio.
    pixel_j_from_ground_j : (3, 3) float64
        Third component positive in front of the camera.
    max_log_scale : float
        Largest logarithm of the similarity's scale.
    max_turn, max_log_growth : float
        A match counts only if its feature turns and grows with the similarity up to this.
    tolerance_px : float
        A match counts ``1 - (error / tolerance)^2``.
    enough : float
        The pairs after one that scores more are left out.

    Returns
    -------
    found : (T, 5) float64
        Score, yaw, x, y, log scale; score 0 where the pair of matches contradicts itself or is
        left out.
    """
    found = np.zeros((len(draws), 5))
    h = np.empty((3, 3))
    square = tolerance_px * tolerance_px
    for t in range(len(draws)):
        a, b = draws[t, 0], draws[t, 1]
        if a == b:
            continue
        ix, iy = ground_i[b, 0] - ground_i[a, 0], ground_i[b, 1] - ground_i[a, 1]
        jx, jy = ground_j[b, 0] - ground_j[a, 0], ground_j[b, 1] - ground_j[a, 1]
        length_i, length_j = np.hypot(ix, iy), np.hypot(jx, jy)
        if length_i < 1e-9 or length_j < 1e-9:
            continue
        log_scale = np.log(length_j / length_i)
        if abs(log_scale) > max_log_scale:
            continue
        yaw = np.arctan2(ix * jy - iy * jx, ix * jx + iy * jy)
        if _turn(turn[a], yaw) > max_turn or _turn(turn[b], yaw) > max_turn:
            continue
        scale = np.exp(log_scale)
        c, s = scale * np.cos(yaw), scale * np.sin(yaw)
        x = ground_j[a, 0] - c * ground_i[a, 0] + s * ground_i[a, 1]
        y = ground_j[a, 1] - s * ground_i[a, 0] - c * ground_i[a, 1]
        _through(pixel_j_from_ground_j, c, s, x, y, h)
        score = _agreement(
            h, ground_i, pixels_j, turn, log_growth,
            yaw, log_scale, max_turn, max_log_growth, square,
        )  # fmt: skip
        found[t, 0], found[t, 1], found[t, 2], found[t, 3] = score, yaw, x, y
        found[t, 4] = log_scale
        if score > enough:
            break
    return found
