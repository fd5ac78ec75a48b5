"""Made-up scenes and what a camera sees of them, exactly."""

from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray

from gvpipe.core.kernels.raytrace import trace
from gvpipe.core.synthesis.solids import KINDS, Solid
from gvpipe.core.synthesis.texture import SIZE, Pyramid, pyramid, stone
from gvpipe.core.types import Camera, Float, Image, Pose

GROUND, SKY = -1, -2
"""Numbers that stand for no solid in :attr:`Picture.solids`."""

SOLID_PERIOD_M = 0.5
"""Length after which a solid's texture repeats: a box of a hand's width shows a good part of it."""


@dataclass(frozen=True)
class Light:
    """One sun and an even sky.

    Attributes
    ----------
    direction : (float, float, float)
        Towards the sun, in the map.
    softness : float
        Radius of the sun's disc over its distance; 0 gives sharp shadows.
    ambient : float
        Share of the light that comes from the sky, 0 to 1.
    """

    direction: tuple[float, float, float] = (0.35, 0.25, 0.9)
    softness: float = 0.12
    ambient: float = 0.55


@dataclass(frozen=True)
class Scene:
    """A textured ground and what stands on it; make it with :func:`make_scene`.

    Attributes
    ----------
    solids : tuple of Solid
        In the order of their numbers.
    skins : Pyramid
        Texture of the ground, then of each solid.
    light : Light
        Illumination.
    """

    solids: tuple[Solid, ...]
    skins: Pyramid
    light: Light


@dataclass(frozen=True)
class Picture:
    """What a camera sees.

    Attributes
    ----------
    pixels : (H, W, 3) uint8
        RGB.
    solids : (H, W) int16
        Number of the solid under each pixel's centre, :data:`GROUND` or :data:`SKY`.
    """

    pixels: Image
    solids: NDArray[np.int16]


def make_scene(
    ground: Image,
    solids: tuple[Solid, ...] = (),
    *,
    rng: np.random.Generator,
    period_m: float = 3.0,
    light: Light | None = None,
) -> Scene:
    """Give every solid a texture.

    Parameters
    ----------
    ground : (SIZE, SIZE, 3) uint8
        Periodic texture of the ground.
    solids : tuple of Solid
        What stands on it.
    rng : Generator
        For the solids' textures.
    period_m : float
        Length after which the ground repeats, metres.
    light : Light, optional
        Illumination.

    Returns
    -------
    scene : Scene
    """
    skins = [ground]
    if solids:  # more contrast than the ground, so that a solid stands out from any floor
        grain = np.clip(1.5 * (stone(rng).astype(np.float64) - 128) + 150, 0, 255).astype(np.uint8)
        shifts = rng.integers(SIZE, size=(len(solids), 2))
        skins += [np.roll(grain, tuple(shift), axis=(0, 1)) for shift in shifts]
    periods = [period_m] + [SOLID_PERIOD_M] * len(solids)
    return Scene(solids, pyramid(skins, periods), light or Light())


def photograph(
    scene: Scene,
    camera: Camera,
    map_from_camera: Pose,
    distortion: tuple[float, ...] = (),
    samples: int = 2,
    light_samples: int = 3,
) -> Picture:
    """Render a picture.

    Parameters
    ----------
    scene : Scene
        What there is.
    camera : Camera
        Intrinsics.
    map_from_camera : Pose
        Where the camera is, metres; above the ground.
    distortion : tuple of float
        OpenCV order; the picture is distorted by it.
    samples : int
        Rays along each side of a pixel.
    light_samples : int
        Rays to the sun and to the sky at each surface point.

    Returns
    -------
    picture : Picture
    """
    offsets = (np.arange(samples) + 0.5) / samples - 0.5
    total = np.zeros((camera.height * camera.width, 3))
    for k, (du, dv) in enumerate(product(offsets, offsets)):
        rays = _rays(camera, map_from_camera, distortion, float(du), float(dv))
        spread = 1.0 / (camera.fx * samples)
        total += _trace(scene, rays, map_from_camera, spread, light_samples, k)[0]
    shape = (camera.height, camera.width)
    pixels = np.clip(np.rint(total / samples**2), 0, 255).astype(np.uint8)
    centre = _rays(camera, map_from_camera, distortion, 0.0, 0.0)
    solids = _trace(scene, centre, map_from_camera, 0.0, 1, 0)[1]
    return Picture(pixels.reshape(*shape, 3), solids.reshape(shape))


def _rays(
    camera: Camera, map_from_camera: Pose, distortion: tuple[float, ...], du: float, dv: float
) -> Float:
    """Give unit directions in the map through all pixels, (H * W, 3)."""
    u, v = np.meshgrid(np.arange(camera.width) + du, np.arange(camera.height) + dv)
    pixels = np.column_stack([u.ravel(), v.ravel()])
    if distortion:
        k = camera.matrix
        steps = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-10)
        rectified = cv2.undistortPointsIter(
            pixels[:, None], k, np.array(distortion), np.eye(3), k, steps
        )
        pixels = np.asarray(rectified[:, 0])
    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ camera.inverse.T
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return np.ascontiguousarray(rays @ map_from_camera.rotation.T)


def _trace(
    scene: Scene, rays: Float, pose: Pose, spread: float, light_samples: int, run: int
) -> tuple[Float, NDArray[np.int16]]:
    """Colours and solids along rays; `run` makes the soft light of several passes differ."""
    solids, skins, light = scene.solids, scene.skins, scene.light
    sun = np.array(light.direction) / np.linalg.norm(light.direction)
    colour = np.empty((len(rays), 3))
    which = np.empty(len(rays), np.int16)
    trace(
        rays,
        np.ascontiguousarray(pose.translation, dtype=np.float64),
        np.array([KINDS.index(s.kind) for s in solids], np.int64),
        np.array([[s.x, s.y, np.cos(s.yaw), np.sin(s.yaw)] for s in solids]).reshape(-1, 4),
        np.array([s.size for s in solids], np.float64).reshape(-1, 3),
        np.array([(1.0, 1.0, 1.0), *(s.colour for s in solids)]),
        skins.texels,
        skins.starts,
        skins.sizes,
        skins.periods,
        sun,
        light.softness,
        light.ambient,
        spread,
        light_samples,
        run * len(rays),
        colour,
        which,
    )
    return colour, which
