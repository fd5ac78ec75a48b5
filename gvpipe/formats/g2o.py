"""g2o pose graphs: ``VERTEX_SE3:QUAT`` and ``EDGE_SE3:QUAT`` lines.

Vertices are camera to map. An edge holds the pose of camera j in camera i, and the upper triangle
of the information of its error in camera j: three of translation, three of the vector part of the
unit quaternion, which is half the rotation vector.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from gvpipe.core.geometry.pose import quaternions
from gvpipe.core.types import Float, Pose

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
