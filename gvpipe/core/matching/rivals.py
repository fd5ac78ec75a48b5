"""Other geometries that a found plane must be compared with: the floor below, the next tile."""

from dataclasses import replace

import cv2
import numpy as np

from gvpipe.core.geometry.ground import (
    ground_points,
    overhead_grid,
    overhead_view,
    pixel_from_ground,
)
from gvpipe.core.geometry.homography import transfer_errors
from gvpipe.core.geometry.twoview import TwoView
from gvpipe.core.kernels.patches import BLANK
from gvpipe.core.matching.hypotheses import Matches
from gvpipe.core.types import Float, View

_LOWER = np.linspace(0.4, 0.96, 29)
"""Heights above the found plane tried, as shares of the height above the ground: a plane higher
than 60 % of the camera fills the picture and is not the floor of anything."""
_LOWER_PX = 5.0
_LOWER_FEWEST = 8  # matches, so that chance (about 1 of 100 along a line of parallax) is ruled out

_REPEAT_SIDE = 144  # pixels of the overhead view that is searched for repetition
_REPEAT_RANGE = 3.0  # camera heights it covers
_REPEAT_SMOOTH = 5.0  # structure coarser than this many pixels is shading, not pattern
_REPEAT_LEAST = 7  # pixels: nearer shifts are the pattern's own smoothness
_REPEAT_OVERLAP = 0.3  # least share of the view that must overlap itself
_REPEAT_CORRELATION = 0.35
_REPEATS = 3

_OPTICS = 0.02
"""Correlation that two pictures of one ground lose because they resolve it differently: a shift
that happens to bring places of like resolution together looks better by as much."""


def plane_at(geometry: TwoView, share: float) -> TwoView:
    """Geometry of the parallel plane lower than the one that `geometry` calls the ground.

    Parameters
    ----------
    geometry : TwoView
        Fitted to a plane at some height, taken for the ground.
    share : float
        Height of camera j above that plane over its height above the ground, 0 to 1.

    Returns
    -------
    lower : TwoView
        The same camera motion, with the configured heights above the lower plane.
    """
    height_i, height_j = geometry.mount_i.height, geometry.mount_j.height
    above = height_j * (1.0 - share)  # of the found plane
    share_i = max(height_i - above, 1e-3 * height_i) / height_i
    return replace(
        geometry,
        x=geometry.x * share,
        y=geometry.y * share,
        log_scale=geometry.log_scale + float(np.log(share / share_i)),
    )


def lower_plane(geometry: TwoView, matches: Matches, inlier_px: float) -> TwoView | None:
    """Parallel plane below the found one that most of the other matches lie on.

    Nothing is to be seen below the ground: if matches follow the same camera motion over a lower
    plane, the found one is the top of an obstacle.

    Parameters
    ----------
    geometry : TwoView
        Of the found plane.
    matches : Matches
        Putative matches.
    inlier_px : float
        Matches nearer than this to the found plane belong to it.

    Returns
    -------
    lower : TwoView or None
        None if hardly any match lies below.
    """
    p, q = matches.pixels_i, matches.pixels_j
    other = transfer_errors(geometry.homography, p, q) > max(inlier_px, 2 * _LOWER_PX)
    if other.sum() < _LOWER_FEWEST:
        return None
    ground, _ = ground_points(p[other], geometry.camera_i, geometry.mount_i)
    from_j = pixel_from_ground(geometry.camera_j, geometry.mount_j)
    counts = []
    for share in _LOWER:
        plane = plane_at(geometry, float(share))
        errors = transfer_errors(from_j @ plane.ground_j_from_ground_i, ground, q[other])
        counts.append(int((errors < _LOWER_PX).sum()))
    best = int(np.argmax(counts))
    return plane_at(geometry, float(_LOWER[best])) if counts[best] >= _LOWER_FEWEST else None


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
    mask = seen.astype(np.float64)
    grey = cv2.cvtColor(overhead, cv2.COLOR_RGB2GRAY) * mask
    weight = np.maximum(cv2.GaussianBlur(mask, (0, 0), _REPEAT_SMOOTH), 1e-3)
    detail = (grey - cv2.GaussianBlur(grey, (0, 0), _REPEAT_SMOOTH) / weight) * mask
    rows, columns = (cv2.getOptimalDFTSize(2 * n) for n in detail.shape)

    def autocorrelation(image: Float) -> Float:
        spectrum = np.fft.rfft2(image, s=(rows, columns))
        return np.asarray(np.fft.irfft2(np.abs(spectrum) ** 2, s=(rows, columns)))

    common, alike = autocorrelation(mask), autocorrelation(detail)
    energy = alike[0, 0] / max(common[0, 0], 1.0)
    alike = alike / np.maximum(common, 1.0) / max(energy, 1e-9)
    alike[common < _REPEAT_OVERLAP * common[0, 0]] = 0.0
    dv = np.fft.fftfreq(rows, 1.0 / rows)[:, None]
    du = np.fft.fftfreq(columns, 1.0 / columns)[None, :]
    alike[(np.hypot(dv, du) < _REPEAT_LEAST) | (dv < 0) | ((dv == 0) & (du < 0))] = 0.0
    peak = (cv2.dilate(alike, np.ones((5, 5))) == alike) & (alike > _REPEAT_CORRELATION)
    v, u = np.nonzero(peak)
    best = np.argsort(-alike[v, u], kind="stable")[:_REPEATS]
    shift = np.column_stack([-dv[v[best], 0], -du[0, u[best]]])  # raster down is backwards
    return shift / grid.pixels_per_metre


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
