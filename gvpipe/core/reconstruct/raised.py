"""Which pixels show surfaces above the ground, by the depth of their texture."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from gvpipe.core.reconstruct.hull import VoxelSolid, down_to_ground, entry_depth
from gvpipe.core.reconstruct.stereo import DepthMap, depth_maps
from gvpipe.core.types import PosedView

AROUND = 5
"""Voxels by which the hulls are grown before depths are matched in them: silhouettes lack parts
whose colours are those of the ground."""

FLAT, RAISED = 0.01, 0.03
"""Heights, as shares of the camera's, up to which a surface is ground, and from which it is not."""


def raised_surfaces(
    views: Sequence[PosedView], solids: Sequence[VoxelSolid], threads: int
) -> list[NDArray[np.float32]]:
    """Tell obstacles from ground where texture is good enough to measure depth.

    Flat texture, a rug or a shadow, matches between views in the plane of the ground and nowhere
    else; an obstacle's does above it.

    Parameters
    ----------
    views : sequence of PosedView
        Reduced pictures.
    solids : sequence of VoxelSolid
        Where obstacles may be.
    threads : int
        Views worked on side by side; does not change the result.

    Returns
    -------
    raised : list of (h, w) float32
        1 where a surface surely stands above the ground, -1 where it surely lies in it, 0 where
        nothing is known.
    """
    grown = [
        VoxelSolid(down_to_ground(ndimage.binary_dilation(s.inside, iterations=AROUND)), s.grid)
        for s in solids
    ]
    raised = [np.zeros((v.camera.height, v.camera.width), np.float32) for v in views]
    entries = [[entry_depth(s.inside, s.grid, v) for v in views] for s in grown]
    for k, solid in enumerate(grown):
        first = [
            np.where(
                entries[k][i] <= np.min([e[i] for e in entries], axis=0), entries[k][i], np.inf
            )
            for i in range(len(views))
        ]
        near = [d.astype(np.float32) for d in first]
        maps = depth_maps(views, near, (solid.grid.lower + solid.grid.upper) / 2, threads)
        for total, found in zip(raised, maps, strict=True):
            total += _side(found)
    return raised


def _side(found: DepthMap) -> NDArray[np.float32]:
    """Confidence that a depth is above the ground, less that it is in it."""
    pose, camera = found.view.map_from_camera, found.view.camera
    v, u = np.nonzero(found.confidence)
    rays = camera.inverse @ np.stack([u, v, np.ones_like(u)])
    height = pose.rotation[2] @ rays * found.depth[v, u] + pose.translation[2]
    relative = height / pose.translation[2]
    side = np.zeros(found.depth.shape, np.float32)
    side[v, u] = (1.0 * (relative > RAISED) - 1.0 * (relative < FLAT)) * found.confidence[v, u]
    return side
