"""Solids that stand on the ground of a made-up scene: their numbers and their exact surface."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.reconstruct.mesh import Mesh
from gvpipe.core.types import Float

Kind = Literal["box", "cylinder", "sphere"]

KINDS: tuple[Kind, ...] = ("box", "cylinder", "sphere")
"""In the order of the numbers that the ray tracer knows them by."""

SIDES = 64
"""Corners of the polygon that stands for a circle: 1.2 mm off at a radius of one metre."""


@dataclass(frozen=True)
class Solid:
    """One thing on the ground.

    Attributes
    ----------
    kind : {'box', 'cylinder', 'sphere'}
        Its shape; a sphere touches the ground in one point.
    x, y : float
        Where its middle stands in the map, metres.
    size : (float, float, float)
        Extent along its own x and y and its height, metres; a cylinder's first two are its
        diameter, all three are a sphere's.
    yaw : float
        Radians, counter-clockwise seen from above.
    colour : (float, float, float)
        RGB from 0 to 1 that tints its texture.
    """

    kind: Kind
    x: float
    y: float
    size: tuple[float, float, float]
    yaw: float = 0.0
    colour: tuple[float, float, float] = (0.8, 0.8, 0.8)

    @property
    def surface(self) -> Mesh:
        """Closed surface in the map; curved sides are polygons of :data:`SIDES` corners."""
        vertices, faces = _SURFACES[self.kind]()
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        scaled = vertices * np.array(self.size)
        turned = scaled @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        mesh = Mesh.of(turned + np.array([self.x, self.y, 0.0]), faces)
        rgb = np.round(255 * np.array(self.colour)).astype(np.uint8)
        return Mesh(mesh.vertices, faces, mesh.normals, np.tile(rgb, (len(vertices), 1)))


def _prism(outline: Float) -> tuple[Float, NDArray[np.int32]]:
    """Surface of unit height over a convex outline, counter-clockwise."""
    n = len(outline)
    low = np.column_stack([outline, np.zeros(n)])
    high = np.column_stack([outline, np.ones(n)])
    k = np.arange(n)
    after = (k + 1) % n
    sides = np.concatenate(
        [np.column_stack([k, after, after + n]), np.column_stack([k, after + n, k + n])]
    )
    fan = np.column_stack([np.zeros(n - 2, int), np.arange(1, n - 1), np.arange(2, n)])
    faces = np.concatenate([sides, fan + n, fan[:, ::-1]])
    return np.concatenate([low, high]), faces.astype(np.int32)


def _box() -> tuple[Float, NDArray[np.int32]]:
    """Cube of unit sides."""
    return _prism(np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]))


def _circle() -> Float:
    """Circle of unit diameter, (SIDES, 2), counter-clockwise."""
    angle = 2 * np.pi * np.arange(SIDES) / SIDES
    return 0.5 * np.column_stack([np.cos(angle), np.sin(angle)])


def _cylinder() -> tuple[Float, NDArray[np.int32]]:
    """Cylinder of unit diameter and height."""
    return _prism(_circle())


def _sphere() -> tuple[Float, NDArray[np.int32]]:
    """Rings of the same corners between two poles, standing on z = 0."""
    rings = SIDES // 2
    polar = np.pi * np.arange(1, rings) / rings
    ring = _circle()
    body = [
        np.column_stack([ring * np.sin(a), np.full(SIDES, 0.5 - 0.5 * np.cos(a))]) for a in polar
    ]
    vertices = np.concatenate([*body, [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]])
    k = np.arange(SIDES)
    after = (k + 1) % SIDES
    south, north = len(vertices) - 2, len(vertices) - 1
    faces = [np.column_stack([np.full(SIDES, south), after, k])]
    for r in range(rings - 2):
        low, high = r * SIDES, (r + 1) * SIDES
        faces.append(np.column_stack([k + low, after + low, after + high]))
        faces.append(np.column_stack([k + low, after + high, k + high]))
    top = (rings - 2) * SIDES
    faces.append(np.column_stack([np.full(SIDES, north), k + top, after + top]))
    return vertices, np.concatenate(faces).astype(np.int32)


_SURFACES = {"box": _box, "cylinder": _cylinder, "sphere": _sphere}
