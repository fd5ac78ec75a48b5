"""PLY files: round trips, other readers, and files that are not what they say."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from gvpipe.core.reconstruct.mesh import Mesh, PointCloud
from gvpipe.errors import InputError
from gvpipe.formats.ply import encode_mesh, encode_points, read_mesh, write_mesh, write_points


@pytest.fixture
def mesh() -> Mesh:
    solid = trimesh.creation.icosphere(subdivisions=2, radius=0.3)
    rng = np.random.default_rng(5)
    plain = Mesh.of(np.asarray(solid.vertices), np.asarray(solid.faces, dtype=np.int32))
    colours = rng.integers(0, 256, plain.vertices.shape, dtype=np.uint8)
    return Mesh(plain.vertices, plain.faces, plain.normals, colours)


def test_a_mesh_survives_the_round_trip(tmp_path: Path, mesh: Mesh) -> None:
    path = tmp_path / "mesh.ply"
    write_mesh(path, mesh)
    back = read_mesh(path)
    assert back.vertices == pytest.approx(mesh.vertices, abs=1e-7)
    assert back.normals == pytest.approx(mesh.normals, abs=1e-7)
    assert (back.faces == mesh.faces).all()
    assert (back.colours == mesh.colours).all()
    assert encode_mesh(back) == path.read_bytes()


def test_trimesh_reads_the_mesh_with_colours(tmp_path: Path, mesh: Mesh) -> None:
    write_mesh(tmp_path / "mesh.ply", mesh)
    other = trimesh.load(tmp_path / "mesh.ply", process=False)
    assert isinstance(other, trimesh.Trimesh)
    assert other.is_watertight
    assert other.volume == pytest.approx(mesh.volume, rel=1e-5)
    assert (np.asarray(other.visual.vertex_colors)[:, :3] == mesh.colours).all()
    assert np.asarray(other.vertex_normals) == pytest.approx(mesh.normals, abs=1e-6)


def test_trimesh_reads_the_points(tmp_path: Path, mesh: Mesh) -> None:
    write_points(tmp_path / "p.ply", PointCloud(mesh.vertices, mesh.normals, mesh.colours))
    cloud = trimesh.load(tmp_path / "p.ply")
    assert isinstance(cloud, trimesh.PointCloud)
    assert np.asarray(cloud.vertices) == pytest.approx(mesh.vertices, abs=1e-7)
    assert (np.asarray(cloud.colors)[:, :3] == mesh.colours).all()
    assert len(read_mesh(tmp_path / "p.ply").faces) == 0


def test_what_trimesh_writes_is_read(tmp_path: Path, mesh: Mesh) -> None:
    trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(tmp_path / "t.ply")
    back = read_mesh(tmp_path / "t.ply")
    assert back.volume == pytest.approx(mesh.volume, rel=1e-5)


def test_an_empty_mesh_can_be_written_and_read(tmp_path: Path) -> None:
    nothing = Mesh.of(np.empty((0, 3)), np.empty((0, 3), dtype=np.int32))
    write_mesh(tmp_path / "none.ply", nothing)
    assert len(read_mesh(tmp_path / "none.ply").vertices) == 0


def test_the_same_points_give_the_same_bytes(mesh: Mesh) -> None:
    cloud = PointCloud(mesh.vertices, mesh.normals, mesh.colours)
    assert encode_points(cloud) == encode_points(
        PointCloud(mesh.vertices.copy(order="F"), mesh.normals.copy(), mesh.colours.copy())
    )


def broken(data: bytes) -> dict[str, bytes]:
    """Files with one defect each."""
    end = data.index(b"end_header\n") + len(b"end_header\n")
    header, body = data[:end], bytearray(data[end:])
    far = bytes(body[:-4]) + (10**6).to_bytes(4, "little")
    negative = bytes(body[:-4]) + b"\xff\xff\xff\xff"
    endless = bytes(body)
    nan = np.float32("nan").tobytes() + bytes(body[4:])
    quads = bytearray(body)
    quads[-13] = 4
    return {
        "empty": b"",
        "another format": b"solid cube\n",
        "no end": data[: end - 12],
        "cut short": data[:-1],
        "too long": data + b"\0",
        "ascii": data.replace(b"binary_little_endian", b"ascii"),
        "index out of range": header + far,
        "negative index": header + negative,
        "not finite": header + nan,
        "not triangles": header + bytes(quads),
        "huge count": header.replace(b"vertex 162", b"vertex 999999999999") + endless,
        "promises more": header.replace(b"vertex 162", b"vertex 4000000000") + endless,
        "negative count": header.replace(b"vertex 162", b"vertex -162") + endless,
        "unknown type": header.replace(b"float x", b"quad x") + endless,
        "two elements": header.replace(b"element face", b"element vertex") + endless,
        "no coordinates": header.replace(b"float x", b"float a") + endless,
        "repeated property": header.replace(b"float nx", b"float ny") + endless,
        "not text": header.replace(b"gvpipe", b"\xff\xfe") + endless,
        "no vertices": b"ply\nformat binary_little_endian 1.0\nend_header\n",
    }


def test_broken_files_are_refused_by_name(tmp_path: Path, mesh: Mesh) -> None:
    for defect, data in broken(encode_mesh(mesh)).items():
        path = tmp_path / f"{defect}.ply"
        path.write_bytes(data)
        with pytest.raises(InputError, match=defect):
            read_mesh(path)


def test_a_missing_file_is_an_input_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"gone\.ply"):
        read_mesh(tmp_path / "gone.ply")
