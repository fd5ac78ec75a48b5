"""What each link says about where its two robots stand, and how far two of them disagree."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from gvpipe.core.geometry.ground import calibrations
from gvpipe.core.kernels.links import place_links
from gvpipe.core.slam.links import Matches
from gvpipe.core.types import Camera, Float, Index, Mask, Mount

REWEIGHTINGS = 9
"""Rounds of reweighted least squares of a placement; it settles in about five."""


@dataclass(frozen=True)
class Placements:
    """What each link says about where its two robots stand on the ground.

    Attributes
    ----------
    i, j : (E,) int64
        Images of each link.
    centre_i, centre_j : (E, 2) float64
        Centroid of the shared ground points in the robot frames of i and of j, metres.
    turn : (E,) float64
        Heading of i minus heading of j, radians.
    radius : (E,) float64
        RMS distance of the shared points from their centroid, metres: turns a difference of
        heading into one of position.
    tolerance : (E,) float64
        How far apart the two placements may be on average, metres.
    trust : (E,) float64
        Weight in the vote on which links to cut.
    """

    i: Index
    j: Index
    centre_i: Float
    centre_j: Float
    turn: Float
    radius: Float
    tolerance: Float
    trust: Float

    def pick(self, keep: Mask | Index) -> "Placements":
        """Return the links under a mask or of given numbers."""
        return Placements(*(getattr(self, field.name)[keep] for field in fields(self)))


def place_all(
    matches: Matches, ends: Index, cameras: Sequence[Camera], mounts: Sequence[Mount]
) -> Float:
    """Fit the isometry between the ground frames of each link's two robots (thesis 3.3.4).

    Parameters
    ----------
    matches : Matches
        Of E links.
    ends : (E, 2) int64
        Numbers of their images.
    cameras, mounts : sequence of Camera, sequence of Mount
        The N views.

    Returns
    -------
    placed : (E, 7) float64
        Centroid of the shared ground points in the robot frames of i and of j (metres), heading
        of i minus that of j (radians), RMS distance of the points from their centroid, and robust
        RMS distance between the points of j and those of i brought over (metres); NaN where the
        matches do not lie on the ground.
    """
    inverse = np.asarray(np.linalg.inv(calibrations(cameras)), dtype=np.float64)
    held = np.array([(m.tilt, m.roll, m.height) for m in mounts]).reshape(-1, 3)
    return np.asarray(
        place_links(
            matches.start,
            matches.points_i,
            matches.points_j,
            ends,
            held,
            inverse,
            REWEIGHTINGS,
        )
    )


def turned(heading: Float, points: Float) -> Float:
    """Points (E, 2) turned counter-clockwise by headings (E,)."""
    c, s = np.cos(heading), np.sin(heading)
    return np.column_stack(
        [c * points[:, 0] - s * points[:, 1], s * points[:, 0] + c * points[:, 1]]
    )


def wrapped(angle: Float) -> Float:
    """Angles in [-pi, pi), radians."""
    return np.asarray((angle + np.pi) % (2.0 * np.pi) - np.pi)


def disagreements(links: Placements, planar: Float) -> Float:
    """Tell how far apart the two images of each link place their shared ground.

    Parameters
    ----------
    links : Placements
        E links.
    planar : (N, 3) float64
        x, y (metres) and heading (radians) of every robot.

    Returns
    -------
    residuals : (E, 3) float64
        Difference of the centroids (two components) and of heading times radius, metres. The
        norm of a row is the RMS distance between the two placements of the points.
    """
    a, b = planar[links.i], planar[links.j]
    apart = a[:, :2] + turned(a[:, 2], links.centre_i) - b[:, :2] - turned(b[:, 2], links.centre_j)
    turn = wrapped(a[:, 2] - b[:, 2] - links.turn) * links.radius
    return np.column_stack([apart, turn])
