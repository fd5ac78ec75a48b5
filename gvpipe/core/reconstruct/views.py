"""Views made smaller, and where the rays of their pixels go."""

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from gvpipe.core.types import Camera, Float, Pose, PosedView

REDUCED_WIDTH = 400
"""Pixels: what needs no detail works on pictures reduced to about this width."""


def reduced(view: PosedView) -> PosedView:
    """Make a view smaller by a whole factor, for work without detail."""
    camera = view.camera
    factor = max(1, round(camera.width / REDUCED_WIDTH))
    if factor == 1:
        return view
    width, height = camera.width // factor, camera.height // factor
    small = cv2.resize(
        view.pixels[: height * factor, : width * factor],
        (width, height),
        interpolation=cv2.INTER_AREA,
    )
    smaller = replace(
        camera,
        width=width,
        height=height,
        fx=camera.fx / factor,
        fy=camera.fy / factor,
        cx=(camera.cx + 0.5) / factor - 0.5,
        cy=(camera.cy + 0.5) / factor - 0.5,
        skew=camera.skew / factor,
    )
    return replace(view, pixels=small.astype(np.uint8), camera=smaller)


def upward_rays(camera: Camera, map_from_camera: Pose) -> Float:
    """(3,) numbers whose product with (u, v, 1) is the upward component of a pixel's ray."""
    return np.asarray(map_from_camera.rotation[2] @ camera.inverse)


def upward(camera: Camera, map_from_camera: Pose) -> Float:
    """Upward component, (H, W), of the ray of every pixel: negative where it meets the ground."""
    a, b, c = upward_rays(camera, map_from_camera)
    u, v = np.arange(camera.width)[None, :], np.arange(camera.height)[:, None]
    return np.asarray(a * u + b * v + c)


def below_horizon(view: PosedView) -> NDArray[np.bool_]:
    """Which pixels' rays meet the ground, (H, W) bool."""
    return upward(view.camera, view.map_from_camera) < 0


def ground_depth(view: PosedView) -> NDArray[np.float32]:
    """Depth, (H, W) float32 metres, at which a view's rays meet the ground, 0 above the horizon."""
    up = upward(view.camera, view.map_from_camera)
    depth = np.where(up < -1e-6, -view.map_from_camera.translation[2] / up, 0.0)
    return depth.astype(np.float32)
