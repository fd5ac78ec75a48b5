"""Shifted geometries of a repetitive ground, which look alike: the next tile."""

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from gvpipe.core.geometry.ground import overhead_grid, overhead_view
from gvpipe.core.geometry.twoview import TwoView
from gvpipe.core.kernels.patches import BLANK
from gvpipe.core.matching.candidate import Candidate, Pair, examine
from gvpipe.core.matching.patches import correlations
from gvpipe.core.types import Float, View

_REPEAT_SIDE = 144  # pixels of the overhead view that is searched for repetition
_REPEAT_RANGE = 3.0  # camera heights it covers
_REPEAT_SMOOTH = 5.0  # structure coarser than this many pixels is shading, not pattern
_REPEAT_LEAST = 7  # pixels: nearer shifts are the pattern's own smoothness
_REPEAT_OVERLAP = 0.3  # least share of the view that must overlap itself
_REPEAT_CORRELATION = 0.35
_REPEATS = 3

_AMBIGUOUS = 0.6  # share of agreeing patches of a shifted geometry, of the found one's
_COMPARED = 2.0  # sample distance: coarse enough that views which resolve the ground unlike agree
_DISTINCT = 0.3
"""Least distinctness of a geometry that shifted ones rival. Chosen on 450 rendered pairs of five
repetitive floors: wrong ones reached 0.20 there, right ones up to 0.9 where the ground has marks
of its own, and are refused where these are faint."""

_OPTICS = 0.02
"""Correlation that two pictures of one ground lose because they resolve it differently: a shift
that happens to bring places of like resolution together looks better by as much."""


def repetitions(view: View, geometry: TwoView) -> Float:
    """Shifts under which the ground of view i looks like itself.

    Parameters
    ----------
    view : View
        Image i.
    geometry : TwoView
        With its refined tilt.

    Returns
    -------
    shifts : (K, 2) float64
        On the ground of i, metres; most alike first; opposite ones are not listed.

    Notes
    -----
    Normalised autocorrelation of the band-passed overhead view by Fourier transform, over the part
    that a shift leaves in common.
    """
    mount = geometry.mount_i
    reach = _REPEAT_RANGE * mount.height
    grid = overhead_grid(view.camera, mount, _REPEAT_SIDE / reach, reach)
    overhead, seen = overhead_view(view.pixels, view.camera, mount, grid)
    mask = seen.astype(np.float32)
    grey = cv2.cvtColor(overhead, cv2.COLOR_RGB2GRAY) * mask
    weight = np.maximum(cv2.GaussianBlur(mask, (0, 0), _REPEAT_SMOOTH), 1e-3)
    detail = (grey - cv2.GaussianBlur(grey, (0, 0), _REPEAT_SMOOTH) / weight) * mask
    common, alike = (_autocorrelation(a.astype(np.float32, copy=False)) for a in (mask, detail))
    half, columns = common.shape
    energy = alike[0, 0] / max(common[0, 0], 1.0)
    alike = alike / np.maximum(common, 1.0) / max(energy, 1e-9)
    alike[common < _REPEAT_OVERLAP * common[0, 0]] = 0.0
    dv = np.arange(half, dtype=float)[:, None]
    du = np.fft.fftfreq(columns, 1.0 / columns)[None, :]
    alike[(np.hypot(dv, du) < _REPEAT_LEAST) | ((dv == 0) & (du < 0))] = 0.0
    peak = (cv2.dilate(alike, np.ones((5, 5))) == alike) & (alike > _REPEAT_CORRELATION)
    v, u = np.nonzero(peak)
    best = np.argsort(-alike[v, u], kind="stable")[:_REPEATS]
    shift = np.column_stack([-dv[v[best], 0], -du[0, u[best]]])  # raster down is backwards
    return shift / grid.pixels_per_metre


