"""Candidates of an overlap: which are tried, and which of those that match count."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest

from gvpipe.core.overlap.signature import Signature
from gvpipe.core.types import Camera, Float, Mount, PairMatch, Rejected
from gvpipe.stages import overlap_validation
from gvpipe.stages.overlap_validation import BATCH, ENOUGH, NOT_TRIED, Verdicts, validated

Pairs = Sequence[tuple[str, str]]

COUNT = 3 * BATCH
LOOK = Signature(
    Camera(320, 240, 270.0, 270.0, 159.5, 119.5),
    Mount(np.radians(45), 0.0, 0.6),
    np.empty((0, 2)),
    np.empty(0),
    np.empty((0, 128), np.float32),
)
MEETINGS = {(a, b): [(f"{a}/{k}", f"{b}/{k}") for k in range(COUNT)] for a, b in ("AB", "AC", "BC")}


def match(shift_m: float) -> PairMatch:
    """A match of two pictures taken so far apart, one behind the other."""
    j_from_i = np.eye(3)
    j_from_i[0, 2] = shift_m
    points: Float = np.zeros((9, 2))
    return PairMatch(np.eye(3), np.eye(3), j_from_i, points, points, 0.1, 0.8, 0.8, 9, 9)


def verdicts(
    monkeypatch: pytest.MonkeyPatch,
    validate: str,
    meant: Callable[[str, str], PairMatch | Rejected],
) -> tuple[dict[tuple[str, str], Verdicts], list[tuple[str, str]]]:
    """Validate all meetings, with the matcher's words put into its mouth; also what was tried."""
    tried: list[tuple[str, str]] = []

    def match_pairs(
        context: object, pairs: Pairs, on_step: Callable[[], object]
    ) -> Iterator[PairMatch | Rejected]:
        tried.extend(pairs)
        return (meant(i, j) for i, j in pairs)

    @contextmanager
    def progress(what: str, total: int) -> Iterator[SimpleNamespace]:
        yield SimpleNamespace(advance=lambda steps=1: None)

    monkeypatch.setattr(overlap_validation, "match_pairs", match_pairs)
    context = SimpleNamespace(
        config=SimpleNamespace(overlap=SimpleNamespace(validate=validate)), progress=progress
    )
    images = {image for pairs in MEETINGS.values() for pair in pairs for image in pair}
    found = validated(context, MEETINGS, dict.fromkeys(images, LOOK))  # type: ignore[arg-type]
    assert found.keys() == MEETINGS.keys()
    assert all(len(results) == COUNT for results in found.values())
    return found, tried


def matched(results: Verdicts) -> int:
    return sum(isinstance(verdict, PairMatch) for verdict in results)


def untried(results: Verdicts) -> int:
    return sum(isinstance(v, Rejected) and v.reason == NOT_TRIED for v in results)


def test_all_candidates_get_the_verdict_on_them(monkeypatch: pytest.MonkeyPatch) -> None:
    def meant(i: str, j: str) -> PairMatch | Rejected:
        return match(0.0) if i.startswith("A/1") else Rejected(f"{i} {j}")

    found, tried = verdicts(monkeypatch, "all", meant)
    assert sorted(tried) == sorted(pair for pairs in MEETINGS.values() for pair in pairs)
    for robots, pairs in MEETINGS.items():
        for (i, j), verdict in zip(pairs, found[robots], strict=True):
            assert isinstance(verdict, PairMatch) == i.startswith("A/1")
            if isinstance(verdict, Rejected):
                assert verdict.reason == f"{i} {j}"


def test_pictures_that_hardly_share_ground_do_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    near, _ = verdicts(monkeypatch, "all", lambda i, j: match(0.2))
    assert all(matched(results) == COUNT for results in near.values())
    far, _ = verdicts(monkeypatch, "all", lambda i, j: match(5.0))
    for results in far.values():
        assert matched(results) == 0
        assert isinstance(results[0], Rejected)
        assert "share 0.0% of their ground" in results[0].reason
        assert results[0].inliers == 9


def test_best_first_until_robots_are_joined_by_way_of_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def meant(i: str, j: str) -> PairMatch | Rejected:
        direct = {i[0], j[0]} == {"A", "C"}
        return Rejected("apart") if direct else match(0.0)

    found, tried = verdicts(monkeypatch, "first", meant)
    for results in found.values():
        assert untried(results) == COUNT - BATCH
        assert untried(results[:BATCH]) == 0
    assert len(tried) == 3 * BATCH


def test_robots_that_are_not_joined_have_all_their_candidates_tried(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    few = {(f"A/{k}", f"B/{k}") for k in range(ENOUGH - 1)}  # may be chance
    found, tried = verdicts(
        monkeypatch, "first", lambda i, j: match(0.0) if (i, j) in few else Rejected("apart")
    )
    assert len(tried) == 3 * COUNT
    assert {robots: matched(results) for robots, results in found.items()} == {
        ("A", "B"): ENOUGH - 1,
        ("A", "C"): 0,
        ("B", "C"): 0,
    }
    assert not any(untried(results) for results in found.values())
