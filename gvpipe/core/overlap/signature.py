"""A rotation-invariant description of the ground in view, which tells places apart.

Colour histograms say what a floor is made of, not where on it a robot stands. A signature keeps
the most distinctive spots of the overhead view with their place and direction. In metric overhead
views one pair of alike spots already fixes the motion between the robots, so two views can be
compared by how many pairs agree on one motion, without any search.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gvpipe.core.geometry.ground import (
    ground_points,
    overhead_grid,
    overhead_view,
    pixel_from_ground,
)
from gvpipe.core.types import Camera, Float, Mount, View

PIXELS_PER_HEIGHT = 120.0
"""Overhead raster: pixels in one camera height. About the resolution of a 640-pixel picture at a
distance of two heights; finer only adds detail that the other view does not have."""

RANGE_HEIGHTS = 4.0
"""Ground farther than this many camera heights is too blurred to have spots of its own."""

MAX_SPOTS = 400
"""Spots kept of a view: enough for some dozens in a tenth of its area, few enough to compare ten
thousand pairs of views in half a minute."""

MARGIN_PX = 8
"""Spots this close to the edge of the seen ground are left out: their surroundings are cut."""

MAX_OFFSET_HEIGHTS = 0.12
"""How far, in camera heights, a spot may lie from where a motion puts it: a tilt that is wrong by
2 degrees shifts ground two heights away by a sixth of a height."""

MAX_TURN = np.radians(20.0)
"""How far a spot's direction may be off; directions scatter by some 5 degrees."""

MIN_VOTES = 8
"""Spots that have to agree: views without common ground reach five."""

DOUBT_VOTES = 10
"""Votes at which a motion is half believed when views are ranked."""

CELLS_PER_HEIGHT = 10
"""Fineness of the count of common ground."""

RATIO = 0.9
"""A spot counts if its best partner is clearly nearer than the second best."""


@dataclass(frozen=True)
class Signature:
    """The distinctive spots of the ground in a view.

    Attributes
    ----------
    camera, mount : Camera, Mount
        The view's.
    points : (n, 2) float64
        Robot frame (x forward, y left), metres.
    directions : (n,) float64
        Radians, counter-clockwise from x.
    descriptors : (n, 128) float32
        Unit length.
    """

    camera: Camera
    mount: Mount
    points: Float
    directions: Float
    descriptors: NDArray[np.float32]


def no_signature(view: View) -> Signature:
    """Return a signature without spots."""
    nothing = (np.empty((0, 2)), np.empty(0), np.empty((0, 128), np.float32))
    return Signature(view.camera, view.mount, *nothing)


def ground_signature(view: View) -> Signature:
    """Describe the ground a view sees; without spots if it sees none or has no texture."""
    height = view.mount.height
    empty = no_signature(view)
    try:
        grid = overhead_grid(
            view.camera, view.mount, PIXELS_PER_HEIGHT / height, RANGE_HEIGHTS * height
        )
    except ValueError:  # looks above the horizon
        return empty
    overhead, seen = overhead_view(view.pixels, view.camera, view.mount, grid)
    inner = cv2.erode(seen.astype(np.uint8), np.ones((2 * MARGIN_PX + 1,) * 2, np.uint8))
    grey = cv2.cvtColor(overhead, cv2.COLOR_RGB2GRAY)
    keypoints, raw = cv2.SIFT.create(nfeatures=MAX_SPOTS).detectAndCompute(grey, inner)
    if raw is None or not len(keypoints):
        return empty
    pixels = np.array([k.pt for k in keypoints])
    points = np.column_stack(
        [
            grid.x_max * grid.pixels_per_metre - pixels[:, 1],
            grid.y_max * grid.pixels_per_metre - pixels[:, 0],
        ]
    )
    # raster directions run clockwise from u, which is minus y of the robot
    directions = -np.radians([k.angle for k in keypoints]) - np.pi / 2
    shares = raw / np.maximum(raw.sum(axis=1, keepdims=True), 1e-6)
    descriptors = np.sqrt(shares).astype(np.float32)
    return Signature(
        view.camera, view.mount, points / grid.pixels_per_metre, directions, descriptors
    )


@dataclass(frozen=True)
class Agreement:
    """The motion most spots of two views agree on.

    Attributes
    ----------
    votes : int
        Pairs of mutually most alike spots it explains; by chance up to five or so.
    j_from_i : (3, 3) float64
        Isometry between the robot frames, metres; identity without votes.
    """

    votes: int
    j_from_i: Float


