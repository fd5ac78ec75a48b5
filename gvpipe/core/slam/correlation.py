"""How much the errors of neighbouring matches have in common, which no number of them averages out.

Patches of neighbouring corners overlap, interpolation and lens leave the same error on a whole
region, and so the errors of a pair's matches are no independent draws: their smooth part has more
energy than its share. The excess is the factor by which a covariance that takes them for
independent is too small.
"""

from collections.abc import Iterable

import numpy as np

from gvpipe.core.geometry.homography import apply
from gvpipe.core.types import Float

JUDGED_LINKS = 400
"""Links that tell how much of the errors is shared: their mean is good to a few per cent."""

MIN_POINTS = 30
"""Matches that tell the smooth part of their errors from the rest: three an unknown of it."""

STRAY = 6.0
"""Errors of more than this many standard deviations are wrong matches, and are left out."""

SMALLEST_PX = 1e-6
"""Errors below which matches are exact and share nothing, pixels."""


def judged_links(count: int) -> slice:
    """Which of so many links tell how much is shared: every n-th, ``JUDGED_LINKS`` at most."""
    return slice(None, None, max(-(-count // JUDGED_LINKS), 1))


def shared_errors(pairs: Iterable[tuple[Float, Float, Float]]) -> float:
    """Variance of what matches of a pair determine, over that of independent errors.

    Parameters
    ----------
    pairs : iterable of (homography, points_i, points_j)
        Pixels of i to pixels of j, (3, 3); matched pixels, (N, 2) each.

    Returns
    -------
    factor : float
        At least 1; 1 too if no pair has enough matches.

    Notes
    -----
    A polynomial of the second order in the picture takes up all that a wrong homography could
    cause. What its four terms of the third order explain beyond is noise, of the longest waves that
    the estimate leaves untouched; its mean square is compared with that of the remaining errors.
    """
    energies = [e for pair in pairs if (e := _cubic_energy(*pair)) is not None]
    return max(1.0, float(np.mean(energies))) if energies else 1.0


def _cubic_energy(homography: Float, points_i: Float, points_j: Float) -> float | None:
    """Mean square of the third-order part of a pair's errors over that of the rest."""
    error = apply(homography, points_i) - points_j
    error = error / np.sqrt(1.0 + _stretch(homography, points_i))[:, None]
    centred = np.hypot(*(error - np.median(error, axis=0)).T)
    usual = float(np.median(centred)) / np.sqrt(2.0 * np.log(2.0))
    good = np.isfinite(centred) & (centred <= STRAY * usual)
    if good.sum() < MIN_POINTS or not usual > SMALLEST_PX:
        return None
    place, error = points_j[good], error[good]
    x, y = ((place - place.mean(axis=0)) / np.maximum(place.std(axis=0), 1e-9)).T
    powers = [x**a * y**b for a, b in _POWERS]
    basis = np.linalg.qr(np.column_stack(powers))[0]
    part = basis.T @ error
    rest = ((error - basis @ part) ** 2).sum() / (len(error) - len(_POWERS))
    return float((part[_CUBIC:] ** 2).sum() / (len(_POWERS) - _CUBIC) / rest)


_POWERS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))
_CUBIC = 6
"""Terms of a polynomial in the picture, and where those of the third order begin."""


def _stretch(homography: Float, points: Float) -> Float:
    """Mean square by which the map magnifies lengths at points (N, 2), (N,)."""
    w = points @ homography[2, :2] + homography[2, 2]
    mapped = apply(homography, points)
    rows = homography[None, :2, :2] - mapped[:, :, None] * homography[2, :2]
    return np.asarray((rows**2).sum(axis=(1, 2)) / (2.0 * w**2))
