"""How much of the ground that pictures show is in other pictures too."""

import numpy as np

from gvpipe.core.kernels.jit import kernel
from gvpipe.core.types import Float, Index


@kernel
def _share(ground: Float, projection: Float, width: float, height: float) -> float:
    """Share of ground points (S, 2) that an image of some size shows; 0 of none."""
    seen = 0
    for k in range(len(ground)):
        x, y = ground[k, 0], ground[k, 1]
        w = projection[2, 0] * x + projection[2, 1] * y + projection[2, 2]
        if w > 0.0:
            u = (projection[0, 0] * x + projection[0, 1] * y + projection[0, 2]) / w
            v = (projection[1, 0] * x + projection[1, 1] * y + projection[1, 2]) / w
            if -0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5:
                seen += 1
    return seen / max(len(ground), 1)


@kernel
def shared_footprints(
    first: Index, ground: Float, projection: Float, size: Float, pairs: Index
) -> Float:
    """Share of the ground of either image that the other shows too, the smaller of both.

    Parameters
    ----------
    first : (N + 1,) int64, ground : (S, 2) float64
        Points ``ground[first[n]:first[n + 1]]`` of the map are under a grid of pixels of image n.
    projection : (N, 3, 3) float64
        Map to pixels; the third component is positive before the camera.
    size : (N, 2) float64
        Width and height of the images, pixels.
    pairs : (P, 2) int64
        Images.

    Returns
    -------
    share : (P,) float64
    """
    out = np.empty(len(pairs))
    for n in range(len(pairs)):
        i, j = pairs[n, 0], pairs[n, 1]
        by_j = _share(ground[first[i] : first[i + 1]], projection[j], size[j, 0], size[j, 1])
        by_i = _share(ground[first[j] : first[j + 1]], projection[i], size[i, 0], size[i, 1])
        out[n] = min(by_i, by_j)
    return out
