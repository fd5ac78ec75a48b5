"""The location graph: images, the links between them, and the joint metric map they carry."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from gvpipe.core.adjustment import adjust
from gvpipe.core.ground import ground_points
from gvpipe.core.ground_bundle import Problem, Rig, Spread, centres, orientation
from gvpipe.core.pose import robot_from_camera, yaw_tilt_roll
from gvpipe.core.tracks import chain_matches
from gvpipe.core.types import Camera, Float, Mount, Pose


@dataclass(frozen=True)
class Link:
    """Two images that see the same ground.

    Attributes
    ----------
    image_i, image_j : str
        Image ids.
    kind : str
        ``odometry``, ``loop`` or ``overlap``.
    homography : (3, 3) float64
        Pixels of i to pixels of j for points of the ground.
    points_i, points_j : (N, 2) float64
        Inlier pixels.
    """

    image_i: str
    image_j: str
    kind: str
    homography: Float
    points_i: Float
    points_j: Float


@dataclass(frozen=True)
class MapOptions:
    """Priors of the adjustment.

    Attributes
    ----------
    height_sigma : float
        Relative uncertainty of a configured height.
    tilt_sigma, roll_sigma : float
        Uncertainty of the configured tilt and roll, radians.
    """

    height_sigma: float = 0.005
    tilt_sigma: float = float(np.radians(3.0))
    roll_sigma: float = float(np.radians(3.0))


@dataclass(frozen=True)
class PosedImage:
    """An image in the map.

    Attributes
    ----------
    map_from_camera : Pose
        Camera to map, metres.
    covariance : (6, 6) float64
        Of (rotation vector, translation): the true pose is ``exp(rotation vector) R`` and
        ``t + translation``, both in map axes; radians and metres.
    component : int
        Maps that are not connected have different numbers; 0 holds the reference.
    """

    map_from_camera: Pose
    covariance: Float
    component: int


@dataclass(frozen=True)
class MapResult:
    poses: dict[str, PosedImage] = field(default_factory=dict)
    residuals_m: list[float] = field(default_factory=list)
    noise_px: list[float] = field(default_factory=list)
    spreads: list = field(default_factory=list)


def fit_isometry(points_i: Float, points_j: Float) -> Float:
    """Least-squares isometry (3, 3) of the plane that takes points i to points j (thesis 3.3.4)."""
    ci, cj = points_i.mean(axis=0), points_j.mean(axis=0)
    a, b = points_i - ci, points_j - cj
    angle = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    c, s = np.cos(angle), np.sin(angle)
    rotation = np.array([[c, -s], [s, c]])
    isometry = np.eye(3)
    isometry[:2, :2], isometry[:2, 2] = rotation, cj - rotation @ ci
    return isometry


def build_map(
    cameras: Mapping[str, Camera],
    mounts: Mapping[str, Mount],
    order: Sequence[str],
    links: Sequence[Link],
    reference: str,
    options: MapOptions,
) -> MapResult:
    index = {image: k for k, image in enumerate(order)}
    n = len(order)
    isometry = {}
    rows, cols, cost = [], [], []
    for link in links:
        i, j = index[link.image_i], index[link.image_j]
        gi, oki = ground_points(link.points_i, cameras[link.image_i], mounts[link.image_i])
        gj, okj = ground_points(link.points_j, cameras[link.image_j], mounts[link.image_j])
        ok = oki & okj
        j_from_i = fit_isometry(gi[ok], gj[ok])
        isometry[i, j], isometry[j, i] = j_from_i, np.linalg.inv(j_from_i)
        rows.append(i)
        cols.append(j)
        cost.append(1.0 / len(link.points_i))
    graph = coo_matrix((cost, (rows, cols)), (n, n)).tocsr()
    tree = minimum_spanning_tree(graph)
    ref = index[reference]
    seq, pred = breadth_first_order(tree, ref, directed=False)
    map_from = {ref: np.eye(3)}
    for k in seq[1:]:
        map_from[k] = map_from[pred[k]] @ isometry[k, pred[k]]
    state = np.zeros((n, 6))
    for k, m in map_from.items():
        state[k, :3] = m[0, 2], m[1, 2], np.arctan2(m[1, 0], m[0, 0])
    robots = list(dict.fromkeys(i.split("/")[0] for i in order))
    group = np.array([robots.index(i.split("/")[0]) for i in order])
    rig = Rig(
        np.stack([cameras[i].matrix for i in order]),
        np.stack([robot_from_camera(mounts[i]).rotation for i in order]),
        np.array([mounts[i].height for i in order]),
        group,
    )
    tracks = chain_matches(
        [(index[l.image_i], index[l.image_j]) for l in links],
        [(l.points_i, l.points_j) for l in links],
    )
    problem = Problem(rig, tracks, ref)
    g = len(robots)
    sig = np.array([options.tilt_sigma, options.roll_sigma, 0.1])
    spread = Spread(
        np.tile(sig, (g, 1)),
        np.tile([options.tilt_sigma, options.roll_sigma, options.height_sigma], (g, 1)),
        np.full(g, -1),
    )
    adj = adjust(problem, state, spread, held_by_hand=None)
    rot, _ = orientation(rig, adj.state.cameras)
    cen = centres(rig, adj.state.cameras)
    yaw, _, _ = yaw_tilt_roll(rot[ref].T)
    c, s = np.cos(-yaw), np.sin(-yaw)
    Z = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    poses = {}
    for k, image in enumerate(order):
        poses[image] = PosedImage(
            Pose(Z @ rot[k].T, Z @ (cen[k] - cen[ref] * [1, 1, 0])), np.eye(6), 0
        )
    return MapResult(poses, [], [adj.noise_px, adj.loss_px], adj)
