"""What the bare ground would look like in a view: the background the obstacles stand out from."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gvpipe.core.ground import pixel_from_plane
from gvpipe.core.types import Float, PosedView


@dataclass(frozen=True)
class GroundModel:
    """The ground as one picture seen from above, obstacles removed.

    Attributes
    ----------
    raster : (h, w, 4) uint8
        RGBA; alpha 0 where the ground was never seen.
    map_from_pixel : (3, 3) float64
        Takes homogeneous raster pixels (u, v, 1) to map coordinates on the ground, metres.
    """

    raster: NDArray[np.uint8]
    map_from_pixel: Float


@dataclass(frozen=True)
class Background:
    """The ground expected behind every pixel of one view.

    Attributes
    ----------
    colour : (H, W, 3) float32
        RGB 0..255; meaningless where not known.
    known : (H, W) bool
        True where the pixel's ray meets ground that the model holds.
    """

    colour: NDArray[np.float32]
    known: NDArray[np.bool_]


def rendered_background(view: PosedView, ground: GroundModel) -> Background:
    """Render the ground model into a view (the B(H x) of thesis eq. 5.6.1)."""
    height, width = view.pixels.shape[:2]
    pixel_from_raster = pixel_from_plane(view.camera, view.map_from_camera) @ ground.map_from_pixel
    # warping takes the raster as it is, so that the part of it behind the camera must be cut by
    # the sign of the depth, which the warp itself does not see
    raster_from_pixel = np.linalg.inv(pixel_from_raster)
    rendered = cv2.warpPerspective(
        ground.raster,
        raster_from_pixel,
        (width, height),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=(0, 0, 0, 0),
    )
    known = (rendered[..., 3] == 255) & below_horizon(view)
    return Background(rendered[..., :3].astype(np.float32), known)


def below_horizon(view: PosedView) -> NDArray[np.bool_]:
    """Which pixels' rays meet the ground, (H, W) bool."""
    height, width = view.pixels.shape[:2]
    ray_z = view.map_from_camera.rotation[2] @ np.linalg.inv(view.camera.matrix)
    u, v = np.arange(width)[None, :], np.arange(height)[:, None]
    below: NDArray[np.bool_] = ray_z[0] * u + ray_z[1] * v + ray_z[2] < 0
    return below
