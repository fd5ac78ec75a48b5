"""Where two robots stand relative to each other, from matched pixels and how cameras are held."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gvpipe.core.ground import ground_points
from gvpipe.core.types import Camera, Float, Mount

REWEIGHTINGS = 10
"""Rounds of reweighted least squares of an isometry; it settles in about five."""

SAMPLE_POINTS = 60
SAMPLE_LINKS = 40
"""Points a link and links a robot that the search for the tilt looks at."""

KNOWN_TILTS = np.radians(np.arange(-6.0, 6.01, 1.0))
"""Offsets tried on a configured tilt, radians: users are off by a few degrees."""

ANY_TILTS = np.radians(np.arange(5.0, 88.0, 2.5))
"""Tilts tried where none is configured, radians."""

POOR_MISFIT = 0.3
"""Relative misfit that an impossible or hopeless placement counts as."""


@dataclass(frozen=True)
class Placement:
    """Isometry between the ground frames of two robots, as seen by one link.

    Attributes
    ----------
    centre_i, centre_j : (2,) float64
        Centroid of the shared ground points in either robot frame, metres.
    turn : float
        Heading of i minus heading of j, radians.
    radius : float
        RMS distance of the points from their centroid, metres.
    misfit : float
        Robust RMS distance between the points of j and those of i brought over, metres.
    """

    centre_i: Float
    centre_j: Float
    turn: float
    radius: float
    misfit: float


def place(
    points_i: Float, points_j: Float, cameras: tuple[Camera, Camera], mounts: tuple[Mount, Mount]
) -> Placement | None:
    """Fit the isometry between two robots' ground frames to matched pixels (thesis 3.3.4).

    Parameters
    ----------
    points_i, points_j : (N, 2) float64
        Matched pixels.
    cameras, mounts : pair of Camera, pair of Mount
        The views.

    Returns
    -------
    placement : Placement or None
        Reweighted least squares; None if fewer than three matches lie below both horizons.
    """
    ground_i, below_i = ground_points(points_i, cameras[0], mounts[0])
    ground_j, below_j = ground_points(points_j, cameras[1], mounts[1])
    both = below_i & below_j
    if both.sum() < max(3, len(both) // 2):
        return None
    a, b = ground_i[both], ground_j[both]
    weight = 1.0 / (1.0 + (a**2).sum(axis=1) / mounts[0].height ** 2)
    base = weight
    for _ in range(REWEIGHTINGS):
        share = weight / weight.sum()
        ca, cb = share @ a, share @ b
        da, db = a - ca, b - cb
        cross = share @ (da[:, 0] * db[:, 1] - da[:, 1] * db[:, 0])
        turn = float(np.arctan2(cross, share @ (da * db).sum(axis=1)))
        c, s = np.cos(turn), np.sin(turn)
        miss_sq = ((da - db @ np.array([[c, -s], [s, c]])) ** 2).sum(axis=1)
        scale_sq = 4.0 * np.median(miss_sq) + 1e-12
        weight = base / (1.0 + miss_sq / scale_sq)
    share = weight / weight.sum()
    return Placement(
        ca, cb, turn, float(np.sqrt(share @ (da**2).sum(axis=1))), float(np.sqrt(share @ miss_sq))
    )


def tuned_mounts(
    cameras: Mapping[str, Camera],
    mounts: Mapping[str, Mount],
    robots: Mapping[str, str],
    links: Sequence[tuple[str, str, Float, Float]],
) -> dict[str, Mount]:
    """Tilts that make the matches of each robot's own images most nearly isometries.

    Parameters
    ----------
    cameras, mounts : mapping of image id to Camera, Mount
        The views as configured.
    robots : mapping of image id to robot
        One tilt offset is found per robot (one tilt, where none is known).
    links : sequence of (image i, image j, (N, 2) pixels of i, (N, 2) pixels of j)
        Matched images.

    Returns
    -------
    tuned : dict of image id to Mount
        A starting point only: the adjustment estimates every tilt by itself.
    """
    tuned = dict(mounts)
    for robot in dict.fromkeys(robots.values()):
        own = [x for x in links if robots[x[0]] == robot == robots[x[1]]]
        images = [image for image, carrier in robots.items() if carrier == robot]
        if not own:
            continue
        sample = own[:: -(-len(own) // SAMPLE_LINKS)]
        known = all(mounts[image].tilt_known for image in images)
        tilts = KNOWN_TILTS if known else ANY_TILTS

        def held(image: str, tilt: float, known: bool = known) -> Mount:
            mount = mounts[image]
            return replace(mount, tilt=mount.tilt + tilt if known else tilt)

        scores = np.array(
            [
                np.mean([_misfit(x, cameras, held(x[0], t), held(x[1], t)) for x in sample])
                for t in tilts
            ]
        )
        best = _lowest(tilts, scores)
        tuned |= {image: held(image, best) for image in images}
    return tuned


def _misfit(
    link: tuple[str, str, Float, Float], cameras: Mapping[str, Camera], i: Mount, j: Mount
) -> float:
    """Misfit of a link's isometry over the radius of its points, bounded."""
    image_i, image_j, points_i, points_j = link
    every = -(-len(points_i) // SAMPLE_POINTS)
    pair = (cameras[image_i], cameras[image_j])
    placement = place(points_i[::every], points_j[::every], pair, (i, j))
    if placement is None or placement.radius <= 0:
        return POOR_MISFIT
    return min(placement.misfit / placement.radius, POOR_MISFIT)


def _lowest(x: Float, y: Float) -> float:
    """Abscissa of the minimum, by a parabola through the lowest sample and its neighbours."""
    k = int(np.argmin(y))
    if k in (0, len(x) - 1):
        return float(x[k])
    left, right = y[k - 1] - y[k], y[k + 1] - y[k]
    step = (x[k + 1] - x[k - 1]) / 2.0
    bend = left + right
    return float(x[k] + step * (left - right) / (2.0 * bend)) if bend > 0 else float(x[k])
