"""What turns pictures into evidence for obstacles."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Silhouette = NDArray[np.float32]
"""(H, W) float32 probability in 0..1 that the pixel shows an obstacle, NaN where unknown."""


@dataclass(frozen=True)
class EvidenceOptions:
    """Scales and thresholds of the evidence; the defaults serve all kinds of ground.

    Attributes
    ----------
    background : "views" or "mosaic"
        Compare each view with the ground as the other views show it, at its own resolution, or
        with the mosaic as the thesis does.
    colour_scale : float
        With the mosaic: colour difference, levels of 0..255 (Euclidean over RGB), at which the
        silhouette probability reaches 63 % (the beta of thesis eq. 5.6.2 in 0..255).
    tolerances : tuple of float
        One round of silhouettes each, on reduced pictures: share of the views that may
        contradict an obstacle when it is asked what hides the ground. The first rounds must
        tolerate more, for colours seen under an obstacle are taken for ground at first.
    odds : float
        Difference from the ground, in units of its expected square, at which obstacle and ground
        are equally likely; up to twice as much where the ground's differences have a long tail.
    outline : float
        Cost of a pixel of silhouette outline, in units of the log odds.
    hidden_gain : float
        Log odds for an obstacle where it hides the ground from all other views.
    first_colour_gain, colour_gain : float
        Weight of the colours learnt from a silhouette, in the first round and later.
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

    background: Literal["views", "mosaic"] = "views"
    colour_scale: float = 16.8
    tolerances: tuple[float, ...] = (0.12, 0.06)
    odds: float = 8.0
    outline: float = 1.5
    hidden_gain: float = 0.3
    first_colour_gain: float = 1.0
    colour_gain: float = 0.5
    view_floor: float = 0.05
    min_views: int = 3
    ground_softness: float = 0.002
    consistency_scale: float = 20.0
    area_floor: float = 0.02
