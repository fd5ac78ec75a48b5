"""Artefact files: canonical, checked, whole or not at all."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gvpipe.artefacts import (
    canonical_json,
    digest,
    publish,
    read_artefact,
    read_npz,
    schema_of,
    staging,
    write_npz,
)
from gvpipe.errors import InputError, OutputError
from gvpipe.records import Header, MatchBody, PairRow, SkippedImage

HEADER = Header(
    schema_id=schema_of(MatchBody),
    gvpipe_version="1",
    config_sha256="0" * 64,
    inputs={"A/0.jpg": "1" * 64},
    files={},
    seed=0,
    scale_source="height",
    wall_s=1.5,
    skipped=(SkippedImage(image="A/é\udc80".encode("utf-8", "replace").decode(), reason="bad"),),
)
BODY = MatchBody(
    pairs=(
        PairRow(image_i="A/0.jpg", image_j="A/1.jpg", status="ok", H=np.eye(3), inliers=4),
        PairRow(image_i="A/1.jpg", image_j="A/2.jpg", status="rejected", reason="none"),
    )
)


def written(out: Path) -> Path:
    folder = out / "match"
    with staging(out, "match") as staged:
        write_npz(staged / "match.npz", {"0/points_i": np.ones((3, 2))})
        publish(staged, folder, HEADER, BODY)
    return folder


def test_round_trip(tmp_path: Path) -> None:
    artefact = read_artefact(written(tmp_path), MatchBody)
    assert np.array_equal(artefact.body.pairs[0].H, np.eye(3))
    assert artefact.body.pairs[1].H is None
    assert artefact.header.inputs == HEADER.inputs
    assert artefact.header.skipped == HEADER.skipped
    assert np.array_equal(artefact.arrays("match.npz")["0/points_i"], np.ones((3, 2)))
    assert not list(tmp_path.glob(".match.writing*"))


def test_writing_twice_gives_the_same_bytes(tmp_path: Path) -> None:
    (tmp_path / "1").mkdir()
    (tmp_path / "2").mkdir()
    first, second = written(tmp_path / "1"), written(tmp_path / "2")
    for name in ("match.json", "match.npz"):
        assert (first / name).read_bytes() == (second / name).read_bytes()


def test_digest_ignores_only_the_wall_time(tmp_path: Path) -> None:
    document = json.loads((written(tmp_path) / "match.json").read_text())
    assert digest(document) == digest({**document, "wall_s": 9.0})
    assert digest(document) != digest({**document, "seed": 1})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"schema": "gvpipe/slam/1"}, "schema: expected 'gvpipe/match/1'"),
        ({"schema": "gvpipe/match/2"}, "schema: expected 'gvpipe/match/1'"),
        ({"pairs": [{"image_i": "a"}]}, r"pairs\.0\.image_j"),
        ({"pairs": [{"image_i": "a", "image_j": "b", "status": "ok", "H": [[1]]}]}, "shape"),
        ({"pairs": 3}, "pairs"),
        ({"surprise": 1}, "surprise"),
        ({"files": {"../../etc/passwd": "0"}}, "missing"),
    ],
)
def test_a_file_that_lies_is_refused_by_name(
    tmp_path: Path, change: dict[str, object], message: str
) -> None:
    path = written(tmp_path) / "match.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    with pytest.raises(InputError, match=message):
        read_artefact(path.parent, MatchBody)


@pytest.mark.parametrize("content", [b"", b"{", b"[1]", b'{"a": NaN}', b"\xff\xfe", b"[" * 100_000])
def test_broken_json_is_refused_by_name(tmp_path: Path, content: bytes) -> None:
    path = written(tmp_path) / "match.json"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"match\.json"):
        read_artefact(path.parent, MatchBody)


@pytest.mark.parametrize("name", ["match.json", "match.npz"])
def test_a_pipe_is_not_waited_for(tmp_path: Path, name: str) -> None:
    folder = written(tmp_path)
    (folder / name).unlink()
    os.mkfifo(folder / name)
    with pytest.raises(InputError, match=name):
        read_artefact(folder, MatchBody)
    with pytest.raises(InputError, match=name):
        read_npz(folder / name)


def test_changed_side_files_are_noticed(tmp_path: Path) -> None:
    folder = written(tmp_path)
    with (folder / "match.npz").open("ab") as stream:
        stream.write(b"x")
    with pytest.raises(InputError, match="its content is not what"):
        read_artefact(folder, MatchBody)
    (folder / "match.npz").unlink()
    with pytest.raises(InputError, match="missing"):
        read_artefact(folder, MatchBody)


def test_republishing_removes_only_our_own_outdated_files(tmp_path: Path) -> None:
    folder = written(tmp_path)
    (folder / "notes.txt").write_text("mine")
    with staging(tmp_path, "match") as staged:
        publish(staged, folder, HEADER, BODY)
    assert sorted(p.name for p in folder.iterdir()) == ["match.json", "notes.txt"]


def test_a_failure_while_staging_leaves_the_old_artefact(tmp_path: Path) -> None:
    folder = written(tmp_path)
    before = {p.name: p.read_bytes() for p in folder.iterdir()}

    def fail() -> None:
        with staging(tmp_path, "match") as staged:
            (staged / "match.npz").write_bytes(b"half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert {p.name: p.read_bytes() for p in folder.iterdir()} == before
    assert [p.name for p in tmp_path.iterdir()] == ["match"]


def test_artefacts_are_not_written_through_links(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "match").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OutputError, match="symbolic link"):
        written(tmp_path)


def test_npz_never_pickles(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="Python objects"):
        write_npz(tmp_path / "a.npz", {"a": np.array([{}], dtype=object)})
    np.savez(tmp_path / "b.npz", a=np.array([{}], dtype=object))
    with pytest.raises(InputError, match=r"b\.npz"):
        read_npz(tmp_path / "b.npz")


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", b"text"])
def test_broken_npz_is_refused_by_name(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.npz").write_bytes(content)
    with pytest.raises(InputError, match=r"a\.npz"):
        read_npz(tmp_path / "a.npz")


JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(st.characters(codec="utf-8")),
    lambda children: st.lists(children) | st.dictionaries(st.text(max_size=3), children),
    max_leaves=20,
)


def test_no_flipped_bit_of_an_npz_is_a_defect(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    write_npz(path, {"points": np.arange(40.0).reshape(20, 2), "names": np.array(["a", "b"])})
    sound = path.read_bytes()
    refused = 0
    for at in range(len(sound)):
        damaged = bytearray(sound)
        damaged[at] ^= 1 << (at % 8)
        path.write_bytes(damaged)
        try:
            read_npz(path)
        except InputError:
            refused += 1
    assert refused > len(sound) // 2


@given(JSON)
def test_canonical_json_is_json(value: object) -> None:
    assert json.loads(canonical_json(value)) == value


def test_canonical_json_has_no_nan() -> None:
    with pytest.raises(ValueError, match="not JSON compliant"):
        canonical_json({"a": float("nan")})
