"""All robots on one metric map; trajectories and the location graph."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from gvpipe.config import Config
from gvpipe.core.geometry.pose import mount_of, yaw_tilt_roll
from gvpipe.core.slam.links import Link, link_kind
from gvpipe.core.slam.location_graph import MapOptions, MapResult, build_map
from gvpipe.core.slam.loops import gap_candidates, loop_candidates, without_bridges
from gvpipe.core.types import Camera, Float, PairMatch, Pose
from gvpipe.dataset import Dataset, ImageEntry
from gvpipe.errors import InputError
from gvpipe.records import (
    Body,
    ClosingRow,
    EdgeRow,
    MatchBody,
    OverlapBody,
    OverlapRow,
    PoseRow,
    RejectedEdgeRow,
    SlamBody,
    UnregisteredRow,
)
from gvpipe.stages.contract import Context, Outcome, shortened
from gvpipe.stages.pairing import count_steps, match_pairs
from gvpipe.stages.slam_control import control_points, control_rows, control_summary
from gvpipe.stages.slam_files import SlamEvidence, write_files

SECTIONS = ("cameras", "robots", "match", "overlap", "slam", "seed")
BODY = SlamBody
PARALLEL = "processes"

LOOP_ROUNDS = 2
"""Searches for more links: the second sees the map that the first one's loops have mended."""

LOOPS_PER_IMAGE = 6
"""New links tried an image and round: more hardly add to the accuracy, and each costs a match."""

MIN_SHARED_GROUND = 0.15
"""Share of its ground a picture must have in common with another for the pair to be tried."""

MAX_GAP = 3
"""Pictures of a robot at most this far apart in its sequence are tried across a gap."""

MAX_STRIDE = 2
"""And at most this far to confirm a link that nothing else does: were it wrong, the map on either
side would look sound, and show no common ground."""


def needs(config: Config) -> tuple[type[Body], ...]:
    """Read homographies, unless every robot's poses are known; one robot meets no other."""
    if all(robot.poses is not None for robot in config.robots.values()):
        return ()
    return (MatchBody,) if len(config.robots) == 1 else (MatchBody, OverlapBody)


def run(context: Context) -> Outcome[SlamBody, SlamEvidence]:
    """Build the map from matches, or take the known poses."""
    dataset = context.dataset
    if needs(context.config):
        body, evidence = _mapped(context)
        rests_on = ("edges", f"{len(body.edges)} used, {len(body.rejected_edges)} rejected")
    else:
        body, evidence = _known(dataset), SlamEvidence(dataset)
        rests_on = ("poses", "known, taken from the files as they are")
    registered = len(body.poses)
    summary = (
        ("registered", f"{registered} of {len(dataset.entries)} images"),
        ("maps", str(body.components)),
        rests_on,
        *(control_summary(body)),
        *shortened([(f"not on a map: {r.image}", r.reason) for r in body.unregistered], 5),
    )
    why = "no image could be linked to another" if registered < 2 else None
    if len(dataset.entries) == 1 and registered == 1:
        why = None
    return Outcome(body, evidence, no_result=why, summary=summary)


def write(outcome: Outcome[SlamBody, SlamEvidence], folder: Path) -> None:
    """Write the map in the formats of other programs, and the drawn location graph."""
    write_files(outcome.body, outcome.payload, folder)


def _known(dataset: Dataset) -> SlamBody:
    """Take known poses as they are."""
    rows = tuple(
        _pose_row(entry, dataset.poses[entry.image_id], np.zeros((6, 6)), 0)
        for entry in dataset.entries
    )
    return SlamBody(reference=None, poses=rows, edges=(), components=1, unregistered=())


