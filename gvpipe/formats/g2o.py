"""g2o pose graphs: ``VERTEX_SE3:QUAT`` and ``EDGE_SE3:QUAT`` lines.

Vertices are camera to map. An edge holds the pose of camera j in camera i, and the upper triangle
of the information of its error in camera j: three of translation, three of the vector part of the
unit quaternion, which is half the rotation vector.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gvpipe.core.geometry.pose import quaternions, rotation_of
from gvpipe.core.types import Float, Pose, Rejected
from gvpipe.errors import InputError
from gvpipe.formats.files import read_regular_file
from gvpipe.names import escape

MAX_BYTES = 256 << 20
"""Largest file accepted: half a million edges."""

VERTEX, EDGE = "VERTEX_SE3:QUAT", "EDGE_SE3:QUAT"

_UPPER = np.triu_indices(6)


@dataclass(frozen=True)
class RelativeEdge:
    """A measured motion.

    Attributes
    ----------
    i, j : int
        Vertices.
    i_from_j : Pose
        Camera j in camera i, metres.
    information : (6, 6) float64
        Inverse covariance, see the module.
    """

    i: int
    j: int
    i_from_j: Pose
    information: Float


def format_g2o(vertices: Sequence[Pose], edges: Iterable[RelativeEdge]) -> str:
    """Write a pose graph; vertices are numbered from 0 in their order.

    There are no comments in it: several readers take none.
    """
    edges = list(edges)
    lines = [f"{VERTEX} {k} {numbers}" for k, numbers in enumerate(_numbers(vertices))]
    for edge, numbers in zip(edges, _numbers([edge.i_from_j for edge in edges]), strict=True):
        upper = " ".join(map(repr, (edge.information[_UPPER] + 0.0).tolist()))
        lines.append(f"{EDGE} {edge.i} {edge.j} {numbers} {upper}")
    return "".join(line + "\n" for line in lines)


def _numbers(poses: Sequence[Pose]) -> list[str]:
    """Position and quaternion of each pose."""
    position = np.array([pose.translation for pose in poses]).reshape(-1, 3)
    rows = np.column_stack([position, quaternions(poses)]) + 0.0
    return [" ".join(map(repr, row)) for row in rows.tolist()]


def read_g2o(path: Path) -> tuple[dict[int, Pose], list[RelativeEdge]]:
    """Read a pose graph; lines of other kinds are passed over.

    Returns
    -------
    vertices : dict of int to Pose
        Camera to map by number.
    edges : list of RelativeEdge
        In the order of the file.

    Raises
    ------
    InputError
        If the file cannot be read or a line is wrong; names file and line.
    """
    name = escape(str(path))
    raw = read_regular_file(path, MAX_BYTES)
    if isinstance(raw, Rejected):
        raise InputError(f"{name}: {raw.reason}; expected a g2o pose graph")
    vertices: dict[int, Pose] = {}
    edges = []
    for number, line in enumerate(raw.decode("ascii", "replace").splitlines(), start=1):
        words = line.split()
        if not words or words[0] not in (VERTEX, EDGE):
            continue
        keys = 1 if words[0] == VERTEX else 2
        try:
            ids = [int(word) for word in words[1 : 1 + keys]]
            values = [float(word) for word in words[1 + keys :]]
        except ValueError:
            values = []
        wanted = 7 if keys == 1 else 28
        if len(values) != wanted or not all(map(math.isfinite, values)):
            raise InputError(f"{name}:{number}: expected {keys + wanted} numbers after {words[0]}")
        if math.hypot(*values[3:7]) < 1e-6:
            raise InputError(f"{name}:{number}: the quaternion is zero")
        pose = Pose(rotation_of(values[3:7]), np.array(values[:3]))
        if keys == 1:
            vertices[ids[0]] = pose
        else:
            information = np.zeros((6, 6))
            information[_UPPER] = values[7:]
            information += np.triu(information, 1).T
            edges.append(RelativeEdge(ids[0], ids[1], pose, information))
    return vertices, edges
