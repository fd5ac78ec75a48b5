"""A small z-buffer."""

import numpy as np

from gvpipe.core.kernels.jit import kernel


@kernel
def rasterise_depth(
    pixels: np.ndarray[tuple[int, int], np.dtype[np.float64]],
    depths: np.ndarray[tuple[int], np.dtype[np.float64]],
    faces: np.ndarray[tuple[int, int], np.dtype[np.int32]],
    near: float,
    height: int,
    width: int,
) -> np.ndarray[tuple[int, int], np.dtype[np.float32]]:
    """Depth of the nearest triangle at each pixel centre.

    Parameters
    ----------
    pixels : (N, 2) float64
        Projected vertices (u right, v down).
    depths : (N,) float64
        Along the optical axis, metres.
    faces : (M, 3) int32
    near : float
        Triangles with a vertex nearer than this are left out, metres.
    height, width : int
        Image size.

    Returns
    -------
    depth : (height, width) float32
        Infinite where no triangle projects. One over the depth is linear on the image.
    """
    nearness = np.zeros((height, width))
    nothing = np.empty((len(pixels), 0)), np.empty((height, width, 0))
    rasterise_colours(pixels, depths, faces, nothing[0], near, nearness, nothing[1])
    return (1.0 / nearness).astype(np.float32)


@kernel
def rasterise_colours(
    pixels: np.ndarray[tuple[int, int], np.dtype[np.float64]],
    depths: np.ndarray[tuple[int], np.dtype[np.float64]],
    faces: np.ndarray[tuple[int, int], np.dtype[np.int32]],
    colours: np.ndarray[tuple[int, int], np.dtype[np.float64]],
    near: float,
    nearness: np.ndarray[tuple[int, int], np.dtype[np.float64]],
    picture: np.ndarray[tuple[int, int, int], np.dtype[np.float64]],
) -> None:
    """Draw triangles over a picture, nearest in front.

    Parameters
    ----------
    pixels, depths, faces, near
        As for :func:`rasterise_depth`.
    colours : (N, C) float64
        Of the vertices, 0 to 255.
    nearness : (height, width) float64
        One over the depth of what the picture holds so far; updated.
    picture : (height, width, C) float64
        Drawn into.
    """
    height, width = nearness.shape
    for m in range(len(faces)):
        a, b, c = faces[m, 0], faces[m, 1], faces[m, 2]
        if min(depths[a], min(depths[b], depths[c])) < near:
            continue
        ax, ay, bx, by = pixels[a, 0], pixels[a, 1], pixels[b, 0], pixels[b, 1]
        cx, cy = pixels[c, 0], pixels[c, 1]
        twice = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if twice == 0.0:
            continue
        left = max(np.ceil(min(ax, min(bx, cx))), 0.0)
        right = min(np.floor(max(ax, max(bx, cx))), width - 1.0)
        top = max(np.ceil(min(ay, min(by, cy))), 0.0)
        bottom = min(np.floor(max(ay, max(by, cy))), height - 1.0)
        ia, ib, ic = 1.0 / depths[a], 1.0 / depths[b], 1.0 / depths[c]
        for v in range(int(top), int(bottom) + 1):
            for u in range(int(left), int(right) + 1):
                wb = ((u - ax) * (cy - ay) - (v - ay) * (cx - ax)) / twice
                wc = ((bx - ax) * (v - ay) - (by - ay) * (u - ax)) / twice
                wa = 1.0 - wb - wc
                if wa < -1e-9 or wb < -1e-9 or wc < -1e-9:
                    continue
                near_here = wa * ia + wb * ib + wc * ic
                if near_here > nearness[v, u]:
                    nearness[v, u] = near_here
                    for k in range(len(colours[a])):
                        shade = wa * ia * colours[a, k] + wb * ib * colours[b, k]
                        picture[v, u, k] = (shade + wc * ic * colours[c, k]) / near_here
