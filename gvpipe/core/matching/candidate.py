"""One geometry of two views, and what patches of ground in the pictures say for and against it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.geometry.twoview import PairPrior, TwoView, two_views
from gvpipe.core.matching.features import MatchOptions
from gvpipe.core.matching.hypotheses import Matches
from gvpipe.core.matching.patches import COARSENESS, Aligned, Pyramid, align, grey_pyramid, texture
from gvpipe.core.matching.verdict import Evidence, objection, weigh
from gvpipe.core.types import Float, View

_UNKNOWN_SIGMA = np.radians(20.0)  # of a tilt that is not known


@dataclass(frozen=True)
class Pair:
    """All that stays the same while geometries of two views are compared.

    Attributes
    ----------
    expected : TwoView
        As configured.
    prior : PairPrior
        Error of the configuration.
    texture_i : (h, w) float32
        From :func:`gvpipe.core.matching.patches.texture`.
    pyramids : pair of tuple of (h, w) uint8
        From :func:`gvpipe.core.matching.patches.grey_pyramid`.
    matches : Matches
        Putative ones.
    options : MatchOptions
        Thresholds.
    """

    expected: TwoView
    prior: PairPrior
    texture_i: NDArray[np.float32]
    pyramids: tuple[Pyramid, Pyramid]
    matches: Matches
    options: MatchOptions


@dataclass(frozen=True)
class Candidate:
    """A geometry with its evidence and what is to be said against it.

    Attributes
    ----------
    start : TwoView
        Before refinement.
    aligned : Aligned
        Its patches.
    covariance : (9, 9) float64
        Of its homography.
    evidence : Evidence
        For it.
    objection : str or None
        Against it.
    """

    start: TwoView
    aligned: Aligned
    covariance: Float
    evidence: Evidence
    objection: str | None

    @property
    def rank(self) -> tuple[bool, float]:
        """The larger, the better."""
        return self.objection is None, self.evidence.log10_odds


def prepare(view_i: View, view_j: View, matches: Matches, options: MatchOptions) -> Pair:
    """Collect what is needed to compare geometries of two views.

    Parameters
    ----------
    view_i, view_j : View
        The views.
    matches : Matches
        Putative ones; they are asked whether anything lies below a found plane.
    options : MatchOptions
        Thresholds.

    Returns
    -------
    pair : Pair
    """
    tilt_i, tilt_j = (
        options.tilt_sigma if v.mount.tilt_known else _UNKNOWN_SIGMA for v in (view_i, view_j)
    )
    pyramids = grey_pyramid(view_i.pixels), grey_pyramid(view_j.pixels)
    return Pair(
        expected=two_views(view_i, view_j),
        prior=PairPrior(
            tilt_i, tilt_j, options.roll_sigma, options.height_sigma, options.max_tilt_error
        ),
        texture_i=texture(pyramids[0]),
        pyramids=pyramids,
        matches=matches,
        options=options,
    )


def examine(
    pair: Pair, start: TwoView, geometry: TwoView, coarseness: tuple[float, ...] = COARSENESS
) -> Candidate | None:
    """Align the ground patches of a geometry and weigh what they say.

    Parameters
    ----------
    pair : Pair
        The views.
    start, geometry : TwoView
        Before refinement, and after it.
    coarseness : tuple of float
        As of :func:`gvpipe.core.matching.patches.align`.

    Returns
    -------
    candidate : Candidate or None
        None if hardly any patch could be aligned.
    """
    aligned = align(
        geometry,
        pair.expected,
        pair.prior,
        pair.texture_i,
        *pair.pyramids,
        coarseness=coarseness,
    )
    if aligned is None:
        return None
    covariance = aligned.fit.homography_covariance
    evidence = weigh(aligned, covariance, pair.expected, pair.prior)
    return Candidate(start, aligned, covariance, evidence, objection(evidence, pair.options))
