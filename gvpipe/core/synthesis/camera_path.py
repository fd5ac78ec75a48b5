"""Where a camera is carried over the ground: circle, line and lawn mower."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.geometry.ground import ground_points, pixel_from_plane
from gvpipe.core.geometry.homography import apply
from gvpipe.core.geometry.pose import mount_of, planar_pose
from gvpipe.core.types import Camera, Float, Mount, Pose

RANGE_HEIGHTS = 6.0
"""Ground farther away than this many camera heights does not count as seen."""


@dataclass(frozen=True)
class Stop:
    """One place on the ground: metres, and the heading in radians."""

    x: float
    y: float
    yaw: float


def circle(images: int, radius: float) -> list[Stop]:
    """Place stops evenly round the origin, looking at it; the first looks along x."""
    angles = 2 * np.pi * np.arange(images) / images
    return [Stop(-radius * np.cos(a), -radius * np.sin(a), float(a)) for a in angles]


def line(images: int, spacing: float) -> list[Stop]:
    """Place stops along x, looking ahead; the origin is in the middle of them."""
    middle = (images - 1) / 2
    return [Stop((k - middle) * spacing, 0.0, 0.0) for k in range(images)]


def mower(images: int, spacing: float, rows: int) -> list[Stop]:
    """Rows to and fro along x, `spacing` apart in both directions, looking ahead.

    The origin is in the middle; the last row may be shorter.
    """
    length = -(-images // rows)
    stops = []
    for k in range(images):
        row, step = divmod(k, length)
        along = (step if row % 2 == 0 else length - 1 - step) - (length - 1) / 2
        across = (row - (rows - 1) / 2) * spacing
        stops.append(Stop(along * spacing, across, 0.0 if row % 2 == 0 else np.pi))
    return stops


def poses(stops: list[Stop], mount: Mount, shake: float, rng: np.random.Generator) -> list[Pose]:
    """Carry a camera along stops.

    Parameters
    ----------
    stops : list of Stop
        Where.
    mount : Mount
        How the camera is held.
    shake : float
        Standard deviation of tilt, roll and heading, radians; the height and the place vary by
        the same share of the height.
    rng : Generator
        For the shaking.

    Returns
    -------
    map_from_camera : list of Pose
    """
    carried = []
    for stop in stops:
        dx, dy, dz, yaw, tilt, roll = rng.normal(scale=shake, size=6) if shake else np.zeros(6)
        held = replace(
            mount,
            tilt=min(mount.tilt + tilt, np.pi / 2),
            roll=mount.roll + roll,
            height=mount.height * np.exp(dz),
        )
        x, y = stop.x + dx * mount.height, stop.y + dy * mount.height
        carried.append(planar_pose(x, y, stop.yaw + yaw, held))
    return carried


def shared_ground(camera: Camera, map_from_i: Pose, map_from_j: Pose) -> float:
    """Share of the ground in picture i that picture j shows too, 0 to 1.

    Counted in pixels of i, up to :data:`RANGE_HEIGHTS`; what solids hide is not counted out.

    Parameters
    ----------
    camera : Camera
        Of both.
    map_from_i, map_from_j : Pose
        Where they are, metres.

    Returns
    -------
    share : float
        0 if i shows no ground.
    """
    u, v = np.meshgrid(np.arange(0, camera.width, 8.0), np.arange(0, camera.height, 8.0))
    pixels = np.column_stack([u.ravel(), v.ravel()])
    ground_from_pixel = np.linalg.inv(pixel_from_plane(camera, map_from_i)).astype(np.float64)
    below = pixels @ ground_from_pixel[2, :2] + ground_from_pixel[2, 2] > 1e-9
    points = apply(ground_from_pixel, pixels[below])
    away = np.linalg.norm(points - map_from_i.translation[:2], axis=1)
    points = points[away < RANGE_HEIGHTS * mount_of(map_from_i).height]
    return float(_sees(camera, map_from_j, points).mean()) if len(points) else 0.0


def _sees(camera: Camera, map_from_camera: Pose, points: Float) -> NDArray[np.bool_]:
    """Which ground points (N, 2) fall into the picture."""
    pixel = pixel_from_plane(camera, map_from_camera)
    q = points @ pixel[:, :2].T + pixel[:, 2]
    return (
        (q[:, 2] > 0)
        & (q[:, 0] >= -0.5 * q[:, 2])
        & (q[:, 0] <= (camera.width - 0.5) * q[:, 2])
        & (q[:, 1] >= -0.5 * q[:, 2])
        & (q[:, 1] <= (camera.height - 0.5) * q[:, 2])
    )


def ground_sampling(camera: Camera, mount: Mount) -> tuple[float, float]:
    """Size of a pixel on the ground, metres, across the view: at the lower edge and the middle.

    Infinite where the camera looks over the horizon.
    """
    sizes = []
    for v in (camera.height - 1.0, (camera.height - 1) / 2):
        middle = camera.width / 2
        ends = np.array([[middle - 0.5, v], [middle + 0.5, v]])
        points, below = ground_points(ends, camera, mount)
        length = float(np.linalg.norm(points[1] - points[0]))
        sizes.append(length if below.all() else float("inf"))
    return sizes[0], sizes[1]
