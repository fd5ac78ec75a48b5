"""Scenes with known truth: a textured ground, optional boxes, photographs through known cameras."""

from dataclasses import dataclass, field

import cv2
import numpy as np

from gvpipe.core.geometry.ground import pixel_from_plane
from gvpipe.core.geometry.homography import normalise
from gvpipe.core.geometry.pose import mount_of, planar_pose
from gvpipe.core.types import Camera, Float, Image, Mount, Pose, View

CAMERA = Camera(width=320, height=240, fx=270.0, fy=270.0, cx=159.5, cy=119.5)
"""A small camera: photographs of it are quick to make and to match."""


def texture(rng: np.random.Generator, size: int = 1536) -> Image:
    """Patches and grain of every size in several colours, (size, size, 3), periodic."""
    f = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None, :]) * size
    f[0, 0] = np.inf

    def noise(slope: float, coarsest: float) -> Float:
        spectrum = np.fft.rfft2(rng.normal(size=(size, size))) / np.maximum(f, coarsest) ** slope
        field = np.fft.irfft2(spectrum, s=(size, size))
        return np.asarray(field / field.std())

    shade = noise(1.2, 12.0)
    colour = 128 + 22 * shade[..., None] + 8 * np.stack([noise(1.2, 8.0) for _ in range(3)], -1)
    for tint in ((45.0, 10.0, -25.0), (-30.0, 20.0, 35.0), (20.0, -35.0, 10.0)):
        patches = 1.0 / (1.0 + np.exp(-8.0 * (noise(2.0, 25.0) - 0.8)))
        colour += patches[..., None] * np.array(tint)
    return np.clip(colour, 0, 255).astype(np.uint8)


def tiles(rng: np.random.Generator, size: int = 1536, count: int = 16) -> Image:
    """Tiles that are all alike, (size, size, 3): nothing tells one from its neighbour."""
    tile = texture(rng, size // count)
    return np.tile(tile, (count, count, 1))


@dataclass(frozen=True)
class Box:
    """An axis-aligned textured box on the ground: corners in the map, metres."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    faces: Image


@dataclass(frozen=True)
class Scene:
    """A ground centred on the map's origin and what stands on it."""

    ground: Image
    extent: float = 6.0  # metres along each side of the ground texture; it repeats beyond
    boxes: tuple[Box, ...] = field(default=())

    def photograph(
        self,
        map_from_camera: Pose,
        camera: Camera = CAMERA,
        samples: int = 3,
        gain: float = 1.0,
        noise: float = 0.0,
        rng: np.random.Generator | None = None,
    ) -> Image:
        """Render exactly: `samples` squared rays a pixel, sky blue above the horizon."""
        offsets = (np.arange(samples) + 0.5) / samples - 0.5
        total = np.zeros((camera.height, camera.width, 3), np.float32)
        for du in offsets:
            for dv in offsets:
                total += self._trace(map_from_camera, camera, float(du), float(dv))
        total = gain * total / samples**2
        if noise and rng is not None:
            total += rng.normal(scale=noise, size=total.shape).astype(np.float32)
        return np.clip(np.rint(total), 0, 255).astype(np.uint8)

    def _trace(self, pose: Pose, camera: Camera, du: float, dv: float) -> Image:
        u, v = np.meshgrid(np.arange(camera.width) + du, np.arange(camera.height) + dv)
        rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(camera.matrix).T
        rays = rays @ pose.rotation.T
        origin = pose.translation
        down = rays[..., 2] < -1e-9
        depth = np.where(down, -origin[2] / np.where(down, rays[..., 2], -1.0), np.inf)
        point = origin + np.where(down, depth, 0.0)[..., None] * rays
        colour = self._sample(self.ground, point[..., 0], point[..., 1])
        colour[~down] = (150, 180, 220)
        for box in self.boxes:
            self._add_box(box, origin, rays, depth, colour)
        return colour

    def _add_box(self, box: Box, origin: Float, rays: Float, depth: Float, colour: Image) -> None:
        with np.errstate(divide="ignore", invalid="ignore"):
            a = (np.array(box.low) - origin) / rays
            b = (np.array(box.high) - origin) / rays
        near, far = np.minimum(a, b), np.maximum(a, b)
        axis = near.argmax(axis=-1)
        enter = near.max(axis=-1)
        hit = (enter < far.min(axis=-1)) & (enter > 0) & (enter < depth)
        point = origin + np.where(hit, enter, 0.0)[..., None] * rays
        across = np.where(axis == 0, point[..., 1], point[..., 0])
        along = np.where(axis == 2, point[..., 1], point[..., 2])
        shade = self._sample(box.faces, across + 0.37 * axis, along)
        colour[hit] = shade[hit]
        depth[hit] = enter[hit]

    def _sample(self, image: Image, x: Float, y: Float) -> Image:
        scale = image.shape[0] / self.extent
        u = ((x * scale) % image.shape[1]).astype(np.float32)
        v = ((y * scale) % image.shape[0]).astype(np.float32)
        return cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP).astype(
            np.float32
        )


def view_at(
    scene: Scene,
    x: float,
    y: float,
    yaw_deg: float,
    tilt_deg: float,
    height: float = 0.6,
    roll_deg: float = 0.0,
    hint_deg: float | None = None,
    camera: Camera = CAMERA,
    **light: float,
) -> tuple[View, Pose]:
    """Photograph from a robot; the view's mount holds the hint, the pose the truth.

    `hint_deg` is the tilt written in the configuration (default: the true one); roll is never
    told.
    """
    true = Mount(np.radians(tilt_deg), np.radians(roll_deg), height)
    pose = planar_pose(x, y, np.radians(yaw_deg), true)
    told = np.radians(tilt_deg if hint_deg is None else hint_deg)
    pixels = scene.photograph(pose, camera, **light)
    return View(f"A/{x:g}_{y:g}_{yaw_deg:g}.png", pixels, camera, Mount(told, 0.0, height)), pose


def true_homography(pose_i: Pose, pose_j: Pose, camera_i: Camera, camera_j: Camera) -> Float:
    """Pixels of i to pixels of j for the ground."""
    return normalise(
        pixel_from_plane(camera_j, pose_j) @ np.linalg.inv(pixel_from_plane(camera_i, pose_i))
    )


def common_ground(homography: Float, pose_i: Pose, camera_i: Camera, camera_j: Camera) -> Float:
    """Pixels of i, (N, 2) every eight, whose ground point nearer than 8 heights j sees too."""
    u, v = np.meshgrid(np.arange(0, camera_i.width, 8.0), np.arange(0, camera_i.height, 8.0))
    p = np.column_stack([u.ravel(), v.ravel()])
    one = np.column_stack([p, np.ones(len(p))])
    ground = one @ np.linalg.inv(pixel_from_plane(camera_i, pose_i)).T
    height = mount_of(pose_i).height
    # normalised, it has lost its sign: seen from above, what j sees keeps its orientation
    q = one @ (np.sign(np.linalg.det(homography)) * homography).T
    j_sees = (
        (q[:, 0] >= 0)
        & (q[:, 0] <= (camera_j.width - 1) * q[:, 2])
        & (q[:, 1] >= 0)
        & (q[:, 1] <= (camera_j.height - 1) * q[:, 2])
    )
    offset = ground[:, :2] / ground[:, 2:] - pose_i.translation[:2]
    near = (ground[:, 2] > 0) & (np.hypot(offset[:, 0], offset[:, 1]) < 8 * height)
    return p[j_sees & near]
