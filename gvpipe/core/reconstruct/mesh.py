"""From the level-set function to closed surfaces and a list of obstacles."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from skimage.measure import approximate_polygon, find_contours, marching_cubes

from gvpipe.core.reconstruct.grid import Volume, VoxelGrid
from gvpipe.core.types import Float, Image

SMALLEST_OBSTACLE_M3 = 2e-6
"""Closed surfaces that hold less are specks of the evidence: a cube with sides of 1.3 cm, less than
any robot's wheel has to mind."""

CLEARANCE = np.float32(0.01)
"""Voxels between the surface and every voxel centre, so that all triangles have an area: a shift
by a hundredth of what the grid resolves."""

OUTLINE_TOLERANCE = 0.5
"""How far a simplified footprint may leave the true outline, voxels."""


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh in the map frame.

    Attributes
    ----------
    vertices : (N, 3) float64
        Metres.
    faces : (M, 3) int32
        Vertex indices, counter-clockwise seen from outside.
    normals : (N, 3) float64
        Unit, outward; zero where a vertex has no face.
    colours : (N, 3) uint8
        RGB.
    """

    vertices: Float
    faces: NDArray[np.int32]
    normals: Float
    colours: Image

    @classmethod
    def of(cls, vertices: Float, faces: NDArray[np.int32]) -> "Mesh":
        """Mesh without colours (mid grey), normals from its faces."""
        grey = np.full((len(vertices), 3), 128, dtype=np.uint8)
        return cls(vertices, faces, vertex_normals(vertices, faces), grey)

    @property
    def area(self) -> float:
        """Surface area, square metres."""
        return float(np.linalg.norm(_face_vectors(self.vertices, self.faces), axis=1).sum())

    @property
    def volume(self) -> float:
        """Volume enclosed, cubic metres; right only for closed surfaces."""
        heights = self.vertices[self.faces].mean(axis=1) - _middle(self.vertices)
        return float(np.einsum("ij,ij", heights, _face_vectors(self.vertices, self.faces)) / 3.0)


@dataclass(frozen=True)
class Obstacle:
    """One connected thing that stands on the ground.

    Attributes
    ----------
    id : int
        From 0, largest volume first.
    footprint : (N, 2) float64
        Outline of the projection on the ground, metres, counter-clockwise, not repeated at its end.
    height_m : float
        Highest point above the ground.
    volume_m3 : float
        Volume of the closed surface.
    centroid : (3,) float64
        Centre of volume in the map, metres.
    mesh : Mesh
        Its closed surface.
    """

    id: int
    footprint: Float
    height_m: float
    volume_m3: float
    centroid: Float
    mesh: Mesh


@dataclass(frozen=True)
class PointCloud:
    """Oriented coloured points in the map frame.

    Attributes
    ----------
    points, normals : (N, 3) float64
        Metres; unit.
    colours : (N, 3) uint8
        RGB.
    """

    points: Float
    normals: Float
    colours: Image


def _middle(vertices: Float) -> Float:
    """Mean of the vertices, (3,): near the surface, where volumes lose no digits."""
    return vertices.mean(axis=0) if len(vertices) else np.zeros(3)


def _face_vectors(vertices: Float, faces: NDArray[np.int32]) -> Float:
    """Compute the normal of each face, as long as its area, (M, 3)."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.asarray(np.cross(b - a, c - a) / 2.0)


def vertex_normals(vertices: Float, faces: NDArray[np.int32]) -> Float:
    """Area-weighted unit normals, (N, 3), of the vertices of a mesh."""
    vectors = _face_vectors(vertices, faces)
    corners = faces.ravel()
    total = np.column_stack(
        [
            np.bincount(corners, weights=np.repeat(vectors[:, k], 3), minlength=len(vertices))
            for k in range(3)
        ]
    )
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.asarray(total / np.where(length > 0, length, 1.0))


def closed_at_borders(u: Volume, grid: VoxelGrid) -> tuple[Volume, VoxelGrid]:
    """Cut a level-set function by the ground and by the faces of its grid.

    Parameters
    ----------
    u : (nx, ny, nz) float32
        Positive inside, metres.
    grid : VoxelGrid
        Where u is.

    Returns
    -------
    closed : (nx + 2, ny + 2, nz + 2) float32
        Negative in an outer layer of voxels and below the ground z = 0; its zero level closes
        exactly at the ground and at the faces of the grid.
    grid : VoxelGrid
        The grid with that outer layer.
    """
    nx, ny, nz = grid.shape
    outer = VoxelGrid(grid.origin - grid.spacing, grid.spacing, (nx + 2, ny + 2, nz + 2))
    closed = np.pad(u, 1, mode="edge")
    lower, upper = grid.lower.copy(), grid.upper
    lower[2] = max(lower[2], 0.0)
    for axis, centres in enumerate(outer.axes()):
        depth = np.minimum(centres - lower[axis], upper[axis] - centres).astype(np.float32)
        shape = [1, 1, 1]
        shape[axis] = -1
        np.minimum(closed, depth.reshape(shape), out=closed)
    # where a corner lies on the surface, triangles shrink to nothing and their vertices fall
    # together for readers that merge equal ones: the mesh would no longer be closed
    least = CLEARANCE * np.float32(grid.spacing.min())
    closed = np.where(closed > 0, np.maximum(closed, least), np.minimum(closed, -least))
    return closed, outer


