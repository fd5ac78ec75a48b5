"""What each link says about where its two robots stand, and how far two of them disagree."""

from dataclasses import dataclass

import numpy as np

from gvpipe.core.types import Float, Index, Mask


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
        return Placements(*(getattr(self, name)[keep] for name in self.__dataclass_fields__))


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
