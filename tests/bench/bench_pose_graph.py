"""Cost and accuracy of the map of a long session, from a hundred to ten thousand pictures.

Run ``python -m tests.bench.bench_pose_graph [COUNT ...]`` from the repository. A robot winds its
way outwards: every picture is matched with the next, six in ten with one of a neighbouring winding,
and a few of those loops have the matches of another pair. Counted are the CPU seconds of
`build_map`, which is what the slam stage runs on its links: how each camera was held, which links
contradict each other, the adjustment, and the covariance of every pose. The peer is scipy's
`least_squares` with a sparse Jacobian on the same links as a planar pose graph, robust loss, for as
many pictures as it can take.
"""

import argparse
import sys
import time
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.sparse import coo_matrix
from scipy.spatial import cKDTree

from gvpipe.core.geometry.ground import pixel_from_plane
from gvpipe.core.geometry.homography import apply, fit_linear
from gvpipe.core.geometry.pose import planar_pose, rotation_vector, yaw_tilt_roll
from gvpipe.core.slam.consistency import grow
from gvpipe.core.slam.holding import hold
from gvpipe.core.slam.links import Link, LinkSet
from gvpipe.core.slam.location_graph import MapOptions, MapResult, build_map
from gvpipe.core.slam.placements import Placements, disagreements, place_all
from gvpipe.core.types import Camera, Float, Mount, Pose

CAMERA = Camera(width=640, height=480, fx=550.0, fy=550.0, cx=321.0, cy=242.0)
EXPECTED = Mount(tilt=float(np.radians(35.0)), roll=0.0, height=0.6)
STEP, LANE, FIRST = 0.25, 0.5, 1.5
"""Metres between pictures, and between windings; radius of the first of these."""

MATCHES, NOISE_PX = 200, 0.3
LOOPS, WRONG = 0.6, 0.03
"""Loops a picture, and the share of them that are wrong."""

PEER_LIMIT, PEER_STEPS = 300, 100
"""Pictures, and evaluations, up to which the peer is asked."""

COUNTS = (100, 300, 1000, 3000, 10000)
HEAD = (
    "pictures",
    "loops",
    "CPU s",
    "poses/s",
    "chain mm",
    "map mm",
    "wrong",
    "lost",
    "NEES",
    "peer s",
    "peer mm",
)
"""Position errors are RMS after a rigid motion; `wrong` counts wrong loops kept, `lost` true links
left out; NEES is the mean normalised squared error of the poses, 1 if covariances are honest."""


@dataclass(frozen=True)
class Session:
    """What a robot has matched, and the truth."""

    poses: list[Pose]
    links: list[Link]
    wrong: set[int]

    @property
    def images(self) -> list[str]:
        """Image ids in the order they were taken."""
        return [f"A/{k:05d}.jpg" for k in range(len(self.poses))]


def spiral(count: int) -> Float:
    """Positions and headings (N, 3) along a spiral from its middle outwards."""
    way = STEP * np.arange(count)
    a = LANE / (2.0 * np.pi)
    # the arc from angle 0 is about FIRST angle + a angle^2 / 2
    angle = (np.sqrt(FIRST**2 + 2.0 * a * way) - FIRST) / a
    radius = FIRST + a * angle
    heading = angle + np.pi / 2 - np.arctan2(a, radius)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), heading])


def drive(count: int, rng: np.random.Generator) -> Session:
    """Take pictures along the way and match them."""
    path = spiral(count) + rng.normal(0.0, [0.02, 0.02, 0.02], (count, 3))
    mean = rng.normal([EXPECTED.tilt, 0.0], np.radians([1.5, 0.3]))
    poses = []
    for x, y, yaw in path:
        tilt, roll = rng.normal(mean, np.radians(0.2))
        height = EXPECTED.height * np.exp(rng.normal(0.0, 0.002))
        poses.append(planar_pose(x, y, yaw, Mount(float(tilt), float(roll), float(height))))
    loops = revisits(path, rng)
    pairs = [(k, k + 1, "odometry") for k in range(count - 1)] + [(i, j, "loop") for i, j in loops]
    plane = [pixel_from_plane(CAMERA, pose) for pose in poses]
    found = (matched(poses, plane, *pair, rng) for pair in pairs)
    links = [link for link in found if link is not None]
    of_loops = [k for k, link in enumerate(links) if link.kind == "loop"]
    wrong = rng.choice(of_loops, round(WRONG * len(of_loops)), replace=False).tolist()
    return Session(poses, mistaken(links, wrong, of_loops, rng), set(wrong))


