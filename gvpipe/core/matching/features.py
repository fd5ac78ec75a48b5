"""What is kept of one image for matching, and where its overhead view is sampled."""

from dataclasses import dataclass, field
from math import radians

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.types import Camera, Float, Mount


@dataclass(frozen=True)
class MatchOptions:
    """Every threshold of the matcher.

    Attributes
    ----------
    features : str
        A key of ``gvpipe.core.matching.matchers.MATCHERS``.
    tilt_sigma, roll_sigma : float
        Error to expect of the configured tilt and roll, radians.
    height_sigma : float
        Error to expect of the ratio of two configured heights, natural logarithm.
    max_tilt_error : float
        Tilts and rolls farther than this from the configured ones belong to another plane, radians.
    min_log10_odds : float
        Decimal exponent of the odds against chance that an accepted homography needs.
    max_uncertainty_px : float
        Largest standard deviation of an accepted homography over the common ground.
    max_range : float
        Ground farther than this many camera heights is not used.
    keypoints : int
        Most keypoints an image (``sift``).
    max_ratio : float
        Largest descriptor distance of a match over that of the runner-up.
    hypotheses : int
        Random pairs of matches drawn for each assumed tilt.
    corners : int
        Most Harris corners an image (``invariants``).
    corner_distance_px : float
        Least distance between them.
    smoothing_px : float
        Scale of the Gaussian derivatives on the overhead view, its pixels.
    min_colour : float
        ``MinD_color``: invariants nearer than this may match.
    min_correlation : float
        ``Minl_c``: least correlation of grey profiles along matched segments.
    max_stretch : float
        Largest relative difference of matched segments' lengths.
    window_px : int
        Side of the best-fit window, overhead pixels.
    max_trials : int
        Most random segments.
    """

    features: str = "sift"
    tilt_sigma: float = radians(3.0)
    roll_sigma: float = radians(3.0)
    height_sigma: float = 0.03
    max_tilt_error: float = radians(14.0)
    min_log10_odds: float = 4.0
    max_uncertainty_px: float = 2.0
    max_range: float = 8.0
    keypoints: int = 1600
    max_ratio: float = 0.85
    hypotheses: int = 2000
    corners: int = 500
    corner_distance_px: float = 5.0
    smoothing_px: float = 1.5
    min_colour: float = 50.0
    min_correlation: float = 0.7
    max_stretch: float = 0.1
    window_px: int = 4
    max_trials: int = 300


@dataclass(frozen=True)
class Features:
    """Points of one image on the ground.

    Attributes
    ----------
    kind : str
        Which extractor made them.
    pixels : (N, 2) float64
        Where they were seen in the undistorted picture.
    ground : (N, 2) float64
        The same in the robot's ground frame under the configured mount, metres.
    descriptors : (N, D)
        What they look like.
    pixels_per_metre : float
        Scale of the overhead view they were described on.
    angle, size : (N,) float64
        Orientation on the ground, radians from forward to left, and diameter, metres; empty where
        the method has none.
    dark : (N,) bool
        Whether it is darker than its surroundings; empty where the method has none.
    """

    kind: str
    pixels: Float
    ground: Float
    descriptors: NDArray[np.generic]
    pixels_per_metre: float
    angle: Float = field(default_factory=lambda: np.empty(0))
    size: Float = field(default_factory=lambda: np.empty(0))
    dark: NDArray[np.bool_] = field(default_factory=lambda: np.empty(0, bool))

    @property
    def nbytes(self) -> int:
        """Memory that the arrays take."""
        arrays = self.pixels, self.ground, self.descriptors, self.angle, self.size, self.dark
        return sum(array.nbytes for array in arrays)


def overhead_scale(camera: Camera, mount: Mount) -> float:
    """Scale for a camera's overhead view, pixels per metre.

    About the picture's own sampling of the ground on the optical axis, as a power of two so that
    cameras of about the same height share it.
    """
    distance = mount.height / max(np.sin(mount.tilt), np.sin(np.radians(10.0)))
    return float(2.0 ** np.round(np.log2(0.75 * camera.fx / distance)))
