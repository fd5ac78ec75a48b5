"""Ground homographies between pairs of pictures."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np

from gvpipe.artefacts import write_npz
from gvpipe.config import Config
from gvpipe.core.types import Float, PairMatch, Rejected
from gvpipe.dataset import Dataset
from gvpipe.records import Body, MatchBody, PairRow
from gvpipe.stages.contract import Context, Outcome, shortened
from gvpipe.stages.pairing import count_steps, match_pairs

SECTIONS = ("cameras", "robots", "match", "seed")
BODY = MatchBody
PARALLEL = "processes"


@dataclass(frozen=True)
class MatchPoints:
    """Inlier pixels of each pair, (n, 2) float64; empty where a pair was rejected."""

    points_i: tuple[Float, ...]
    points_j: tuple[Float, ...]


def needs(config: Config) -> tuple[type[Body], ...]:
    """Read nothing but pictures."""
    return ()


def planned_pairs(config: Config, dataset: Dataset) -> list[tuple[str, str]]:
    """List the pairs the configuration asks for, but for those of images that were skipped."""
    wanted = config.match.pairs
    if wanted == "consecutive":
        return [
            (a.image_id, b.image_id)
            for entries in dataset.robots.values()
            for a, b in pairwise(entries)
        ]
    if wanted == "exhaustive":
        return list(combinations([entry.image_id for entry in dataset.entries], 2))
    usable = {entry.image_id for entry in dataset.entries}
    return [(i, j) for i, j in wanted if i in usable and j in usable]


def run(context: Context) -> Outcome[MatchBody, MatchPoints]:
    """Match every planned pair."""
    pairs = planned_pairs(context.config, context.dataset)
    with context.progress("match", count_steps(pairs)) as ticker:
        verdicts = list(match_pairs(context, pairs, ticker.advance))
    rows = tuple(pair_row(*pair, verdict) for pair, verdict in zip(pairs, verdicts, strict=True))
    empty = np.empty((0, 2))
    points = MatchPoints(
        tuple(v.points_i if isinstance(v, PairMatch) else empty for v in verdicts),
        tuple(v.points_j if isinstance(v, PairMatch) else empty for v in verdicts),
    )
    matched = sum(row.status == "ok" for row in rows)
    return Outcome(
        MatchBody(pairs=rows),
        points,
        no_result=None if matched else _why_none(rows),
        summary=(
            ("pairs", f"{matched} of {len(rows)} matched"),
            *_unmatched(rows),
            *_rejections(rows),
        ),
    )


def write(outcome: Outcome[MatchBody, MatchPoints], folder: Path) -> None:
    """Write the inlier pixels."""
    arrays = {}
    for k, (points_i, points_j) in enumerate(
        zip(outcome.payload.points_i, outcome.payload.points_j, strict=True)
    ):
        arrays[f"{k}/points_i"] = points_i
        arrays[f"{k}/points_j"] = points_j
    write_npz(folder / "match.npz", arrays)


def pair_row(image_i: str, image_j: str, verdict: PairMatch | Rejected) -> PairRow:
    """Turn a verdict into its row of the file."""
    if isinstance(verdict, Rejected):
        return PairRow(
            image_i=image_i,
            image_j=image_j,
            status="rejected",
            reason=verdict.reason,
            probability=verdict.probability,
            inliers=verdict.inliers,
            candidates=verdict.candidates,
            trials=verdict.trials,
        )
    return PairRow(
        image_i=image_i,
        image_j=image_j,
        status="ok",
        probability=verdict.probability,
        H=verdict.homography,
        inliers=len(verdict.points_i),
        candidates=verdict.candidates,
        trials=verdict.trials,
        error_px=verdict.error_px,
        H_initial=verdict.homography_initial,
        overhead=verdict.overhead_j_from_i,
        tilt_i_deg=float(np.degrees(verdict.tilt_i)),
        tilt_j_deg=float(np.degrees(verdict.tilt_j)),
    )


def _why_none(rows: Iterable[PairRow]) -> str:
    first = next((row for row in rows), None)
    if first is None:
        return "there is no pair of images to match"
    return f"no pair matched; the first, {first.image_i} and {first.image_j}: {first.reason}"


def _unmatched(rows: Sequence[PairRow]) -> tuple[tuple[str, str], ...]:
    """Say which robots have none of their own pairs matched: a wrong key spoils all of them."""
    own: dict[str, list[bool]] = {}
    for row in rows:
        robot, other = (image.split("/", 1)[0] for image in (row.image_i, row.image_j))
        if robot == other:
            own.setdefault(robot, []).append(row.status == "ok")
    return tuple(
        (f"robots.{robot}", f"none of {len(ok)} pairs matched: are fx, tilt and height right?")
        for robot, ok in own.items()
        if len(ok) > 1 and not any(ok)
    )


def _rejections(rows: Iterable[PairRow]) -> tuple[tuple[str, str], ...]:
    rejected = [row for row in rows if row.status == "rejected"]
    said = [("rejected", f"{row.image_i} - {row.image_j}: {row.reason}") for row in rejected]
    return shortened(said, 5)