def revisits(path: Float, rng: np.random.Generator) -> list[tuple[int, int]]:
    """List pairs of other windings that look at the same ground."""
    ahead = path[:, :2] + np.column_stack([np.cos(path[:, 2]), np.sin(path[:, 2])])
    near = cKDTree(ahead).query_pairs(0.8, output_type="ndarray")
    near = near[np.abs(near[:, 0] - near[:, 1]) > 5]
    near = near[np.lexsort((near[:, 1], near[:, 0]))]
    some = rng.permutation(len(near))[: round(LOOPS * len(path))]
    return [(int(i), int(j)) for i, j in near[np.sort(some)]]


def matched(
    poses: list[Pose], plane: list[Float], i: int, j: int, kind: str, rng: np.random.Generator
) -> Link | None:
    """Match ground that both see, with noise in both pictures; None if it is hardly any."""
    size = np.array([CAMERA.width, CAMERA.height]) - 1.0
    pixel = rng.uniform(0.0, size, (6 * MATCHES, 2))
    ground = apply(np.linalg.inv(plane[i]), pixel)
    seen = apply(plane[j], ground)
    near = [
        (plane[k] @ np.column_stack([ground, np.ones(len(ground))]).T)[2] < 4.0 * EXPECTED.height
        for k in (i, j)
    ]
    front = (np.column_stack([ground, np.ones(len(ground))]) @ plane[j][2]) > 0.1
    good = near[0] & near[1] & front & ((seen >= 0) & (seen <= size)).all(axis=1)
    p, q = pixel[good][:MATCHES], seen[good][:MATCHES]
    p, q = p + rng.normal(0.0, NOISE_PX, p.shape), q + rng.normal(0.0, NOISE_PX, q.shape)
    h = fit_linear(p, q) if len(p) >= 30 else None
    return None if h is None else Link(f"A/{i:05d}.jpg", f"A/{j:05d}.jpg", kind, h, p, q)


def mistaken(
    links: list[Link], wrong: list[int], donors: list[int], rng: np.random.Generator
) -> list[Link]:
    """Give some links the matches of others."""
    out = list(links)
    for k in wrong:
        other = links[int(rng.choice([n for n in donors if n != k]))]
        own = links[k]
        out[k] = Link(
            own.image_i, own.image_j, own.kind, other.homography, other.points_i, other.points_j
        )
    return out


def ate_m(found: Float, true: Float) -> float:
    """RMS distance of positions (N, 3) after the best rigid motion."""
    a, b = found - found.mean(axis=0), true - true.mean(axis=0)
    u, _, vt = np.linalg.svd(a.T @ b)
    turned = a @ u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return float(np.sqrt(((turned - b) ** 2).sum(axis=1).mean()))


def planar_graph(session: Session) -> Placements:
    """What each link says about its two cameras, held as their links show."""
    linked = LinkSet.of(session.links, session.images)
    ends = linked.ends
    count = len(session.poses)
    cameras, group = [CAMERA] * count, np.zeros(count, dtype=np.int64)
    held = hold(linked, cameras, [EXPECTED] * count, group)
    placed = place_all(linked.matches, ends, cameras, held.mounts)
    return Placements(
        i=ends[:, 0],
        j=ends[:, 1],
        centre_i=placed[:, :2],
        centre_j=placed[:, 2:4],
        turn=placed[:, 4],
        radius=placed[:, 5],
        tolerance=placed[:, 6],
        trust=np.ones(len(placed)),
    )


def chained(session: Session, graph: Placements) -> Float:
    """Positions and headings (N, 3) by plain concatenation of the consecutive links."""
    odometry = np.array([x.kind == "odometry" for x in session.links])
    return grow(graph.pick(odometry), len(session.poses))[0]


def upright(planar: Float) -> Float:
    """Camera centres (N, 3) over positions on the ground."""
    return np.column_stack([planar[:, :2], np.full(len(planar), EXPECTED.height)])


