"""Focal length, lens and tilts from pictures of the ground alone.

All homographies between the pictures are explained at once: each is ``K (R + t n^T / d) K^-1``
with one K (Triggs 1998, Malis and Cipolla 2002; thesis chapter 2). The plane's cameras are the
unknowns, so the constraints hold exactly, and the least squares error is in pixels.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gvpipe.core.calibration.circular_points import FOCALS, first_guesses, spanning_tree
from gvpipe.core.calibration.plane_cameras import GLOBALS, POSE, Matches, ray_from_ground, residuals
from gvpipe.core.calibration.plane_descent import LOSS_SIGMAS, Descent, covariance, descend
from gvpipe.core.calibration.raw_matching import PlanePair
from gvpipe.core.types import Float, Rejected

SCOUTS, MATCHES = 1200, 6000
"""Matches in all that choose between the first guesses, and that refine the chosen one."""

EXPECTED_FOCAL = 0.87
"""Focal length to expect, picture widths: 60 degrees from side to side."""

FEWEST_PICTURES = 3
"""Two pictures leave the focal length open (Triggs 1998)."""

WORST_FOCAL_SHARE = 0.08
"""A standard deviation of the focal length beyond this share of it is no calibration."""

WORST_ERROR_PX = 4.0
"""Root mean square transfer error, on pictures 1000 pixels wide, beyond which pictures do not
show one plane through one lens."""


@dataclass(frozen=True)
class SelfCalibration:
    """What the pictures say of the camera that took them.

    Attributes
    ----------
    focal_px, focal_sigma_px : float
        Focal length and its standard deviation, pixels.
    k1, k2 : float
        Radial distortion, OpenCV's.
    tilt, roll : dict of int to float
        Of each picture, radians.
    tilt_sigma : dict of int to float
        Standard deviation of the tilts, radians.
    height : dict of int to float
        Of each picture over the median height.
    error_px : float
        Root mean square transfer error of the inliers.
    matches : int
        Inliers used.
    """

    focal_px: float
    focal_sigma_px: float
    k1: float
    k2: float
    tilt: dict[int, float]
    roll: dict[int, float]
    tilt_sigma: dict[int, float]
    height: dict[int, float]
    error_px: float
    matches: int


def self_calibrate(
    pairs: Sequence[PlanePair],
    count: int,
    size: tuple[int, int],
    rng: np.random.Generator,
    centre: tuple[float, float] | None = None,
    expected_px: float | None = None,
) -> SelfCalibration | Rejected:
    """Calibrate a camera by the ground it sees.

    Parameters
    ----------
    pairs : sequence of PlanePair
        Plane homographies with their matches.
    count : int
        How many pictures there are; all by one camera at one focal length.
    size : (int, int)
        Width and height, pixels.
    rng : Generator
        Which matches are used.
    centre : (float, float), optional
        Principal point, pixels; the middle if left out.
    expected_px : float, optional
        Focal length that EXIF tells; only where the search begins.

    Returns
    -------
    calibration : SelfCalibration or Rejected
        Rejected with the reason if the motion leaves the focal length open.
    """
    width, height = size
    middle = centre or ((width - 1) / 2, (height - 1) / 2)
    reference, from_reference = spanning_tree(pairs, count) if pairs else (0, {})
    if len(from_reference) < FEWEST_PICTURES:
        return Rejected(
            f"{len(from_reference)} pictures show one plane together; {FEWEST_PICTURES} needed"
        )
    members = sorted(from_reference)
    index = {image: k for k, image in enumerate(members)}
    used = [pair for pair in pairs if pair.i in index and pair.j in index]
    few, many = (_collect(used, index, middle, width, n, rng) for n in (SCOUTS, MATCHES))
    expected = expected_px / width if expected_px else EXPECTED_FOCAL
    homographies = np.array([from_reference[image] for image in members if image != reference])
    best: Descent | None = None
    for guess in first_guesses(homographies, middle, width, expected):
        poses = _start_poses(guess, [from_reference[k] for k in members], middle, width)
        shared = np.array([guess[0], 0.0, 0.0])
        state = descend(shared, poses, few, index[reference], np.log(expected))
        if best is None or state.cost < best.cost:
            best = state
    assert best is not None  # there is at least one guess
    best = descend(best.shared, best.poses, many, index[reference], np.log(expected))
    return _verdict(best, many, members, len(used), index[reference], width)


def _collect(
    pairs: Sequence[PlanePair],
    index: dict[int, int],
    centre: tuple[float, float],
    width: float,
    most: int,
    rng: np.random.Generator,
) -> Matches:
    """Draw matches of each pair, half of them turned round: no picture is only a target."""
    columns: list[list[Float]] = [[], [], [], []]
    for pair in pairs:
        keep = rng.permutation(len(pair.points_i))[: max(most // len(pairs), 8)]
        p, q = (np.asarray(v)[keep] for v in (pair.points_i, pair.points_j))
        i, j = np.full(len(p), index[pair.i]), np.full(len(p), index[pair.j])
        turned = np.arange(len(p)) >= len(p) // 2
        columns[0].append(np.where(turned[:, None], q, p))
        columns[1].append(np.where(turned[:, None], p, q))
        columns[2].append(np.where(turned, j, i))
        columns[3].append(np.where(turned, i, j))
    points_i, points_j, camera_i, camera_j = (np.concatenate(c) for c in columns)
    return Matches(
        (points_i - centre) / width,
        (points_j - centre) / width,
        camera_i.astype(np.int64),
        camera_j.astype(np.int64),
    )


def _start_poses(
    guess: Float, from_reference: Sequence[Float], centre: tuple[float, float], width: float
) -> Float:
    """Read every camera's pose off its homography from the plane."""
    focal = float(np.exp(guess[0])) * width
    k = np.array([[focal, 0.0, centre[0]], [0.0, focal, centre[1]], [0.0, 0.0, 1.0]])
    own = np.array([[0.0, 0.0, 0.0, 0.0, guess[1], guess[2]]])
    reference_from_ground = ray_from_ground(own)[0]
    poses = []
    for homography in from_reference:
        m = np.linalg.inv(k) @ homography @ k @ reference_from_ground
        m *= np.sign(np.linalg.det(m)) * np.sign(np.linalg.det(reference_from_ground))
        m /= np.sqrt(np.linalg.norm(m[:, 0]) * np.linalg.norm(m[:, 1]))
        u, _, vt = np.linalg.svd(m[:, :2], full_matrices=False)
        r12 = u @ vt
        rotation = np.column_stack([r12, np.cross(r12[:, 0], r12[:, 1])])  # camera from map
        x, y, z = -rotation.T @ m[:, 2]
        ahead = rotation[2]
        tilt = np.arctan2(-ahead[2], np.hypot(ahead[0], ahead[1]))
        yaw = np.arctan2(ahead[1], ahead[0])
        roll = np.arctan2(-rotation[0, 2], -rotation[1, 2])
        poses.append([x, y, yaw, np.log(max(z, 1e-2)), tilt, roll])
    return np.array(poses)


