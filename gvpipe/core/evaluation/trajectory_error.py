"""How far an estimated trajectory is from the true one: absolute and relative pose errors.

The definitions are those that evo and the TUM RGB-D benchmark use, so numbers compare.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from gvpipe.core.geometry.pose import about_z, rotation_vector
from gvpipe.core.types import Float, Pose, Rejected

Alignment = Literal["none", "origin", "yaw", "se3", "sim3"]
"""What may be fitted before comparing: nothing; the first poses; heading and position over level
ground; a rigid motion; a rigid motion and a scale."""


@dataclass(frozen=True)
class Similarity:
    """``X_reference = scale * rotation @ X_estimate + translation``.

    Attributes
    ----------
    scale : float
        Above 0.
    rotation : (3, 3) float64
        Rotation matrix.
    translation : (3,) float64
        Metres.
    """

    scale: float
    rotation: Float
    translation: Float

    def pose(self, pose: Pose) -> Pose:
        """Carry a pose over; rotations stay rotations."""
        moved = self.points(pose.translation[None])[0]
        return Pose(self.rotation @ pose.rotation, moved)

    def points(self, points: Float) -> Float:
        """Carry (N, 3) points over."""
        return np.asarray(self.scale * points @ self.rotation.T + self.translation)


@dataclass(frozen=True)
class Errors:
    """One error a pose, or a pair of poses.

    Attributes
    ----------
    translation_m : (N,) float64
        Length of the translation error, metres.
    rotation_deg : (N,) float64
        Angle of the rotation error, degrees.
    """

    translation_m: Float
    rotation_deg: Float


def align(
    estimate: Sequence[Pose], reference: Sequence[Pose], how: Alignment
) -> Similarity | Rejected:
    """Fit the estimate to the reference in the least squares sense of the positions.

    Parameters
    ----------
    estimate, reference : sequence of Pose
        The same number, in the same order.
    how : Alignment
        What is free.

    Returns
    -------
    similarity : Similarity or Rejected
        Rejected if the positions leave the fit open.

    Notes
    -----
    Umeyama 1991, eq. 40 to 43, for ``se3`` and ``sim3``; for ``yaw`` the angle that maximises the
    trace of the horizontal covariance.
    """
    if how == "none":
        return Similarity(1.0, np.eye(3), np.zeros(3))
    if how == "origin":
        first = reference[0] @ estimate[0].inverse()
        return Similarity(1.0, first.rotation, first.translation)
    x = np.array([pose.translation for pose in estimate])
    y = np.array([pose.translation for pose in reference])
    mean_x, mean_y = x.mean(axis=0), y.mean(axis=0)
    covariance = (y - mean_y).T @ (x - mean_x) / len(x)
    spread = float(((x - mean_x) ** 2).sum() / len(x))
    if how == "yaw":
        sine, cosine = covariance[1, 0] - covariance[0, 1], covariance[0, 0] + covariance[1, 1]
        if np.hypot(sine, cosine) <= 1e-12 * max(spread, 1e-30):
            return Rejected("the positions leave the heading open")
        rotation = about_z(float(np.arctan2(sine, cosine)))
        return Similarity(1.0, rotation, mean_y - rotation @ mean_x)
    u, d, vt = np.linalg.svd(covariance)
    if d[1] <= 1e-12 * d[0] or d[0] <= 1e-30:
        return Rejected("the positions lie on a line, which leaves the rotation open; try yaw")
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = u @ np.diag(sign) @ vt
    scale = float((d * sign).sum() / spread) if how == "sim3" else 1.0
    return Similarity(scale, rotation, mean_y - scale * rotation @ mean_x)


def absolute_errors(estimate: Sequence[Pose], reference: Sequence[Pose]) -> Errors:
    """Compare each pose with its partner (ATE, or APE).

    Parameters
    ----------
    estimate, reference : sequence of Pose
        The same number, aligned.

    Returns
    -------
    errors : Errors
        One a pose.
    """
    return Errors(
        np.array([_gap(e, r) for e, r in zip(estimate, reference, strict=True)]),
        np.array([_turn(e, r) for e, r in zip(estimate, reference, strict=True)]),
    )


def relative_errors(
    estimate: Sequence[Pose], reference: Sequence[Pose], delta: int, *, all_pairs: bool
) -> Errors:
    """Compare the motions between poses (RPE).

    Parameters
    ----------
    estimate, reference : sequence of Pose
        The same number; alignment does not matter, scale does.
    delta : int
        Poses from the start of a motion to its end.
    all_pairs : bool
        Every start, or only those where the last motion ended.

    Returns
    -------
    errors : Errors
        One a motion; none if there are not more than `delta` poses.
    """
    starts = range(0, len(estimate) - delta, 1 if all_pairs else delta)
    moved = [estimate[k].inverse() @ estimate[k + delta] for k in starts]
    truly = [reference[k].inverse() @ reference[k + delta] for k in starts]
    wrong = [t.inverse() @ m for t, m in zip(truly, moved, strict=True)]
    return Errors(
        np.array([np.linalg.norm(e.translation) for e in wrong]),
        np.array([_angle_deg(e.rotation) for e in wrong]),
    )


def statistics(errors: Float) -> dict[str, float]:
    """Root mean square, mean, median, standard deviation, least, greatest and sum of squares."""
    return {
        "rmse": float(np.sqrt((errors**2).mean())),
        "mean": float(errors.mean()),
        "median": float(np.median(errors)),
        "std": float(errors.std()),
        "min": float(errors.min()),
        "max": float(errors.max()),
        "sse": float((errors**2).sum()),
    }


def path_length(poses: Sequence[Pose]) -> float:
    """Sum of the distances between consecutive positions, metres."""
    positions = np.array([pose.translation for pose in poses])
    return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())


def _gap(a: Pose, b: Pose) -> float:
    """Distance of two positions, metres."""
    return float(np.linalg.norm(a.translation - b.translation))


def _turn(a: Pose, b: Pose) -> float:
    """Angle between two orientations, degrees."""
    return _angle_deg(a.rotation.T @ b.rotation)


def _angle_deg(rotation: Float) -> float:
    """Angle of a rotation, degrees."""
    return float(np.degrees(np.linalg.norm(rotation_vector(rotation))))