def by_scipy(graph: Placements, start: Float) -> Float:
    """Robust planar pose graph by scipy's trust-region method with a sparse Jacobian."""
    rows = np.arange(3 * len(graph.i)).reshape(-1, 3, 1)
    ends = np.column_stack([graph.i, graph.j])
    columns = (3 * ends[:, :, None] + np.arange(3)).reshape(-1, 1, 6)
    rows, columns = (np.broadcast_to(x, (len(ends), 3, 6)).ravel() for x in (rows, columns))
    shape = 3 * len(ends), 3 * len(start)
    pattern = coo_matrix((np.ones(len(rows)), (rows, columns)), shape).tocsr()[:, 3:]

    def residuals(free: Float) -> Float:
        planar = np.vstack([start[:1], free.reshape(-1, 3)])
        return np.asarray(disagreements(graph, planar) / graph.tolerance[:, None]).ravel()

    found = least_squares(
        residuals,
        start[1:].ravel(),
        jac_sparsity=pattern,
        loss="cauchy",
        method="trf",
        max_nfev=PEER_STEPS,
    )
    return np.vstack([start[:1], found.x.reshape(-1, 3)])


def run(count: int, rng: np.random.Generator, *, peer: bool) -> tuple[float, list[str]]:
    """CPU seconds of one session, and the cells of its row."""
    session = drive(count, rng)
    images = session.images
    true = np.array([pose.translation for pose in session.poses])
    cameras, mounts = dict.fromkeys(images, CAMERA), dict.fromkeys(images, EXPECTED)
    begin = time.process_time()
    result = build_map(cameras, mounts, images, session.links, images[0], MapOptions())
    cost_s = time.process_time() - begin
    graph = planar_graph(session)
    before = chained(session, graph)
    kept = sum(result.links[k].kept for k in session.wrong)
    lost = sum(not x.kept for k, x in enumerate(result.links) if k not in session.wrong)
    row = [
        f"{count}",
        f"{len(session.links) - count + 1}",
        f"{cost_s:.2f}",
        f"{count / cost_s:.0f}",
        f"{1e3 * ate_m(upright(before), true):.1f}",
        f"{1e3 * ate_m(positions(result, images), true):.2f}",
        f"{kept}/{len(session.wrong)}",
        f"{lost}",
        f"{honesty(result, session):.2f}",
    ]
    if peer:
        begin = time.process_time()
        planar = by_scipy(graph, before)
        peer_s = time.process_time() - begin
        row += [f"{peer_s:.2f}", f"{1e3 * ate_m(upright(planar), true):.2f}"]
    return cost_s, row


def positions(result: MapResult, images: list[str]) -> Float:
    """Positions (N, 3) on the map."""
    return np.array([result.poses[x].map_from_camera.translation for x in images])


def ground_frame(pose: Pose) -> Pose:
    """Frame on the ground below a camera, x along its optical axis."""
    c, s = np.cos(yaw := yaw_tilt_roll(pose.rotation)[0]), np.sin(yaw)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return Pose(turn, pose.translation * [1.0, 1.0, 0.0])


def honesty(result: MapResult, session: Session) -> float:
    """Mean normalised squared error of the poses: 1 if the covariances say what is true."""
    map_from_world = ground_frame(session.poses[0]).inverse()
    squares = []
    for image, pose in zip(session.images[1:], session.poses[1:], strict=True):
        posed, true = result.poses[image], map_from_world @ pose
        turn = rotation_vector(true.rotation @ posed.map_from_camera.rotation.T)
        error = np.append(turn, true.translation - posed.map_from_camera.translation)
        squares.append(error @ np.linalg.solve(posed.covariance, error) / 6.0)
    return float(np.mean(squares))


def main() -> None:
    """Print a row for each count, then how the cost grows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("counts", nargs="*", type=int, default=COUNTS)
    counts = parser.parse_args().counts
    for count in (40, 1000):  # compiles what is compiled once an installation
        run(count, np.random.default_rng(0), peer=False)
    sys.stdout.write("  ".join(f"{x:>9}" for x in HEAD) + "\n")
    costs = []
    for count in counts:
        cost_s, row = run(count, np.random.default_rng(count), peer=count <= PEER_LIMIT)
        costs.append(cost_s)
        sys.stdout.write("  ".join(f"{x:>9}" for x in row) + "\n")
        sys.stdout.flush()
    if len(counts) > 1:
        power = np.polyfit(np.log(counts), np.log(costs), 1)[0]
        sys.stdout.write(f"the cost grows with the {power:.2f}th power of the pictures\n")


if __name__ == "__main__":
    main()