def _mapped(context: Context) -> tuple[SlamBody, SlamEvidence]:
    """Adjust all cameras over the plane; look for more links where the map shows common ground."""
    entries = {entry.image_id: entry for entry in context.dataset.entries}
    reference = context.config.slam.reference or next(iter(entries))
    cameras = {image: entry.camera for image, entry in entries.items()}
    mounts = {image: entry.mount for image, entry in entries.items()}

    settings = context.config.slam
    options = MapOptions(
        tilt_sigma=float(np.radians(settings.tilt_sigma_deg)),
        roll_sigma=float(np.radians(settings.roll_sigma_deg)),
        scale_sigma=settings.scale_sigma,
        height_sigma=settings.height_sigma,
    )
    control = control_points(context.config, context.dataset)

    def adjusted(links: list[Link]) -> MapResult:
        return build_map(cameras, mounts, list(entries), links, reference, options, control)

    links = [*_matched(context), *_overlapping(context)]
    result = adjusted(links)
    # a pair whose link turned out wrong may be matched once more where that could bridge a gap
    tried = _tried(context) - {
        (link.image_i, link.image_j)
        for link, judged in zip(links, result.links, strict=True)
        if not judged.kept and judged.residual_m is None
    }

    def found(pairs: list[tuple[str, str]]) -> list[Link]:
        tried.update(pairs)
        return list(_searched(context, pairs)) if pairs else []

    def grown(links: list[Link], result: MapResult) -> tuple[list[Link], MapResult]:
        for _ in range(LOOP_ROUNDS):
            more = found(_proposed(cameras, list(entries), result, tried))
            if not more:
                break
            links = [*links, *more]
            result = adjusted(links)
        return links, result

    if settings.loops:
        links, result = grown(links, result)
        confirming = found(_unconfirmed(list(entries), links, result, tried))
        if confirming:
            both = adjusted([*links, *confirming])
            # distant pairs that agree add noise, and no more than their word
            if not result.confirmed_by(both):
                links, result = grown([*links, *confirming], both)
    if settings.control and not any(ground.fixed for ground in result.ground):
        raise InputError("slam.control: no map shows two different points of it")
    kept = tuple(link for link, x in zip(links, result.links, strict=True) if x.kept)
    evidence = SlamEvidence(context.dataset, kept, result.ground)
    body = _body(reference, entries, links, result)
    return body.model_copy(update={"control": control_rows(control, cameras, result)}), evidence


def _tried(context: Context) -> set[tuple[str, str]]:
    """List the pairs that were matched or rejected before."""
    pairs = {(row.image_i, row.image_j) for row in context.artefact(MatchBody).body.pairs}
    for row in _overlaps(context):
        pairs |= {(c.image_i, c.image_j) for c in row.candidates}
    return pairs


def _overlaps(context: Context) -> tuple[OverlapRow, ...]:
    """Overlaps of each two robots."""
    if OverlapBody not in needs(context.config):
        return ()
    return context.artefact(OverlapBody).body.overlaps


def _proposed(
    cameras: dict[str, Camera], order: list[str], result: MapResult, tried: set[tuple[str, str]]
) -> list[tuple[str, str]]:
    """Pairs whose ground overlaps on the map, and pairs that may bridge a gap in a chain."""
    pairs = []
    for component in result.components:
        poses = {image: result.poses[image].map_from_camera for image in component}
        pairs += loop_candidates(
            cameras, poses, tried, min_share=MIN_SHARED_GROUND, max_per_image=LOOPS_PER_IMAGE
        )
    pairs += gap_candidates(order, result.components, tried, max_gap=MAX_GAP)
    return list(dict.fromkeys((c.image_i, c.image_j) for c in pairs))


def _unconfirmed(
    order: list[str], links: list[Link], result: MapResult, tried: set[tuple[str, str]]
) -> list[tuple[str, str]]:
    """Pairs that may confirm what only one link holds together."""
    judged = zip(links, result.links, strict=True)
    kept = {(link.image_i, link.image_j) for link, verdict in judged if verdict.kept}
    parts = without_bridges(order, sorted(kept))
    pairs = gap_candidates(order, parts, tried, max_gap=MAX_STRIDE)
    return [(c.image_i, c.image_j) for c in pairs]