def _autocorrelation(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Sum up the products of an image and itself, shifted down and to either side.

    Upper half of a periodic table: opposite shifts are alike. It is large enough for shifts of one
    way not to meet those of the other.
    """
    rows, columns = image.shape
    height, width = (cv2.getOptimalDFTSize(2 * n) for n in image.shape)
    padded = np.zeros((height, width), np.float32)
    padded[:rows, :columns] = image
    spectrum = cv2.dft(padded, nonzeroRows=rows)
    power = cv2.mulSpectrums(spectrum, spectrum, 0, conjB=True)
    half = (height + 1) // 2
    flags = cv2.DFT_INVERSE | cv2.DFT_SCALE | cv2.DFT_REAL_OUTPUT
    return cv2.dft(power, flags=flags, nonzeroRows=half)[:half].astype(np.float32, copy=False)


def shifted(geometry: TwoView, shift: Float) -> TwoView:
    """Geometry that takes the ground of i for what lies `shift` metres from it."""
    x, y = geometry.ground_j_from_ground_i[:2, :2] @ shift
    return replace(geometry, x=geometry.x + float(x), y=geometry.y + float(y))


def distinctness(own: Float, others: Float) -> float:
    """How surely the found geometry is more than one of many shifts of a repetitive ground.

    Where the ground only repeats, the found geometry is the best of K + 1 on one patch of K + 1;
    where it has marks of its own, on most of them.

    Parameters
    ----------
    own : (N,) float64
        Correlation of the patches under the found geometry; below zero: not aligned.
    others : (K, N) float64
        The same under the shifted ones.

    Returns
    -------
    share : float
        Patches on which the found geometry is the best of all, of those with texture, beyond the
        share that chance gives it; 0 = chance, 1 = all.
    """
    rivals = (others > 0).sum(axis=0)
    compared = (own > 0) & (rivals > 0)
    wins = int((compared & (own > others.max(axis=0) + _OPTICS)).sum())
    by_chance = float((1.0 / (1.0 + rivals[compared])).sum())
    return (wins - by_chance) / max(int((own > BLANK).sum()) - by_chance, 1.0)


def _rivals(pair: Pair, found: Candidate, view_i: View) -> list[tuple[float, Candidate]]:
    """Shifts of a repetitive ground in metres, and what the pictures say for each."""
    geometry = found.aligned.fit.geometry
    rivals = []
    for shift in repetitions(view_i, geometry):
        for sign in (1.0, -1.0):
            other = shifted(geometry, sign * shift)
            rival = examine(pair, other, other, coarseness=(1.0,))
            if rival is None:
                continue
            moved = rival.aligned.fit.geometry
            length = float(np.hypot(*shift))
            if np.hypot(moved.x - geometry.x, moved.y - geometry.y) > 0.5 * length:
                rivals.append((length, rival))
    return rivals


def ambiguity(pair: Pair, found: Candidate, view_i: View) -> str | None:
    """Say which shift of a repetitive ground agrees as well as the found geometry.

    Parameters
    ----------
    pair : Pair
        The views.
    found : Candidate
        A geometry that nothing else is to be said against.
    view_i : View
        The first view, whose ground may repeat.

    Returns
    -------
    reason : str or None
        None if none does.
    """
    rivals = _rivals(pair, found, view_i)
    least = _AMBIGUOUS * found.evidence.share
    equal = [(length, rival) for length, rival in rivals if rival.evidence.share > least]
    if not equal:
        return None
    points = found.aligned.points_i
    own, *others = (
        correlations(candidate.aligned.fit.geometry, *pair.pyramids, points, _COMPARED)
        for candidate in (found, *(rival for _, rival in rivals))
    )
    if distinctness(own, np.array(others)) > _DISTINCT:
        return None
    length, rival = equal[0]
    return (
        f"the ground repeats every {length:.2f} m: "
        f"{found.evidence.inliers} of {found.evidence.tested} patches agree, shifted "
        f"by that {rival.evidence.inliers} of {rival.evidence.tested}"
    )
