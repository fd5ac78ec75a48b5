"""Depths of the obstacles' surfaces where views agree on their texture."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gvpipe.core.kernels.stereo import LIKE, match_depths
from gvpipe.core.reconstruct.views import ground_depth
from gvpipe.core.types import Float, PosedView

SOURCES = 4
"""Views each one is compared with."""

CLOSEST_DEG = 4.0
"""Views that look at an obstacle from nearly the same direction tell no depth."""

SWEEPS = 4
"""Passes of propagation and refinement; later ones change little."""

AGREE = 0.01
"""Share of the depth within which two views' surfaces are one."""

FULL_AGREEMENT = 2
"""Other views that confirm a depth fully."""


@dataclass(frozen=True)
class DepthMap:
    """Where one view sees the surface.

    Attributes
    ----------
    view : PosedView
        The reduced view.
    depth : (h, w) float32
        Along the optical axis, metres; 0 where unknown.
    confidence : (h, w) float32
        0..1, by the number of views that confirm the depth.
    """

    view: PosedView
    depth: NDArray[np.float32]
    confidence: NDArray[np.float32]


def depth_maps(
    views: Sequence[PosedView],
    near: Sequence[NDArray[np.float32]],
    middle: Float,
    threads: int,
) -> list[DepthMap]:
    """Match the views' texture between the hull and the ground.

    Parameters
    ----------
    views : sequence of PosedView
        Reduced, see :func:`gvpipe.core.reconstruct.views.reduced`: depths of arm's length come out
        to millimetres.
    near : sequence of (h, w) float32
        Least depth of each pixel, metres; infinite where nothing is to be matched.
    middle : (3,) float64
        Point the obstacle stands at: views are neighbours by their directions to it.
    threads : int
        Views worked on side by side; does not change the result.

    Returns
    -------
    maps : list of DepthMap
        One a view, in order.
    """
    sizes = np.array([[v.camera.width, v.camera.height] for v in views])
    width, height = sizes.max(axis=0)
    pictures = np.zeros((len(views), height, width), np.float32)
    for k, view in enumerate(views):
        grey = cv2.cvtColor(view.pixels, cv2.COLOR_RGB2GRAY)
        pictures[k, : sizes[k, 1], : sizes[k, 0]] = grey

    def one(index: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        view = views[index]
        shape = (view.camera.height, view.camera.width)
        depth, cost = np.zeros(shape, np.float32), np.full(shape, 2.0, np.float32)
        normal = np.zeros((*shape, 3), np.float32)
        sources = _sources(index, views, middle)
        if len(sources) < 2 or not np.isfinite(near[index]).any():
            return depth, cost
        to_source = [_from_reference(view, views[s]) for s in sources]
        inverse = view.camera.inverse
        match_depths(
            index,
            sources,
            pictures,
            sizes,
            np.stack([a @ inverse for a, _ in to_source]),
            np.stack([b for _, b in to_source]),
            inverse,
            np.ascontiguousarray(view.map_from_camera.rotation[2]),
            near[index],
            ground_depth(view),
            SWEEPS,
            depth,
            normal,
            cost,
        )
        return depth, cost

    with ThreadPoolExecutor(threads) as pool:
        found = list(pool.map(one, range(len(views))))
    depths = [np.where(cost < LIKE, depth, 0).astype(np.float32) for depth, cost in found]
    return [DepthMap(view, depths[k], _confirmed(k, views, depths)) for k, view in enumerate(views)]


def _sources(index: int, views: Sequence[PosedView], middle: Float) -> NDArray[np.int64]:
    """Choose the views that see the obstacle from the nearest, but different, directions."""
    lines = np.array([v.map_from_camera.translation - middle for v in views])
    lines /= np.linalg.norm(lines, axis=1, keepdims=True)
    angle = np.degrees(np.arccos(np.clip(lines @ lines[index], -1, 1)))
    order = np.argsort(angle, kind="stable")
    return np.array([k for k in order if angle[k] >= CLOSEST_DEG][:SOURCES], dtype=np.int64)


def _from_reference(reference: PosedView, source: PosedView) -> tuple[Float, Float]:
    """K R and K t: homogeneous source pixels from reference camera coordinates."""
    camera_from_map = source.map_from_camera.inverse()
    rotation = camera_from_map.rotation @ reference.map_from_camera.rotation
    shift = (
        camera_from_map.rotation @ reference.map_from_camera.translation
        + camera_from_map.translation
    )
    return source.camera.matrix @ rotation, source.camera.matrix @ shift


def _confirmed(
    index: int, views: Sequence[PosedView], depths: Sequence[NDArray[np.float32]]
) -> NDArray[np.float32]:
    """Share of the wanted number of views whose own depths agree."""
    view, depth = views[index], depths[index]
    v, u = np.nonzero(depth)
    rays = np.stack([u, v, np.ones_like(u)]) * depth[v, u]
    points = view.camera.inverse @ rays
    count = np.zeros(len(u))
    for other, seen in zip(views, depths, strict=True):
        if other is view:
            continue
        rotated, shift = _from_reference(view, other)
        p = rotated @ points + shift[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = np.rint(p[:2] / p[2])
        h, w = seen.shape
        inside = (p[2] > 0) & (x >= 0) & (y >= 0) & (x < w) & (y < h)
        there = np.zeros(len(u))
        there[inside] = seen[y[inside].astype(int), x[inside].astype(int)]
        count += np.abs(there - p[2]) < AGREE * p[2]
    confidence = np.zeros(depth.shape, np.float32)
    confidence[v, u] = np.minimum(count / FULL_AGREEMENT, 1)
    return confidence