def _searched(context: Context, pairs: list[tuple[str, str]]) -> Iterator[Link]:
    """Match proposed pairs and yield the links found."""
    place = _places(context)
    with context.progress("loops", count_steps(pairs)) as ticker:
        verdicts = match_pairs(context, pairs, ticker.advance)
        for pair, verdict in zip(pairs, verdicts, strict=True):
            if isinstance(verdict, PairMatch):
                kind = link_kind(place, *pair)
                yield Link(*pair, kind, verdict.homography, verdict.points_i, verdict.points_j)


def _places(context: Context) -> dict[str, int]:
    """Return the place of each image, robot by robot."""
    return {entry.image_id: k for k, entry in enumerate(context.dataset.entries)}


def _matched(context: Context) -> Iterator[Link]:
    """Turn matched pairs into links."""
    match = context.artefact(MatchBody)
    points = match.arrays("match.npz")
    place = _places(context)
    for k, row in enumerate(match.body.pairs):
        if row.H is not None:
            pair = row.image_i, row.image_j
            kind = link_kind(place, *pair)
            yield Link(*pair, kind, row.H, points[f"{k}/points_i"], points[f"{k}/points_j"])


def _overlapping(context: Context) -> Iterator[Link]:
    """Turn validated overlaps into links."""
    if not _overlaps(context):
        return
    overlap = context.artefact(OverlapBody)
    points = overlap.arrays("overlap.npz")
    for row in overlap.body.overlaps:
        name = "-".join(row.robots)
        for k, candidate in enumerate(row.candidates):
            if candidate.H is not None:
                yield Link(
                    candidate.image_i,
                    candidate.image_j,
                    "overlap",
                    candidate.H,
                    points[f"{name}/{k}/points_i"],
                    points[f"{name}/{k}/points_j"],
                )


def _body(
    reference: str, entries: dict[str, ImageEntry], links: list[Link], result: MapResult
) -> SlamBody:
    """Put the map into the file's terms."""
    judged = list(zip(links, result.links, strict=True))
    return SlamBody(
        reference=reference,
        poses=tuple(
            _pose_row(entries[image], posed.map_from_camera, posed.covariance, posed.component)
            for image, posed in result.poses.items()
        ),
        edges=tuple(
            EdgeRow(
                image_i=link.image_i,
                image_j=link.image_j,
                kind=link.kind,
                residual_m=verdict.residual_m,
            )
            for link, verdict in judged
            if verdict.kept and verdict.residual_m is not None
        ),
        rejected_edges=tuple(
            RejectedEdgeRow(
                image_i=link.image_i,
                image_j=link.image_j,
                kind=link.kind,
                reason=verdict.reason,
            )
            for link, verdict in judged
            if not verdict.kept
        ),
        closing=tuple(
            ClosingRow(
                image_i=closure.image_i,
                image_j=closure.image_j,
                concatenated_m=closure.concatenated_m,
                adjusted_m=closure.adjusted_m,
            )
            for closure in result.closures
        ),
        components=len(result.components),
        unregistered=tuple(
            UnregisteredRow(image=image, reason=reason) for image, reason in result.unregistered
        ),
    )


def _pose_row(
    entry: ImageEntry, map_from_camera: Pose, covariance: Float, component: int
) -> PoseRow:
    yaw, tilt, roll = yaw_tilt_roll(map_from_camera.rotation)
    x, y, _ = map_from_camera.translation
    return PoseRow(
        image=entry.image_id,
        robot=entry.robot,
        component=component,
        R=map_from_camera.rotation,
        t=map_from_camera.translation,
        x=float(x),
        y=float(y),
        yaw_deg=float(np.degrees(yaw)),
        tilt_deg=float(np.degrees(tilt)),
        roll_deg=float(np.degrees(roll)),
        height_m=mount_of(map_from_camera).height,
        covariance=covariance,
    )
