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
from gvpipe.core.overlap.candidates import Candidate, candidate_pairs, shortlist
from gvpipe.core.overlap.histogram import BINS, DISTANCES, ground_histogram
from gvpipe.core.overlap.signature import (
    Signature,
    expected_overlap,
    ground_signature,
    no_signature,
)
from gvpipe.core.types import Float, PairMatch, Rejected
from gvpipe.dataset import Dataset
from gvpipe.formats.plots import curves_svg, heat_map
from gvpipe.formats.raster import png_bytes
from gvpipe.parallel import Crashed
from gvpipe.records import Body, CandidateRow, OverlapBody, OverlapRow, UnregisteredRow
from gvpipe.stages.contract import Context, Outcome
from gvpipe.stages.overlap_validation import validated

SECTIONS = ("cameras", "robots", "match", "overlap", "seed")
BODY = OverlapBody
PARALLEL = "processes"

MAX_SPOT_PAIRS = 20_000
"""Pairs of pictures whose spots are compared, about a minute: of more, those with the nearest
histograms."""

MAX_MATRIX = 4_000_000
"""Entries of a distance matrix up to which it is kept and drawn: 2,000 by 2,000 pictures."""

DIED_TWICE = "the worker process died twice on it"

Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class _Look:
    """What one picture's ground looks like."""

    histogram: Float
    signature: Signature


@dataclass(frozen=True)
class _Meeting:
    """Candidates between two robots; the distances are empty if their matrices are too large."""

    robots: tuple[str, str]
    images: tuple[list[str], list[str]]
    distances: Arrays
    candidates: list[Candidate]
    pairs: list[tuple[str, str]]


@dataclass(frozen=True)
class Findings:
    """What is written beside the JSON.

    Attributes
    ----------
    arrays : dict of str to array
        Of `overlap.npz`.
    figures : dict of str to bytes
        Diagrams by file name.
    """

    arrays: Arrays
    figures: dict[str, bytes]


def needs(config: Config) -> tuple[type[Body], ...]:
    """Read nothing but pictures."""
    return ()


def run(context: Context) -> Outcome[OverlapBody, Findings]:
    """Rank pairs of pictures by histogram distance, validate the likely ones."""
    config = context.config
    looks, left_out = _describe(context)
    histograms = np.array([look.histogram for look in looks.values()]).reshape(-1, BINS)
    meetings = list(_meetings(config, context.dataset, looks))
    found = validated(
        context,
        {meeting.robots: meeting.pairs for meeting in meetings},
        {image: look.signature for image, look in looks.items()},
    )
    arrays: Arrays = {"histograms": histograms, "image_ids": np.array(list(looks), dtype=np.str_)}
    overlaps = []
    figures: dict[str, bytes] = {}
    for meeting in meetings:
        verdicts = found[meeting.robots]
        name = "-".join(meeting.robots)
        figures |= _figures(meeting, config.overlap.distance)
        arrays |= {f"{name}/{key}": matrix for key, matrix in meeting.distances.items()}
        for k, verdict in enumerate(verdicts):
            if isinstance(verdict, PairMatch):
                arrays[f"{name}/{k}/points_i"] = verdict.points_i
                arrays[f"{name}/{k}/points_j"] = verdict.points_j
        candidates = tuple(
            _row(pair, candidate.distance, verdict)
            for pair, candidate, verdict in zip(
                meeting.pairs, meeting.candidates, verdicts, strict=True
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
    summary += tuple(("left out", f"{row.image}: {row.reason}") for row in left_out)
    body = OverlapBody(overlaps=tuple(overlaps), left_out=left_out)
    return Outcome(body, Findings(arrays, figures), summary=summary)


def write(outcome: Outcome[OverlapBody, Findings], folder: Path) -> None:
    """Write histograms, distance matrices, inlier pixels and the diagrams."""
    write_npz(folder / "overlap.npz", outcome.payload.arrays)
    for name, data in outcome.payload.figures.items():
        (folder / name).write_bytes(data)


def _describe(context: Context) -> tuple[dict[str, _Look], tuple[UnregisteredRow, ...]]:
    """Look at every picture; those on which the worker died twice are left out."""
    images = [entry.image_id for entry in context.dataset.entries]
    looks: dict[str, _Look] = {}
    left_out = []
    with context.progress("describe", len(images)) as ticker:
        for image, look in zip(images, context.workers.map(_look, images), strict=True):
            if isinstance(look, Crashed):
                left_out.append(UnregisteredRow(image=image, reason=DIED_TWICE))
            else:
                looks[image] = look
            ticker.advance()
    return looks, tuple(left_out)


def _look(dataset: Dataset, image: str) -> _Look:
    """Describe one picture; what a robot's own pictures share is not asked."""
    view = dataset.view(image)
    describe = ground_signature if len(dataset.robots) > 1 else no_signature
    return _Look(ground_histogram(view), describe(view))


def _meetings(config: Config, dataset: Dataset, looks: dict[str, _Look]) -> Iterator[_Meeting]:
    """Rank the pictures of every two robots."""
    settings = config.overlap
    for a, b in combinations(dataset.robots, 2):
        ids_a = [e.image_id for e in dataset.robots[a] if e.image_id in looks]
        ids_b = [e.image_id for e in dataset.robots[b] if e.image_id in looks]
        of_a = np.array([looks[i].histogram for i in ids_a]).reshape(-1, BINS)
        of_b = np.array([looks[i].histogram for i in ids_b]).reshape(-1, BINS)
        few = len(ids_a) * len(ids_b) <= MAX_MATRIX
        distances = {name: d(of_a, of_b) for name, d in DISTANCES.items()} if few else {}
        if len(ids_a) * len(ids_b) <= MAX_SPOT_PAIRS:
            i, j = (grid.ravel() for grid in np.indices((len(ids_a), len(ids_b))))
            near = distances[settings.distance].ravel()
        else:
            count = max(MAX_SPOT_PAIRS // (len(ids_a) + len(ids_b)), 1)
            i, j, near = shortlist(of_a, of_b, DISTANCES[settings.distance], count)
        signatures = [
            (looks[ids_a[m]].signature, looks[ids_b[n]].signature)
            for m, n in zip(i, j, strict=True)
        ]
        expected = np.array([expected_overlap(*pair) for pair in signatures])
        candidates = candidate_pairs(i, j, near, settings.threshold, expected)
        pairs = [(ids_a[c.i], ids_b[c.j]) for c in candidates]
        yield _Meeting((a, b), (ids_a, ids_b), distances, candidates, pairs)


def _figures(meeting: _Meeting, distance: str) -> dict[str, bytes]:
    """Draw the distances of the first candidate's picture to all of the other robot's."""
    if not meeting.distances or not meeting.distances[distance].size:
        return {}
    name = "-".join(meeting.robots)
    row = meeting.candidates[0].i if meeting.candidates else 0
    curves = {key: matrix[row] for key, matrix in meeting.distances.items()}
    title = f"Histogram distance of {meeting.images[0][row]} to all images of {meeting.robots[1]}"
    label = f"image of {meeting.robots[1]}; each curve relative to its largest value"
    svg = curves_svg(title, label, meeting.images[1], curves)
    return {
        f"curves_{name}.svg": svg.encode(),
        f"matrix_{name}.png": png_bytes(heat_map(meeting.distances[distance], *meeting.robots)),
    }


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
