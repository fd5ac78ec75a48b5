"""The frozen records that pass between core, stages and artefacts."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
"""An array of float64; its shape is stated where it is used."""

Index = NDArray[np.int64]
"""An array of int64: numbers of things, or where lists laid out one after the other begin."""

Mask = NDArray[np.bool_]
"""An array of bool: which of several things are meant."""

Image = NDArray[np.uint8]
"""(H, W, 3) uint8 RGB pixels."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion (images are undistorted when they are read).

    Attributes
    ----------
    width, height : int
        Image size, pixels.
    fx, fy, cx, cy, skew : float
        Intrinsics, pixels; pixel centres lie at integers.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    skew: float = 0.0

    @property
    def matrix(self) -> Float:
        """The (3, 3) calibration matrix K, pixels from camera rays (x right, y down, z ahead)."""
        return np.array([[self.fx, self.skew, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def inverse(self) -> Float:
        """The (3, 3) inverse of :attr:`matrix`, camera rays from pixels, in closed form."""
        a, b, s = 1.0 / self.fx, 1.0 / self.fy, self.skew / (self.fx * self.fy)
        return np.array([[a, -s, s * self.cy - a * self.cx], [0.0, b, -b * self.cy], [0, 0, 1.0]])


@dataclass(frozen=True)
class Mount:
    """How a camera is held over the ground: what the user knows, or what was estimated.

    Attributes
    ----------
    tilt : float
        Optical axis below the horizon, radians; 0 = level, pi/2 = straight down.
    roll : float
        About the optical axis, radians, positive = camera turned clockwise seen from behind.
    height : float
        Camera centre above the ground, metres.
    tilt_known : bool
        False when the tilt is only a starting value that has to be estimated (``tilt: auto``).
    """

    tilt: float
    roll: float
    height: float
    tilt_known: bool = True


@dataclass(frozen=True)
class View:
    """All that core needs of one image.

    Attributes
    ----------
    image_id : str
        ``robot/file name``.
    pixels : (H, W, 3) uint8
        Undistorted RGB pixels.
    camera : Camera
        Intrinsics of the undistorted pixels.
    mount : Mount
        Prior of the camera over the ground.
    """

    image_id: str
    pixels: Image
    camera: Camera
    mount: Mount


@dataclass(frozen=True)
class Pose:
    """A rigid motion ``X_target = rotation @ X_source + translation``.

    The variable's name says which frames: ``map_from_camera``.

    Attributes
    ----------
    rotation : (3, 3) float64
        Rotation matrix.
    translation : (3,) float64
        Metres.
    """

    rotation: Float
    translation: Float

    def __matmul__(self, other: "Pose") -> "Pose":
        return Pose(
            self.rotation @ other.rotation, self.rotation @ other.translation + self.translation
        )

    def inverse(self) -> "Pose":
        """Return the opposite motion, source from target."""
        return Pose(self.rotation.T, -self.rotation.T @ self.translation)


@dataclass(frozen=True)
class PosedView:
    """An image whose camera pose in the map is known.

    Attributes
    ----------
    image_id : str
        ``robot/file name``.
    pixels : (H, W, 3) uint8
        Undistorted RGB pixels.
    camera : Camera
        Intrinsics of the undistorted pixels.
    map_from_camera : Pose
        Camera (x right, y down, z ahead) to map (ground z = 0, z up), metres.
    """

    image_id: str
    pixels: Image
    camera: Camera
    map_from_camera: Pose


@dataclass(frozen=True)
class Rejected:
    """An expected failure as a value: no result, and why.

    Attributes
    ----------
    reason : str
        What was measured against which threshold, in one sentence.
    candidates, trials, inliers : int
        How far the attempt came.
    probability : float
        That what was found is right all the same.
    """

    reason: str
    candidates: int = 0
    trials: int = 0
    inliers: int = 0
    probability: float = 0.0


@dataclass(frozen=True)
class PairMatch:
    """The ground homography between two views and the evidence for it.

    Attributes
    ----------
    homography : (3, 3) float64
        Pixels of i to pixels of j, for points of the ground, ``[2, 2] == 1``.
    homography_initial : (3, 3) float64
        The same from the overhead isometry alone, before refinement.
    overhead_j_from_i : (3, 3) float64
        Isometry (similarity if the heights differ from what was configured) between the ground
        frames of the two robots, metres.
    points_i, points_j : (N, 2) float64
        Inlier pixels.
    error_px : float
        RMS transfer error of the inliers in image j, pixels.
    tilt_i, tilt_j : float
        Refined tilts, radians below the horizon.
    candidates, trials : int
        Corner pairs offered and hypotheses tried.
    probability : float
        That the homography is the ground's within three pixels, from the evidence of the pair.
    covariance : (9, 9) float64 or None
        Of the row-major entries of `homography` (rank 8).
    """

    homography: Float
    homography_initial: Float
    overhead_j_from_i: Float
    points_i: Float
    points_j: Float
    error_px: float
    tilt_i: float
    tilt_j: float
    candidates: int
    trials: int
    probability: float = 1.0
    covariance: Float | None = None