def agreement(i: Signature, j: Signature) -> Agreement:
    """Find the motion between two robots that most of their views' spots agree on.

    Every pair of spots that are each other's most alike proposes the motion that lays one on the
    other, place and direction; the proposal that lays the most other pairs on each other wins.
    """
    nothing = Agreement(0, np.eye(3))
    if len(i.points) < 2 or len(j.points) < 2:
        return nothing
    of_i, of_j = _partners(i.descriptors @ j.descriptors.T)
    if not len(of_i):
        return nothing
    turn = j.directions[of_j] - i.directions[of_i]
    c, s = np.cos(turn)[:, None], np.sin(turn)[:, None]
    p, q = i.points[of_i], j.points[of_j]
    reach = MAX_OFFSET_HEIGHTS * (i.mount.height + j.mount.height) / 2
    # where each proposal (rows) puts each pair's spot (columns), from where it should be
    px, py = (p[None, :, k] - p[:, None, k] for k in (0, 1))
    qx, qy = (q[None, :, k] - q[:, None, k] for k in (0, 1))
    near = np.hypot(c * px - s * py - qx, s * px + c * py - qy) < reach
    off = np.abs((turn[None, :] - turn[:, None] + np.pi) % (2 * np.pi) - np.pi)
    agree = near & (off < MAX_TURN)
    best = int(agree.sum(axis=1).argmax())
    inliers = agree[best]
    return Agreement(int(inliers.sum()), _isometry(p[inliers], q[inliers], float(turn[best])))


def _isometry(p: Float, q: Float, turn: float) -> Float:
    """Least-squares isometry q from p; the given turn if the points do not fix one."""
    a, b = p - p.mean(axis=0), q - q.mean(axis=0)
    if len(p) > 2:
        cross = float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum())
        turn = float(np.arctan2(cross, float((a * b).sum())))
    c, s = np.cos(turn), np.sin(turn)
    rotation = np.array([[c, -s], [s, c]])
    out = np.eye(3)
    out[:2, :2], out[:2, 2] = rotation, q.mean(axis=0) - rotation @ p.mean(axis=0)
    return out


def _partners(likeness: NDArray[np.float32]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Mutually best pairs that are clearly better than the second best."""
    best_j, best_i = likeness.argmax(axis=1), likeness.argmax(axis=0)
    i = np.flatnonzero(best_i[best_j] == np.arange(len(best_j)))
    two = np.partition(likeness[i], -2, axis=1)[:, -2:]
    # unit vectors: squared distance 2 - 2 cos
    clear = 1.0 - two[:, 1] < RATIO**2 * (1.0 - two[:, 0])
    return i[clear], best_j[i[clear]]


def expected_overlap(i: Signature, j: Signature) -> float:
    """Guess how much ground two views share.

    Returns
    -------
    expected : float
        Share of common ground under the motion most spots agree on, less where few do; 0 where
        too few agree to believe in any.
    """
    found = agreement(i, j)
    if found.votes < MIN_VOTES:
        return 0.0
    belief = found.votes / (found.votes + DOUBT_VOTES)
    return belief * common_ground(i, j, found.j_from_i)


def common_ground(i: Signature, j: Signature, j_from_i: Float) -> float:
    """Share of the ground in view that two views have in common.

    Parameters
    ----------
    i, j : Signature
        The views.
    j_from_i : (3, 3) float64
        Isometry between their robot frames, metres.

    Returns
    -------
    share : float
        Of the view that shares more of its ground, in [0, 1].
    """
    return max(_share(i, j, j_from_i), _share(j, i, np.linalg.inv(j_from_i).astype(np.float64)))


def _share(i: Signature, j: Signature, j_from_i: Float) -> float:
    """Share of the ground seen by i that j sees too."""
    columns, rows = np.mgrid[8 : i.camera.width : 16, 8 : i.camera.height : 16]
    pixels = np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64)
    points, below = ground_points(pixels, i.camera, i.mount)
    points = points[below]
    points = points[np.hypot(points[:, 0], points[:, 1]) < RANGE_HEIGHTS * i.mount.height]
    # pixels crowd where the ground is near: count ground, not pixels
    cell = i.mount.height / CELLS_PER_HEIGHT
    cells = np.unique(np.rint(points / cell), axis=0) * cell
    if not len(cells):
        return 0.0
    there = cells @ j_from_i[:2, :2].T + j_from_i[:2, 2]
    a = pixel_from_ground(j.camera, j.mount)
    q = there @ a[:, :2].T + a[:, 2]
    w = np.where(q[:, 2] > 0, q[:, 2], np.nan)
    u, v = q[:, 0] / w, q[:, 1] / w
    inside = (u >= 0) & (u < j.camera.width) & (v >= 0) & (v < j.camera.height)
    return float(inside.mean())
