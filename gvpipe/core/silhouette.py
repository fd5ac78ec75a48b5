"""How likely each pixel of each view shows an obstacle rather than the ground."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.background import GroundModel, rendered_background
from gvpipe.core.types import PosedView

Silhouette = NDArray[np.float32]
"""(H, W) float32 probability in 0..1 that the pixel shows an obstacle, NaN where unknown."""


@dataclass(frozen=True)
class EvidenceOptions:
    """What turns pictures into evidence for obstacles.

    Attributes
    ----------
    colour_scale : float
        Colour difference, levels of 0..255 (Euclidean over RGB), at which the silhouette
        probability reaches 63 % (the beta of thesis eq. 5.6.2 in 0..255).
    view_floor : float
        Lowest probability one view may contribute to a point, so that one accidental match of
        colours cannot carve an obstacle alone.
    min_views : int
        Points that fewer views can judge count as free.
    ground_softness : float
        Height, metres, over which the ground factor rises (1 / alpha of thesis eq. 5.6.3).
    consistency_scale : float
        Colour deviation, levels of 0..255, that halves a view's consent (1 / gamma of thesis eq.
        5.6.4).
    area_floor : float
        Smallest area weight g.
    """

    colour_scale: float = 16.8
    view_floor: float = 0.05
    min_views: int = 3
    ground_softness: float = 0.002
    consistency_scale: float = 20.0
    area_floor: float = 0.02


def silhouettes(
    views: Sequence[PosedView], ground: GroundModel, options: EvidenceOptions
) -> list[Silhouette]:
    """Soft obstacle silhouettes of all views against the ground.

    Parameters
    ----------
    views : sequence of PosedView
        Pictures with poses.
    ground : GroundModel
        The ground without obstacles.
    options : EvidenceOptions
        Scales and thresholds.

    Returns
    -------
    silhouettes : list of (H, W) float32
        Probability that a pixel shows an obstacle, NaN where unknown (above the horizon, or the
        ground there was never seen).
    """
    return [colour_silhouette(view, ground, options.colour_scale) for view in views]


def colour_silhouette(view: PosedView, ground: GroundModel, colour_scale: float) -> Silhouette:
    """Compare a view with the ground model colour by colour (thesis eqs. 5.6.1 and 5.6.2)."""
    background = rendered_background(view, ground)
    squared = ((view.pixels - background.colour) ** 2).sum(axis=-1)
    probability = -np.expm1(-squared / colour_scale**2)
    return np.where(background.known, probability, np.nan).astype(np.float32)
