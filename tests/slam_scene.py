"""Robots over a plane of random points: true poses, and the matches their cameras would give."""

from dataclasses import dataclass, replace

import numpy as np

from gvpipe.core.geometry.ground import pixel_from_plane
from gvpipe.core.geometry.homography import apply, fit_linear
from gvpipe.core.geometry.pose import planar_pose, rotation_vector
from gvpipe.core.slam.links import Link, link_kind
from gvpipe.core.slam.location_graph import MapOptions, MapResult, build_map
from gvpipe.core.types import Camera, Float, Mount, Pose

CAMERA = Camera(width=640, height=480, fx=550.0, fy=550.0, cx=321.0, cy=242.0)


@dataclass(frozen=True)
class Scene:
    cameras: dict[str, Camera]
    mounts: dict[str, Mount]  # as configured
    poses: dict[str, Pose]  # true, world
    links: list[Link]

    @property
    def order(self) -> list[str]:
        return list(self.poses)


def loop_path(count: int, radius: float = 1.2, turns: float = 1.02) -> Float:
    """Positions and headings (N, 3) round a circle at uneven steps, a little more than closed."""
    even = np.linspace(0.0, 1.0, count)
    angle = 2 * np.pi * turns * (even + 0.3 / count * np.sin(2.6 * np.arange(count)))
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), angle + np.pi / 2])


def arc_path(count: int, step: float = 0.25, bend: float = 0.06) -> Float:
    """Positions and headings (N, 3) along an arc."""
    heading = bend * np.arange(count)
    x = np.cumsum(np.append(0.0, step * np.cos(heading[:-1])))
    y = np.cumsum(np.append(0.0, step * np.sin(heading[:-1])))
    return np.column_stack([x, y, heading])


def make_scene(
    paths: dict[str, Float],
    rng: np.random.Generator,
    *,
    noise_px: float = 0.3,
    tilt: float = np.radians(35.0),
    height: float = 0.6,
    scale_sigma: float = 0.0,
    tilt_off: float = np.radians(1.5),
    shake: float = np.radians(0.2),
    bounce: float = 0.002,
    density: float = 60.0,
    wrong_matches: float = 0.0,
    max_gap: int = 2,
) -> Scene:
    """Drive robots along paths; link neighbours, revisited places and robots that meet.

    `tilt_off` is the deviation of each robot's mean tilt from its configured one, `shake` and
    `bounce` those of single pictures (radians, relative height), `scale_sigma` that of the mean
    height from the configured one; `density` is in points per square metre.
    """
    everywhere = np.concatenate(list(paths.values()))[:, :2]
    low, high = everywhere.min(axis=0) - 2.5, everywhere.max(axis=0) + 2.5
    ground = rng.uniform(low, high, (int(density * np.prod(high - low)), 2))
    cameras, mounts, poses, seen = {}, {}, {}, {}
    for robot, path in paths.items():
        mean = Mount(
            tilt=tilt + rng.normal(0.0, tilt_off),
            roll=rng.normal(0.0, np.radians(0.3)),
            height=height * np.exp(rng.normal(0.0, scale_sigma)),
        )
        for k, (x, y, yaw) in enumerate(path):
            image = f"{robot}/{k:04d}.jpg"
            held = Mount(
                tilt=mean.tilt + rng.normal(0.0, shake),
                roll=mean.roll + rng.normal(0.0, shake),
                height=mean.height * np.exp(rng.normal(0.0, bounce)),
            )
            cameras[image], mounts[image] = CAMERA, Mount(tilt=tilt, roll=0.0, height=height)
            poses[image] = planar_pose(x, y, yaw, held)
            seen[image] = _observe(ground, poses[image], held.height, noise_px, rng)
    order = list(poses)
    place = {image: k for k, image in enumerate(order)}
    links = []
    for a, i in enumerate(order):
        for j in order[a + 1 :]:
            kind = link_kind(place, i, j)
            gap = abs(order.index(j) - a)
            if kind == "odometry" and gap > max_gap:
                continue
            link = _link(i, j, kind, seen, rng, wrong_matches)
            if link is not None:
                links.append(link)
    return Scene(cameras, mounts, poses, links)


def _observe(
    ground: Float, pose: Pose, height: float, noise_px: float, rng: np.random.Generator
) -> dict[int, Float]:
    h = pixel_from_plane(CAMERA, pose)
    depth = ground @ h[2, :2] + h[2, 2]
    pixel = apply(h, ground)
    near = np.linalg.norm(ground - pose.translation[:2], axis=1) < 4.0 * height
    inside = ((pixel >= 0) & (pixel <= [CAMERA.width - 1, CAMERA.height - 1])).all(axis=1)
    which = np.nonzero((depth > 0) & near & inside)[0]
    noisy = pixel[which] + rng.normal(0.0, noise_px, (len(which), 2))
    return dict(zip(which.tolist(), noisy, strict=True))


def _link(
    i: str,
    j: str,
    kind: str,
    seen: dict[str, dict[int, Float]],
    rng: np.random.Generator,
    wrong: float,
) -> Link | None:
    common = sorted(seen[i].keys() & seen[j].keys())
    if len(common) < 15:
        return None
    p, q = (np.array([seen[x][k] for k in common]) for x in (i, j))
    bad = rng.random(len(p)) < wrong
    q = np.where(bad[:, None], q + rng.normal(0.0, 20.0, q.shape), q)
    h = fit_linear(p[~bad], q[~bad])
    return None if h is None else Link(i, j, kind, h, p, q)


def replace_links(links: list[Link], which: list[int], rng: np.random.Generator) -> list[Link]:
    """Give some links the matches of other links: valid motions, at the wrong place."""
    out = list(links)
    for k in which:
        source = links[int(rng.choice([n for n in range(len(links)) if n != k]))]
        out[k] = replace(
            links[k],
            homography=source.homography,
            points_i=source.points_i,
            points_j=source.points_j,
        )
    return out


def true_map(scene: Scene, reference: str) -> dict[str, Pose]:
    """True poses in the frame below the reference camera, x along its optical axis."""
    pose = scene.poses[reference]
    axis = pose.rotation[:2, 2] / np.linalg.norm(pose.rotation[:2, 2])
    turn = np.array([[axis[0], axis[1], 0.0], [-axis[1], axis[0], 0.0], [0.0, 0.0, 1.0]])
    shift = np.array([pose.translation[0], pose.translation[1], 0.0])
    map_from_world = Pose(turn, -turn @ shift)
    return {image: map_from_world @ p for image, p in scene.poses.items()}


def errors(result: MapResult, truth: dict[str, Pose]) -> Float:
    """Rotation vectors and translations (N, 6) from the estimated to the true poses."""
    rows = []
    for image, posed in result.poses.items():
        estimate = posed.map_from_camera
        turn = rotation_vector(truth[image].rotation @ estimate.rotation.T)
        rows.append(np.append(turn, truth[image].translation - estimate.translation))
    return np.array(rows)


def mapped(scene: Scene, options: MapOptions | None = None) -> MapResult:
    """The map of a scene in the frame of its first image."""
    options = MapOptions() if options is None else options
    return build_map(scene.cameras, scene.mounts, scene.order, scene.links, scene.order[0], options)
