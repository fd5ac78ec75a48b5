"""Which of the planes that pairs of pictures show is the ground.

A camera that is carried about keeps its tilt and roll within some degrees, so the ground's normal
hardly moves in camera axes; the normals of walls and of the faces of things turn with the heading.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.calibration.raw_matching import PlanePair
from gvpipe.core.geometry.relative_pose import PURE_ROTATION, decompose, ground_motion
from gvpipe.core.types import Camera, Float

ALIKE_DEG = 12.0
"""Normals nearer than this count as one when the ground's is voted for."""

NEAR_DEG = 22.0
"""A plane whose normals are within this of the ground's may be the ground: hands shake more than
robots, and the focal length is only guessed here."""

STEEPEST_ROLL_DEG = 45.0
"""Pictures are upright to within this."""


def ground_pairs(pairs: Sequence[PlanePair], camera: Camera) -> list[PlanePair]:
    """Keep the planes that may be the ground.

    Parameters
    ----------
    pairs : sequence of PlanePair
        All planes of all pairs of pictures.
    camera : Camera
        Rough guess of the intrinsics.

    Returns
    -------
    ground : list of PlanePair
        At most one plane for each two pictures, in the order given.
    """
    normals = [_normals(pair, camera) for pair in pairs]
    votes = np.array([n for found in normals for n, _ in found]).reshape(-1, 3)
    if not len(votes):
        return []
    owner = [k for k, found in enumerate(normals) for _ in found]
    couples = {(pair.i, pair.j): k for k, pair in enumerate(pairs)}
    couple = np.array([couples[pairs[k].i, pairs[k].j] for k in owner])
    weight = np.sqrt([len(pairs[k].points_i) for k in owner])
    alike = votes @ votes.T > np.cos(np.radians(ALIKE_DEG))
    support = [_support(alike[k], couple, weight) for k in range(len(votes))]
    down = votes[int(np.argmax(support))]
    best: dict[tuple[int, int], tuple[int, PlanePair]] = {}
    least = np.cos(np.radians(NEAR_DEG))
    for pair, found in zip(pairs, normals, strict=True):
        fits = any(n_i @ down > least and n_j @ down > least for n_i, n_j in found)
        size = len(pair.points_i)
        if fits and size > best.get((pair.i, pair.j), (0, pair))[0]:
            best[pair.i, pair.j] = size, pair
    return [pair for _, pair in best.values()]


def _support(alike: NDArray[np.bool_], couple: NDArray[np.int64], weight: Float) -> float:
    """Weight of the couples of pictures that have a normal like this one, each counted once."""
    order = np.flatnonzero(alike)
    heaviest = np.zeros(int(couple.max()) + 1)
    np.maximum.at(heaviest, couple[order], weight[order])
    return float(heaviest.sum())


def _normals(pair: PlanePair, camera: Camera) -> list[tuple[Float, Float]]:
    """Give the normals that a ground plane may have, in the axes of both cameras."""
    try:
        motion = ground_motion(pair.homography, camera, camera)
    except ValueError:
        return []
    spread = np.linalg.svd(motion, compute_uv=False)
    if spread[0] ** 2 - spread[2] ** 2 < PURE_ROTATION:
        return []
    found = []
    for solution in decompose(motion, 1.0):
        for sign in (1.0, -1.0):
            n_i = sign * solution.normal
            n_j = solution.j_from_i.rotation @ n_i
            if _is_down(n_i) and _is_down(n_j):
                found.append((n_i, n_j))
    return found


def _is_down(normal: Float) -> bool:
    """Whether a camera held upright can have the ground on this side."""
    tilt = np.arctan2(normal[2], np.hypot(normal[0], normal[1]))
    if not np.radians(3.0) < tilt <= np.pi / 2:
        return False
    roll = np.arctan2(normal[0], normal[1])
    # looking nearly straight down, roll means little
    return bool(abs(roll) < np.radians(STEEPEST_ROLL_DEG) or tilt > np.radians(75.0))
