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
from gvpipe.core.types import Float, PairMatch, Rejected
from gvpipe.dataset import Dataset
from gvpipe.pairing import match_pairs, options_from
from gvpipe.records import Body, CandidateRow, OverlapBody, OverlapRow
from gvpipe.stages.contract import Context, Outcome

SECTIONS = ("cameras", "robots", "match", "overlap", "seed")
BODY = OverlapBody

Arrays = dict[str, NDArray[Any]]


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
    with context.progress("histograms", len(images)) as ticker:
        rows = []
        for image in images:
            rows.append(ground_histogram(dataset.view(image)))
            ticker.advance()
    histograms = np.array(rows).reshape(-1, BINS)
    meetings = list(_meetings(config, dataset, dict(zip(images, histograms, strict=True))))
    pairs = [pair for meeting in meetings for pair in meeting.pairs]
    steps = len({image for pair in pairs for image in pair}) + len(pairs)
    with context.progress("validate", steps) as ticker:
        verdicts = match_pairs(
            dataset,
            pairs,
            options_from(config),
            seed=config.seed,
            jobs=context.jobs,
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
            _row(pair, candidate.distance, verdict)
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


def _meetings(config: Config, dataset: Dataset, histograms: dict[str, Float]) -> Iterator[_Meeting]:
    """Rank the pictures of every two robots."""
    for a, b in combinations(dataset.robots, 2):
        ids_a = [entry.image_id for entry in dataset.robots[a]]
        ids_b = [entry.image_id for entry in dataset.robots[b]]
        of_a = np.array([histograms[i] for i in ids_a]).reshape(-1, BINS)
        of_b = np.array([histograms[i] for i in ids_b]).reshape(-1, BINS)
        distances = {name: distance(of_a, of_b) for name, distance in DISTANCES.items()}
        candidates = candidate_pairs(distances[config.overlap.distance], config.overlap.threshold)
        pairs = [(ids_a[c.i], ids_b[c.j]) for c in candidates]
        yield _Meeting((a, b), dict(distances), candidates, pairs)


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