def surface(u: Volume, grid: VoxelGrid) -> Mesh:
    """Extract the closed zero level of u above the ground, as one mesh without colours.

    Parameters
    ----------
    u : (nx, ny, nz) float32
        Positive inside, metres.
    grid : VoxelGrid
        Where u is.

    Returns
    -------
    mesh : Mesh
        Watertight; empty where u is nowhere positive above the ground.
    """
    return _zero_level(*closed_at_borders(u, grid))


def _zero_level(u: Volume, grid: VoxelGrid) -> Mesh:
    """Extract the zero level of u as a mesh whose faces look outward."""
    if not (u > 0).any():
        return Mesh.of(np.empty((0, 3)), np.empty((0, 3), dtype=np.int32))
    corners, faces, _, _ = marching_cubes(u, 0.0, gradient_direction="ascent")  # type: ignore[no-untyped-call]
    vertices = grid.map_from_index(corners.astype(np.float64))
    mesh = Mesh.of(vertices, faces.astype(np.int32))
    return mesh if mesh.volume >= 0 else Mesh.of(vertices, faces[:, ::-1].astype(np.int32))


def find_obstacles(
    u: Volume, grid: VoxelGrid, smallest_m3: float = SMALLEST_OBSTACLE_M3
) -> list[Obstacle]:
    """Split the inside of u into connected obstacles.

    Parameters
    ----------
    u : (nx, ny, nz) float32
        Positive inside, metres.
    grid : VoxelGrid
        Where u is; z = 0 is the ground.
    smallest_m3 : float
        Obstacles that hold less are dropped, cubic metres.

    Returns
    -------
    obstacles : list of Obstacle
        Largest first. Voids that are closed on all sides count as solid: no view sees them.
    """
    closed, outer = closed_at_borders(u, grid)
    solid = ndimage.binary_fill_holes(closed > 0)
    closed = np.where(solid, np.abs(closed), closed)
    labels, _ = ndimage.label(solid)
    found = []
    for label, box in enumerate(ndimage.find_objects(labels), start=1):
        # one more voxel on each side: the surface runs between inside and outside
        around = tuple(slice(s.start - 1, s.stop + 1) for s in box)
        part, mine = closed[around], labels[around] == label
        alone = np.where(mine, part, -np.abs(part))
        corner = outer.map_from_index(np.array([s.start for s in around]))
        here = VoxelGrid(corner, grid.spacing, alone.shape)
        mesh = _zero_level(alone, here)
        if mesh.volume >= smallest_m3:
            found.append((mesh, _outline(alone, here)))
    found.sort(key=lambda item: -item[0].volume)
    return [_describe(k, mesh, outline) for k, (mesh, outline) in enumerate(found)]


def _describe(index: int, mesh: Mesh, outline: Float) -> Obstacle:
    """Measure a closed mesh."""
    middle = _middle(mesh.vertices)
    corners = mesh.vertices[mesh.faces] - middle
    six = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    centroid = middle + (corners.sum(axis=1) * six[:, None]).sum(axis=0) / (4.0 * six.sum())
    return Obstacle(
        id=index,
        footprint=outline,
        height_m=float(mesh.vertices[:, 2].max()),
        volume_m3=mesh.volume,
        centroid=centroid,
        mesh=mesh,
    )


def _outline(u: Volume, grid: VoxelGrid) -> Float:
    """Outer outline, (N, 2) metres, of the projection along z of what is inside."""
    projected = u.max(axis=2).astype(np.float64)
    rings = [
        approximate_polygon(ring, OUTLINE_TOLERANCE)[:-1]  # type: ignore[no-untyped-call]
        for ring in find_contours(projected, 0.0)  # type: ignore[no-untyped-call]
    ]
    ring = max(rings, key=lambda r: abs(polygon_area(r)))
    ring = ring if polygon_area(ring) > 0 else ring[::-1]
    return np.asarray(grid.origin[:2] + ring * grid.spacing[:2])


def polygon_area(polygon: Float) -> float:
    """Signed area of an (N, 2) polygon: positive if counter-clockwise."""
    x, y = polygon[:, 0], polygon[:, 1]
    return float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum() / 2.0)


def join(meshes: list[Mesh]) -> Mesh:
    """Put several meshes into one."""
    if not meshes:
        return Mesh.of(np.empty((0, 3)), np.empty((0, 3), dtype=np.int32))
    offsets = np.cumsum([0, *(len(m.vertices) for m in meshes[:-1])])
    return Mesh(
        vertices=np.concatenate([m.vertices for m in meshes]),
        faces=np.concatenate([m.faces + np.int32(o) for m, o in zip(meshes, offsets, strict=True)]),
        normals=np.concatenate([m.normals for m in meshes]),
        colours=np.concatenate([m.colours for m in meshes]),
    )
