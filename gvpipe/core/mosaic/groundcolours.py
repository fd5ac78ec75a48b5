"""Which colours the ground has, here and in the whole map."""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from gvpipe.core.types import Float

Single = NDArray[np.float32]

COLOUR_BINS = 16
"""Bins along each of R, G and B, 16 levels wide."""

LOCAL_SHARE = 0.9
"""Share of the ground within a tile or two in what is known of its colours; the rest is the whole
map's. A rug is ground like any other once several views agree on some of it."""

FLOOR_LIKELIHOOD = 0.02
"""Likelihood, against an even spread, of a colour that was never seen on the ground."""


class GroundColours:
    """Colours of the sure ground, tile by tile.

    Parameters
    ----------
    side : int
        Rows and columns between neighbouring tiles.
    tallies : dict of (row, column) to (2, m) int32
        Colour bins that occur in each tile, and how often.
    """

    def __init__(self, side: int, tallies: dict[tuple[int, int], NDArray[np.int32]]) -> None:
        self.side, self.tallies = side, tallies
        self.whole = _share(list(tallies.values()))

    def around(self, tile: tuple[int, int]) -> Single:
        """Log likelihood (bins,) float32 of each colour near a tile, against an even spread."""
        steps = (-self.side, 0, self.side)
        places = [(tile[0] + i, tile[1] + j) for i in steps for j in steps]
        near = _share([self.tallies[p] for p in places if p in self.tallies])
        share = LOCAL_SHARE * near + (1.0 - LOCAL_SHARE) * self.whole
        return np.log(share * share.size + FLOOR_LIKELIHOOD).astype(np.float32)


def _share(tallies: list[NDArray[np.int32]]) -> Float:
    """Share of each colour bin in some tallies, blurred a little; all 0 if they are empty."""
    counts = np.zeros(COLOUR_BINS**3)
    for bins, occurrences in tallies:
        counts[bins] += occurrences
    cube = counts.reshape((COLOUR_BINS,) * 3) / max(float(counts.sum()), 1.0)
    return gaussian_filter(cube, 0.7).ravel()


def colour_bins(colours: Single) -> NDArray[np.intp]:
    """Colour bin of RGB values (..., 3)."""
    b = np.clip(colours * (COLOUR_BINS / 256), 0, COLOUR_BINS - 1).astype(np.intp)
    return (b[..., 0] * COLOUR_BINS + b[..., 1]) * COLOUR_BINS + b[..., 2]
