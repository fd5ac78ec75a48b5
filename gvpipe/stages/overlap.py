"""Pictures of different robots that show the same ground: by histograms, then by homography."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gvpipe.artefacts import write_npz
from gvpipe.config import Config
from gvpipe.core.candidates import Candidate, candidate_pairs
from gvpipe.core.histogram import BINS, DISTANCES, ground_histogram
from gvpipe.core.signature import Signature, common_ground, expected_overlaps, ground_signature
from gvpipe.core.types import Float, PairMatch, Rejected
from gvpipe.dataset import Dataset
from gvpipe.errors import InputError
from gvpipe.pairing import match_pairs, options_from
from gvpipe.parallel import Crashed, Workers
from gvpipe.records import Body, CandidateRow, OverlapBody, OverlapRow
from gvpipe.stages.contract import Context, Outcome

SECTIONS = ("cameras", "robots", "match", "overlap", "seed")
BODY = OverlapBody

MIN_COMMON_GROUND = 0.08
"""Share of either picture's ground that both must see for an overlap to count."""

Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class _Look:
    """What one picture's ground looks like."""

    histogram: Float
    signature: Signature


@dataclass(frozen=True)
class _Meeting:
    """Candidates between two robots."""

    robots: tuple[str, str]
    distances: Arrays
    candidates: list[Candidate]
    pairs: list[tuple[str, str]]


def needs(config: Config) -> tuple[type[Body], ...]:
    """Read nothing but pictures."""
    return ()


def run(context: Context) -> Outcome[OverlapBody, Arrays]:
    """Rank pairs of pictures by histogram distance, validate the likely ones."""
    config, dataset = context.config, context.dataset
    images = [entry.image_id for entry in dataset.entries]
    looks: dict[str, _Look] = {}
    with (
        context.progress("describe", len(images)) as ticker,
        Workers(dataset, context.jobs) as workers,
    ):
        for image, look in zip(images, workers.map(_look, images), strict=True):
            if isinstance(look, Crashed):
                raise InputError(f"{image}: the worker process died twice on it")
            looks[image] = look
            ticker.advance()
    histograms = np.array([looks[image].histogram for image in images]).reshape(-1, BINS)
    meetings = list(_meetings(config, dataset, looks))
    pairs = [pair for meeting in meetings for pair in meeting.pairs]
    steps = len({image for pair in pairs for image in pair}) + len(pairs)
    with context.progress("validate", steps) as ticker:
        verdicts = match_pairs(
            dataset,
            pairs,
            options_from(config),
            seed=config.seed,
            jobs=context.jobs,
            checkpoints=context.checkpoints,
            on_step=ticker.advance,
        )
        found = [(meeting, [next(verdicts) for _ in meeting.pairs]) for meeting in meetings]
    arrays: Arrays = {"histograms": histograms, "image_ids": np.array(images, dtype=np.str_)}
    overlaps = []
    for meeting, results in found:
        name = "-".join(meeting.robots)
        arrays |= {f"{name}/{key}": matrix for key, matrix in meeting.distances.items()}
        for k, verdict in enumerate(results):
            if isinstance(verdict, PairMatch):
                arrays[f"{name}/{k}/points_i"] = verdict.points_i
                arrays[f"{name}/{k}/points_j"] = verdict.points_j
        candidates = tuple(
            _row(pair, candidate.distance, _sharing(pair, verdict, looks))
            for pair, candidate, verdict in zip(
                meeting.pairs, meeting.candidates, results, strict=True
            )
        )
        overlaps.append(OverlapRow(robots=meeting.robots, candidates=candidates))
    summary = tuple(
        (
            " - ".join(row.robots),
            f"{sum(c.validated for c in row.candidates)} of {len(row.candidates)} "
            "candidates validated",
        )
        for row in overlaps
    )
    return Outcome(OverlapBody(overlaps=tuple(overlaps)), arrays, summary=summary)


def write(outcome: Outcome[OverlapBody, Arrays], folder: Path) -> None:
    """Write histograms, distance matrices and inlier pixels."""
    write_npz(folder / "overlap.npz", outcome.payload)


def _look(dataset: Dataset, image: str) -> _Look:
    """Describe one picture."""
    view = dataset.view(image)
    return _Look(ground_histogram(view), ground_signature(view))


def _meetings(config: Config, dataset: Dataset, looks: dict[str, _Look]) -> Iterator[_Meeting]:
    """Rank the pictures of every two robots."""
    settings = config.overlap
    for a, b in combinations(dataset.robots, 2):
        ids_a = [entry.image_id for entry in dataset.robots[a]]
        ids_b = [entry.image_id for entry in dataset.robots[b]]
        of_a = np.array([looks[i].histogram for i in ids_a]).reshape(-1, BINS)
        of_b = np.array([looks[i].histogram for i in ids_b]).reshape(-1, BINS)
        distances = {name: distance(of_a, of_b) for name, distance in DISTANCES.items()}
        expected = expected_overlaps(
            [looks[i].signature for i in ids_a], [looks[i].signature for i in ids_b]
        )
        candidates = candidate_pairs(distances[settings.distance], settings.threshold, expected)
        pairs = [(ids_a[c.i], ids_b[c.j]) for c in candidates]
        yield _Meeting((a, b), dict(distances), candidates, pairs)


def _sharing(
    pair: tuple[str, str], verdict: PairMatch | Rejected, looks: dict[str, _Look]
) -> PairMatch | Rejected:
    """Reject a pair whose pictures hardly share any ground: it would join two maps by an edge."""
    if isinstance(verdict, Rejected):
        return verdict
    i, j = (looks[image].signature for image in pair)
    share = common_ground(i, j, verdict.overhead_j_from_i)
    if share >= MIN_COMMON_GROUND:
        return verdict
    return Rejected(
        f"the pictures share {share:.1%} of their ground, {MIN_COMMON_GROUND:.0%} are needed",
        verdict.candidates,
        verdict.trials,
        len(verdict.points_i),
    )


def _row(pair: tuple[str, str], distance: float, verdict: PairMatch | Rejected) -> CandidateRow:
    image_i, image_j = pair
    if isinstance(verdict, Rejected):
        return CandidateRow(
            image_i=image_i,
            image_j=image_j,
            distance=distance,
            validated=False,
            reason=verdict.reason,
            inliers=verdict.inliers,
        )
    return CandidateRow(
        image_i=image_i,
        image_j=image_j,
        distance=distance,
        validated=True,
        inliers=len(verdict.points_i),
        H=verdict.homography,
    )