def _verdict(
    state: Descent, matches: Matches, members: list[int], pairs: int, reference: int, width: float
) -> SelfCalibration | Rejected:
    """Judge a solution by its covariance and its residuals."""
    # a point that k pairs share is no k points: each picture's evidence counts once
    repeats = max(2.0 * pairs / len(members), 1.0)
    spread = covariance(state, matches, reference, repeats)
    errors = residuals(state.shared, state.poses, matches)
    inlier = np.linalg.norm(errors, axis=1) < LOSS_SIGMAS * state.sigma
    error_px = float(np.sqrt((errors[inlier] ** 2).sum(axis=1).mean())) * width
    focal = float(np.exp(state.shared[0])) * width
    share = float(np.sqrt(spread[0, 0]))
    if error_px > WORST_ERROR_PX * width / 1000:
        return Rejected(
            f"one lens over one plane explains the matches to {error_px:.1f} px only, "
            f"{WORST_ERROR_PX * width / 1000:.1f} px needed"
        )
    if not FOCALS[0] * width < focal < FOCALS[1] * width:
        return Rejected(f"the focal length comes out as {focal:.0f} px, which no such camera has")
    if not share < WORST_FOCAL_SHARE:
        return Rejected(
            f"the motion leaves the focal length open: {focal:.0f} px with a standard deviation "
            f"of {100 * share:.0f} %, {100 * WORST_FOCAL_SHARE:.0f} % needed; turn the camera "
            "between pictures and do not look straight down"
        )
    poses = state.poses
    heights = np.exp(poses[:, 3])
    sigma = np.sqrt(np.maximum(np.diag(spread)[GLOBALS:].reshape(-1, POSE)[:, 4], 0.0))
    return SelfCalibration(
        focal_px=focal,
        focal_sigma_px=share * focal,
        k1=float(state.shared[1]),
        k2=float(state.shared[2]),
        tilt={image: float(poses[k, 4]) for k, image in enumerate(members)},
        roll={image: float(poses[k, 5]) for k, image in enumerate(members)},
        tilt_sigma={image: float(sigma[k]) for k, image in enumerate(members)},
        height={image: float(heights[k] / np.median(heights)) for k, image in enumerate(members)},
        error_px=error_px,
        matches=int(inlier.sum()),
    )
