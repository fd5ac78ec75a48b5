"""Where the focal length hides in plane homographies: a first guess for self-calibration.

A picture of the plane is metric when the two columns of its homography from the plane, seen
through the calibration, are orthogonal and of one length (Triggs 1998; thesis 2.4). Carried from
one reference picture to all the others, three unknowns, the focal length and the plane's normal,
face two equations a picture.
"""

from collections import deque
from collections.abc import Sequence
from itertools import product

import numpy as np
from scipy.optimize import least_squares

from gvpipe.core.calibration.raw_matching import PlanePair
from gvpipe.core.types import Float

FOCALS = (0.35, 6.0)
"""Focal lengths accepted, picture widths: fields of view from 110 down to 10 degrees."""

START_FOCALS = (0.6, 0.9, 1.3, 2.0)
"""Focal lengths tried, in picture widths: fields of view of 80, 58, 42 and 28 degrees."""

START_TILTS_DEG = (25.0, 45.0, 65.0)
START_ROLLS_DEG = (-15.0, 15.0)
"""Tilts and rolls of the reference picture tried."""


def spanning_tree(pairs: Sequence[PlanePair], count: int) -> tuple[int, dict[int, Float]]:
    """Carry the best linked picture to all others.

    Parameters
    ----------
    pairs : sequence of PlanePair
        Links.
    count : int
        How many pictures there are.

    Returns
    -------
    reference : int
        The picture with most matches.
    from_reference : dict of int to (3, 3) float64
        Homographies from it to every picture it is linked with, fewest links first, then most
        matches; itself included.
    """
    matches = np.zeros(count)
    links: dict[int, list[tuple[int, int, Float]]] = {k: [] for k in range(count)}
    for pair in pairs:
        n = len(pair.points_i)
        matches[[pair.i, pair.j]] += n
        links[pair.i].append((n, pair.j, pair.homography))
        links[pair.j].append((n, pair.i, np.linalg.inv(pair.homography).astype(np.float64)))
    reference = int(matches.argmax())
    found = {reference: np.eye(3)}
    queue = deque([reference])
    while queue:
        here = queue.popleft()
        for _, there, step in sorted(links[here], key=lambda link: (-link[0], link[1])):
            if there not in found:
                found[there] = step @ found[here]
                queue.append(there)
    return reference, found


def metric_residuals(
    unknowns: Float, homographies: Float, centre: tuple[float, float], width: float
) -> Float:
    """How far pictures are from metric, given a calibration and the plane in the reference.

    Parameters
    ----------
    unknowns : (3,) float64
        Logarithm of the focal length over the width; tilt and roll of the reference, radians.
    homographies : (N, 3, 3) float64
        From the reference picture.
    centre : (float, float)
        Principal point, pixels.
    width : float
        Of the pictures, pixels.

    Returns
    -------
    residuals : (2 N,) float64
        Cosine between the two columns and logarithm of the ratio of their lengths.
    """
    focal = np.exp(unknowns[0]) * width
    k = np.array([[focal, 0.0, centre[0]], [0.0, focal, centre[1]], [0.0, 0.0, 1.0]])
    c, s = np.cos(unknowns[1]), np.sin(unknowns[1])
    cr, sr = np.cos(unknowns[2]), np.sin(unknowns[2])
    # the plane's forward and left directions in the axes of the reference camera
    forward = np.array([-s * sr, -s * cr, c])
    left = np.array([-cr, sr, 0.0])
    plane = k @ np.column_stack([forward, left])
    seen = np.linalg.inv(k) @ homographies @ plane
    a, b = seen[..., 0], seen[..., 1]
    length_a, length_b = np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1)
    cosine = (a * b).sum(axis=1) / (length_a * length_b)
    return np.concatenate([cosine, np.log(length_a / length_b)])


def first_guesses(
    homographies: Float,
    centre: tuple[float, float],
    width: float,
    expected: float,
    most: int = 2,
) -> list[Float]:
    """Solve for focal length and plane from several starts.

    Parameters
    ----------
    homographies : (N, 3, 3) float64
        From the reference picture, N >= 2.
    centre, width
        As in :func:`metric_residuals`.
    expected : float
        Focal length to expect, picture widths.
    most : int
        Solutions with a free focal length that are returned.

    Returns
    -------
    guesses : list of (3,) float64
        Different solutions, best first, in the terms of :func:`metric_residuals`; tilts above 0.
        The last has the expected focal length: where the motion hardly shows it, drifting
        homographies lead the free ones astray.
    """

    def solve(focal: float, give: float) -> list[tuple[float, Float]]:
        """Solve with a focal length that may change by a factor of exp(give); best first."""
        nearest, farthest = np.log(FOCALS)
        low = [max(np.log(focal) - give, nearest), 0.02, -1.6]
        high = [min(np.log(focal) + give, farthest), np.pi / 2, 1.6]
        found = []
        for tilt, roll in product(START_TILTS_DEG, START_ROLLS_DEG):
            fit = least_squares(
                metric_residuals,
                np.array([np.log(focal), np.radians(tilt), np.radians(roll)]),
                args=(homographies, centre, width),
                bounds=(low, high),
                loss="soft_l1",
                f_scale=0.05,
                max_nfev=60,
            )
            found.append((float(fit.cost), np.asarray(fit.x)))
        return sorted(found, key=lambda item: item[0])

    free = sorted((s for focal in START_FOCALS for s in solve(focal, 4.0)), key=lambda s: s[0])
    guesses: list[Float] = []
    for _, guess in free:
        if all(np.abs(guess - other).max() > 0.05 for other in guesses):
            guesses.append(guess)
    return [*guesses[:most], solve(expected, 0.01)[0][1]]
