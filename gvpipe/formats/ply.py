"""Binary PLY: coloured triangle meshes and oriented points."""

from pathlib import Path

import numpy as np

from gvpipe.core.reconstruct.mesh import Mesh, PointCloud
from gvpipe.core.types import Float, Image, Rejected
from gvpipe.errors import InputError
from gvpipe.formats.files import read_regular_file

_VERTEX = np.dtype(
    [(n, "<f4") for n in ("x", "y", "z", "nx", "ny", "nz")]
    + [(n, "u1") for n in ("red", "green", "blue")]
)
_FACE = np.dtype([("count", "u1"), ("vertex_indices", "<i4", (3,))])

_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "<i2"),
    **dict.fromkeys(("ushort", "uint16"), "<u2"),
    **dict.fromkeys(("int", "int32"), "<i4"),
    **dict.fromkeys(("uint", "uint32"), "<u4"),
    **dict.fromkeys(("float", "float32"), "<f4"),
    **dict.fromkeys(("double", "float64"), "<f8"),
}

MOST_HEADER_BYTES = 16384
"""A header is a few hundred bytes; one without an end is not looked for further than this."""

MOST_FILE_BYTES = 2**30
"""Larger files are refused: a 400 x 400 x 200 grid gives surfaces of some 50 MB."""


def _vertices(points: Float, normals: Float, colours: Image) -> bytes:
    """Pack the rows of the element `vertex`."""
    rows = np.empty(len(points), dtype=_VERTEX)
    for k, name in enumerate(("x", "y", "z")):
        rows[name], rows["n" + name] = points[:, k], normals[:, k]
    for k, name in enumerate(("red", "green", "blue")):
        rows[name] = colours[:, k]
    return rows.tobytes()


def _header(vertices: int, faces: int | None) -> bytes:
    """Write the header; None: without the element `face`."""
    lines = ["ply", "format binary_little_endian 1.0", "comment gvpipe, metres, z up"]
    lines += [f"element vertex {vertices}"]
    lines += [f"property float {n}" for n in ("x", "y", "z", "nx", "ny", "nz")]
    lines += [f"property uchar {n}" for n in ("red", "green", "blue")]
    if faces is not None:
        lines += [f"element face {faces}", "property list uchar int vertex_indices"]
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii")


def encode_mesh(mesh: Mesh) -> bytes:
    """Encode a mesh; the same mesh gives the same bytes."""
    rows = np.empty(len(mesh.faces), dtype=_FACE)
    rows["count"], rows["vertex_indices"] = 3, mesh.faces
    body = _vertices(mesh.vertices, mesh.normals, mesh.colours) + rows.tobytes()
    return _header(len(mesh.vertices), len(mesh.faces)) + body


def encode_points(cloud: PointCloud) -> bytes:
    """Encode oriented points; the same points give the same bytes."""
    return _header(len(cloud.points), None) + _vertices(cloud.points, cloud.normals, cloud.colours)


def write_mesh(path: Path, mesh: Mesh) -> None:
    """Write a mesh (vertices float32 metres, normals, colours, triangles)."""
    path.write_bytes(encode_mesh(mesh))


def write_points(path: Path, cloud: PointCloud) -> None:
    """Write oriented coloured points (float32 metres)."""
    path.write_bytes(encode_points(cloud))


def read_mesh(path: Path) -> Mesh:
    """Read a binary little-endian PLY of triangles.

    Parameters
    ----------
    path : Path
        The file. Elements other than `vertex` and `face` are refused; extra vertex properties
        are ignored; missing normals are computed, missing colours are grey.

    Returns
    -------
    mesh : Mesh
        Without faces if the file holds points.

    Raises
    ------
    InputError
        If the file cannot be read, is too large, is not such a PLY, is cut short or too long, or
        has corners that are not finite or indices out of range.
    """
    data = read_regular_file(path, MOST_FILE_BYTES)
    if isinstance(data, Rejected):
        raise InputError(f"{path}: {data.reason}")
    try:
        return _decode(data)
    except ValueError as error:
        raise InputError(f"{path}: not a PLY mesh that gvpipe reads: {error}") from error


def _decode(data: bytes) -> Mesh:
    """Read the bytes of a file; ValueError says what is wrong with them."""
    end = data.find(b"end_header\n", 0, MOST_HEADER_BYTES)
    if not data.startswith(b"ply\n") or end < 0:
        raise ValueError("no PLY header")
    lines = data[:end].decode("ascii").splitlines()[1:]
    vertex_count, fields, face_count = _parse(lines)
    layout = np.dtype(fields)
    if not {"x", "y", "z"} <= set(layout.names or ()):
        raise ValueError("vertices have no x, y, z")
    body = memoryview(data)[end + len(b"end_header\n") :]
    expected = vertex_count * layout.itemsize + face_count * _FACE.itemsize
    if len(body) != expected:
        raise ValueError(f"{len(body)} bytes of data where the header promises {expected}")
    rows = np.frombuffer(body, dtype=layout, count=vertex_count)
    triangles = np.frombuffer(body, dtype=_FACE, offset=vertex_count * layout.itemsize)
    if (triangles["count"] != 3).any():
        raise ValueError("a face is not a triangle")
    faces = triangles["vertex_indices"].astype(np.int32)
    if len(faces) and (faces.min() < 0 or faces.max() >= vertex_count):
        raise ValueError("a face names a vertex that is not there")
    vertices = _columns(rows, ("x", "y", "z"))
    if not np.isfinite(vertices).all():
        raise ValueError("a vertex is not finite")
    mesh = Mesh.of(vertices, faces)
    names = set(layout.names or ())
    normals = _columns(rows, ("nx", "ny", "nz")) if {"nx", "ny", "nz"} <= names else mesh.normals
    colours = mesh.colours
    if {"red", "green", "blue"} <= names and all(
        layout[n] == np.uint8 for n in ("red", "green", "blue")
    ):
        colours = np.column_stack([rows[n] for n in ("red", "green", "blue")])
    return Mesh(vertices, faces, normals, colours)


def _columns(rows: np.ndarray, names: tuple[str, ...]) -> Float:
    """Put some columns side by side, (N, k)."""
    return np.column_stack([rows[n].astype(np.float64) for n in names])


def _parse(lines: list[str]) -> tuple[int, list[tuple[str, str]], int]:
    """Vertex count, vertex fields and face count of a header."""
    counts: dict[str, int] = {}
    fields: list[tuple[str, str]] = []
    element = ""
    if "format binary_little_endian 1.0" not in lines:
        raise ValueError("only binary_little_endian 1.0 is read")
    for line in lines:
        words = line.split()
        match words:
            case ["format" | "comment" | "obj_info", *_]:
                continue
            case ["element", "vertex" | "face" as name, count] if name not in counts:
                element = name
                if not count.isdecimal() or len(count) > 10:
                    raise ValueError(f"bad count {count!r}")
                counts[name] = int(count)
            case ["property", kind, name] if element == "vertex" and kind in _TYPES:
                fields.append((name, _TYPES[kind]))
            case ["property", "list", "uchar" | "uint8", "int" | "int32" | "uint" | "uint32", name]:
                if element != "face" or name not in ("vertex_indices", "vertex_index"):
                    raise ValueError(f"unknown list {name!r}")
            case _:
                raise ValueError(f"unknown header line {line[:80]!r}")
    if list(counts) not in (["vertex"], ["vertex", "face"]):
        raise ValueError("elements must be vertex, then face")
    return counts["vertex"], fields, counts.get("face", 0)
