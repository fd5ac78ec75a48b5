"""Checkpoints give back exactly what was kept, or nothing."""

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from gvpipe.checkpoint import Checkpoints
from gvpipe.core.reconstruct.levelset import Evolution
from gvpipe.core.types import PairMatch, Rejected
from gvpipe.errors import OutputError

MATCH = PairMatch(
    homography=np.random.default_rng(0).normal(size=(3, 3)),
    homography_initial=np.eye(3),
    overhead_j_from_i=np.asfortranarray(np.arange(9.0).reshape(3, 3)),
    points_i=np.random.default_rng(1).normal(size=(7, 2)),
    points_j=np.empty((0, 2)),
    error_px=0.1 + 0.2,
    tilt_i=np.float64(1) / 3,
    tilt_j=5e-324,
    candidates=2**40,
    trials=np.int64(3),
)
EVOLUTION = Evolution(
    np.linspace(-1, 1, 24, dtype=np.float32).reshape(2, 3, 4), [(0, 1.5), (10, 0.1)], 10, True
)


@pytest.mark.parametrize("record", [MATCH, Rejected("too few ±", 3, 2, 1), EVOLUTION])
def test_what_is_kept_comes_back_bit_by_bit(tmp_path: Path, record: object) -> None:
    key = Checkpoints(tmp_path / "kept").key("pair", 1)
    Checkpoints(tmp_path / "kept").save(key, record)
    later = Checkpoints(tmp_path / "kept")
    found = later.load(key, PairMatch, Rejected, Evolution)
    assert type(found) is type(record)
    assert later.reused == 1
    for field in fields(type(record)):
        had, have = getattr(record, field.name), getattr(found, field.name)
        if isinstance(had, np.ndarray):
            assert (had.dtype, had.shape) == (have.dtype, have.shape)
            assert had.flags.f_contiguous == have.flags.f_contiguous
            assert had.tobytes() == have.tobytes()
        else:
            assert [tuple(x) for x in have] == had if isinstance(had, list) else have == had


def test_keys_tell_everything_apart(tmp_path: Path) -> None:
    kept = Checkpoints(tmp_path)
    parts = [("a", 1), ("a", 2), ("a", 1.0), ("a", "1"), (("a", 1),), ("a",), ()]
    assert len({kept.key(*p) for p in parts}) == len(parts)
    assert kept.key("a", 1) == Checkpoints(tmp_path / "elsewhere").key("a", 1)


def test_damaged_checkpoints_are_as_if_never_made(tmp_path: Path) -> None:
    kept = Checkpoints(tmp_path / "kept")
    key, other = kept.key(1), kept.key(2)
    kept.save(key, MATCH)
    path = tmp_path / "kept" / key
    content = path.read_bytes()
    path.rename(tmp_path / "kept" / other)
    assert kept.load(other, PairMatch) is None  # somebody else's
    for damaged in (b"", content[:31], content[:-1], content[:100] + b"?" + content[101:]):
        path.write_bytes(damaged)
        assert kept.load(key, PairMatch) is None
    path.write_bytes(content)
    assert kept.load(key, Rejected) is None
    assert kept.load(key, PairMatch) is not None
    path.unlink()
    path.mkdir()
    assert kept.load(key, PairMatch) is None


def test_sweeping_leaves_nothing(tmp_path: Path) -> None:
    kept = Checkpoints(tmp_path / "kept")
    kept.sweep()
    kept.save(kept.key(1), MATCH)
    kept.sweep()
    assert not list(tmp_path.iterdir())


def test_checkpoints_are_not_written_through_links(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "kept").symlink_to(tmp_path / "elsewhere")
    kept = Checkpoints(tmp_path / "kept")
    with pytest.raises(OutputError, match="symbolic link"):
        kept.save(kept.key(1), MATCH)
    kept.sweep()
    assert (tmp_path / "elsewhere").is_dir()
