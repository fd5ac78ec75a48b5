"""Whether a fitted ground plane is to be believed, in words and numbers."""

from dataclasses import dataclass

import numpy as np
from scipy.special import bdtrc

from gvpipe.core.geometry.twoview import PairPrior, TwoView
from gvpipe.core.kernels.patches import BLANK
from gvpipe.core.matching.features import MatchOptions
from gvpipe.core.matching.patches import Aligned
from gvpipe.core.types import Float

_CHANCE = 0.02
"""Share of patches that look alike and follow one plane under a wrong homography: 6 of 250 is the
most seen over views that share no ground, mostly none."""

_LOG10_TESTS = 2.0  # geometries whose patches are compared, and neighbouring patches that overlap
_MOST_LOG10_ODDS = 300.0
_EVEN_LOG10_ODDS = 4.0
"""Odds at which a plane is as often right as wrong: over 3,400 pairs, rendered and photographed,
none below 1 was right and none above 6 a product of chance."""

_OTHER_PLANE = 1e-3
"""Share of sound planes that are not the ground: tops of obstacles that hide the ground around."""

WRONG_PX = 3.0
"""A homography off by more than this over the common ground is called wrong."""

_MODEL_PX = 0.05  # systematic error of patches that their covariance does not show


@dataclass(frozen=True)
class Evidence:
    """What speaks for a fitted plane.

    Attributes
    ----------
    inliers, tested : int
        Patches that agree, of those with texture that both views hold.
    log10_odds : float
        Against chance having produced them, less what the departure from the configured tilts
        and rolls costs.
    uncertainty_px : float
        RMS standard deviation of the homography over the common ground, in picture j.
    drift : float
        Largest departure from the configured tilts and rolls, radians.
    tilt_i, tilt_j : float
        Of the cameras over this plane, radians below the horizon.
    """

    inliers: int
    tested: int
    log10_odds: float
    uncertainty_px: float
    drift: float
    tilt_i: float
    tilt_j: float

    @property
    def share(self) -> float:
        """Patches that agree, of those tested."""
        return self.inliers / max(self.tested, 1)

    @property
    def probability(self) -> float:
        """That the homography is right within three pixels.

        Patches that agree by chance are binomial; errors of a plane that is not due to chance are
        taken as normal with the fit's own covariance in both directions.
        """
        by_chance = 10.0 ** -max(self.log10_odds - _EVEN_LOG10_ODDS, -_MOST_LOG10_ODDS)
        sigma = np.hypot(self.uncertainty_px, _MODEL_PX) / np.sqrt(2.0)
        within = -np.expm1(-0.5 * (WRONG_PX / sigma) ** 2)
        return float(within * (1.0 - _OTHER_PLANE) / (1.0 + by_chance))


def uncertainty_px(aligned: Aligned, covariance: Float) -> float:
    """RMS standard deviation, pixels of j, of the patches' positions under the homography."""
    points = aligned.points_i[aligned.correlation > BLANK]
    h = aligned.fit.geometry.homography
    m = points @ h[:, :2].T + h[:, 2]
    y, w = m[:, :2] / m[:, 2:], m[:, 2]
    one = np.column_stack([points, np.ones(len(points))]) / w[:, None]
    jacobian = np.zeros((len(points), 2, 9))
    jacobian[:, 0, 0:3], jacobian[:, 0, 6:9] = one, -y[:, :1] * one
    jacobian[:, 1, 3:6], jacobian[:, 1, 6:9] = one, -y[:, 1:] * one
    variance = np.einsum("nab,bc,nac->n", jacobian, covariance, jacobian)
    return float(np.sqrt(max(variance.mean(), 0.0)))


def weigh(aligned: Aligned, covariance: Float, expected: TwoView, prior: PairPrior) -> Evidence:
    """Collect the evidence for aligned patches.

    Parameters
    ----------
    aligned : Aligned
        The fit.
    covariance : (9, 9) float64
        Of its homography.
    expected : TwoView
        As configured.
    prior : PairPrior
        Error of the configuration.

    Returns
    -------
    evidence : Evidence
    """
    geometry = aligned.fit.geometry
    # a right plane is near the configured tilts, a wrong one anywhere: a few patches that would
    # do for the one do not for the other
    off = ((geometry.parameters - expected.parameters) * prior.weights)[4:]
    unlikely = 0.5 * float(off @ off) / np.log(10.0)
    inliers = int(aligned.agrees.sum())
    tested = int((aligned.correlation > BLANK).sum())
    with np.errstate(divide="ignore"):
        tail = float(np.log10(bdtrc(inliers - 1, tested, _CHANCE)))
    return Evidence(
        inliers=inliers,
        tested=tested,
        log10_odds=float(min(-tail - _LOG10_TESTS - unlikely, _MOST_LOG10_ODDS)),
        uncertainty_px=uncertainty_px(aligned, covariance),
        drift=geometry.drift(expected),
        tilt_i=geometry.mount_i.tilt,
        tilt_j=geometry.mount_j.tilt,
    )


def objection(evidence: Evidence, options: MatchOptions) -> str | None:
    """Say why the plane is not believed, or None if it is."""
    seen = f"{evidence.inliers} of {evidence.tested} ground patches agree"
    if not evidence.log10_odds >= options.min_log10_odds:
        return (
            f"{seen}, where {_CHANCE * evidence.tested:.1f} do by chance: odds "
            f"of {_ratio(evidence.log10_odds)} against chance, "
            f"{_ratio(options.min_log10_odds)} needed"
        )
    if not evidence.drift <= options.max_tilt_error:
        return (
            f"{seen}, but on a plane that needs a camera turned "
            f"{np.degrees(evidence.drift):.0f} degrees from its configured tilt and roll, "
            f"{np.degrees(options.max_tilt_error):.0f} are allowed; its tilts would be "
            f"{np.degrees(evidence.tilt_i):.0f} and {np.degrees(evidence.tilt_j):.0f} degrees: "
            "if that may be, `tilt: auto` finds them"
        )
    if not evidence.uncertainty_px <= options.max_uncertainty_px:
        return (
            f"{seen}, but spread so little that the homography is uncertain by "
            f"{evidence.uncertainty_px:.1f} px over the common ground, "
            f"{options.max_uncertainty_px:g} px are allowed"
        )
    return None


def _ratio(log10_odds: float) -> str:
    """Write odds as people do, two digits of them."""
    if not log10_odds >= 0:
        return "less than 1 to 1"
    return f"{float(f'{10.0**log10_odds:.2g}'):g} to 1"
