"""GLB files as another reader sees them."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from gvpipe.core.reconstruct.mesh import Mesh, join
from gvpipe.formats.glb import encode_glb, write_glb


@pytest.fixture
def mesh() -> Mesh:
    solid = trimesh.creation.box(extents=(0.4, 0.2, 0.6))  # 0.6 m high in the map
    solid.apply_translation((1.0, 2.0, 0.3))
    plain = Mesh.of(np.asarray(solid.vertices), np.asarray(solid.faces, dtype=np.int32))
    colours = np.random.default_rng(3).integers(0, 256, plain.vertices.shape, dtype=np.uint8)
    return Mesh(plain.vertices, plain.faces, plain.normals, colours)


def test_trimesh_reads_the_mesh_with_its_y_axis_up(tmp_path: Path, mesh: Mesh) -> None:
    write_glb(tmp_path / "m.glb", mesh)
    other = trimesh.load(tmp_path / "m.glb", force="mesh", process=False)
    assert isinstance(other, trimesh.Trimesh)
    assert other.is_watertight
    assert other.volume == pytest.approx(mesh.volume, rel=1e-6)
    low, high = other.bounds
    assert high - low == pytest.approx([0.4, 0.6, 0.2], abs=1e-6)
    assert low[1] == pytest.approx(0.0, abs=1e-6)
    x, y, z = mesh.vertices.T
    assert np.asarray(other.vertices) == pytest.approx(np.column_stack([x, z, -y]), abs=1e-6)


def test_colours_are_linear_light(mesh: Mesh, tmp_path: Path) -> None:
    write_glb(tmp_path / "m.glb", mesh)
    other = trimesh.load(tmp_path / "m.glb", force="mesh", process=False)
    linear = np.asarray(other.visual.vertex_colors)[:, :3].astype(np.float64) / 255
    # back to sRGB, which photographs are in; dark levels lie closer than a reader's 8 bits
    back = 255 * np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    bright = mesh.colours > 60
    assert np.abs(back - mesh.colours)[bright].max() < 3
    assert (np.asarray(other.visual.vertex_colors)[:, 3] == 255).all()


def test_the_container_keeps_the_rules_of_the_format(mesh: Mesh) -> None:
    data = encode_glb(mesh)
    assert data == encode_glb(mesh)
    magic, version, length = data[:4], *np.frombuffer(data[4:12], "<u4")
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size = int(np.frombuffer(data[12:16], "<u4")[0])
    assert size % 4 == 0
    document = json.loads(data[20 : 20 + size])
    assert all(v["byteOffset"] % 4 == 0 for v in document["bufferViews"])
    assert document["accessors"][0]["max"] == pytest.approx([1.2, 0.6, -1.9])
    start = 28 + size + document["bufferViews"][1]["byteOffset"]
    normals = np.frombuffer(data, "<f4", count=24, offset=start).reshape(8, 3)
    nx, ny, nz = mesh.normals.T
    assert normals == pytest.approx(np.column_stack([nx, nz, -ny]), abs=1e-6)
    assert len(data) == 20 + size + 8 + document["buffers"][0]["byteLength"]


def test_nothing_is_an_empty_scene(tmp_path: Path) -> None:
    write_glb(tmp_path / "m.glb", join([]))
    scene = trimesh.load(tmp_path / "m.glb")
    assert isinstance(scene, trimesh.Scene)
    assert not scene.geometry
