"""Binary glTF 2.0 of coloured meshes, for viewers on the web and in robot simulators."""

import json
import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gvpipe.core.reconstruct.mesh import Mesh
from gvpipe.core.types import Float, Image

GLTF_FROM_MAP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""glTF has y up; the map's x stays, its z becomes y."""

ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
FLOAT, UNSIGNED_INT = 5126, 5125
"""Numbers by which glTF names the use and the type of what a buffer holds."""


def encode_glb(mesh: Mesh) -> bytes:
    """Encode a mesh; the same mesh gives the same bytes.

    Parameters
    ----------
    mesh : Mesh
        In the map frame (z up), metres. Without faces the scene is empty.

    Returns
    -------
    glb : bytes
        One mesh with positions and normals (y up, metres), linear vertex colours as glTF asks,
        and triangles, in a scene of one node called ``obstacles``.
    """
    document: dict[str, object] = {
        "asset": {"version": "2.0", "generator": "gvpipe"},
        "scene": 0,
        "scenes": [{"nodes": []}],
    }
    body = b""
    if len(mesh.faces):
        body = _fill(document, mesh)
    return _container(document, body)


def write_glb(path: Path, mesh: Mesh) -> None:
    """Write a mesh as binary glTF."""
    path.write_bytes(encode_glb(mesh))


def _fill(document: dict[str, object], mesh: Mesh) -> bytes:
    """Describe the mesh in the document; give the bytes it points to."""
    positions = (mesh.vertices @ GLTF_FROM_MAP.T).astype("<f4")
    normals = _unit(mesh.normals @ GLTF_FROM_MAP.T).astype("<f4")
    columns: list[tuple[str, NDArray[np.generic], int]] = [
        ("POSITION", positions, FLOAT),
        ("NORMAL", normals, FLOAT),
        ("COLOR_0", _linear(mesh.colours).astype("<f4"), FLOAT),
        ("", mesh.faces.astype("<u4").ravel(), UNSIGNED_INT),
    ]
    body = b""
    views: list[dict[str, int]] = []
    accessors: list[dict[str, object]] = []
    for name, values, kind in columns:
        data = values.tobytes()
        target = ARRAY_BUFFER if name else ELEMENT_ARRAY_BUFFER
        views.append(
            {"buffer": 0, "byteOffset": len(body), "byteLength": len(data), "target": target}
        )
        accessor: dict[str, object] = {
            "bufferView": len(accessors),
            "componentType": kind,
            "count": len(values),
            "type": "VEC3" if name else "SCALAR",
        }
        if name == "POSITION":
            accessor["min"] = positions.min(axis=0).tolist()
            accessor["max"] = positions.max(axis=0).tolist()
        accessors.append(accessor)
        body += data  # every element is a multiple of four bytes long, as glTF wants
    attributes = {name: k for k, (name, *_) in enumerate(columns) if name}
    indices = len(attributes)
    document |= {
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "obstacles"}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": indices}]}],
        "buffers": [{"byteLength": len(body)}],
        "bufferViews": views,
        "accessors": accessors,
    }
    return body


def _unit(vectors: Float) -> Float:
    """Make vectors unit again after rounding; glTF has no zero normals, so those point up."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(length > 0, vectors / np.where(length > 0, length, 1.0), (0.0, 1.0, 0.0))


def _linear(colours: Image) -> Float:
    """Linear light, 0..1, of sRGB colours, 0..255 (IEC 61966-2-1)."""
    s = colours.astype(np.float64) / 255.0
    return np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)


def _container(document: dict[str, object], body: bytes) -> bytes:
    """Wrap JSON and data in the chunks of a GLB file."""
    text = json.dumps(document, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    if body:
        chunks += struct.pack("<I4s", len(body), b"BIN\0") + body
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
