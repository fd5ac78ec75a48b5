"""All robots on one metric map; trajectories and the location graph."""

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np

from gvpipe.config import Config
from gvpipe.core.links import Link
from gvpipe.core.location_graph import MapOptions, MapResult, build_map
from gvpipe.core.pose import mount_of, yaw_tilt_roll
from gvpipe.core.types import Float, Pose
from gvpipe.dataset import Dataset, ImageEntry
from gvpipe.formats.tum import format_tum
from gvpipe.records import (
    Body,
    ClosingRow,
    EdgeRow,
    MatchBody,
    OverlapBody,
    PoseRow,
    RejectedEdgeRow,
    SlamBody,
    UnregisteredRow,
)
from gvpipe.stages.contract import Context, Outcome

SECTIONS = ("cameras", "robots", "match", "overlap", "slam", "seed")
BODY = SlamBody


def needs(config: Config) -> tuple[type[Body], ...]:
    """Read homographies, unless every robot's poses are known."""
    known = all(robot.poses is not None for robot in config.robots.values())
    return () if known else (MatchBody, OverlapBody)


def run(context: Context) -> Outcome[SlamBody, Dataset]:
    """Build the map from matches, or take the known poses."""
    dataset = context.dataset
    body = _mapped(context) if needs(context.config) else _known(dataset)
    registered = len(body.poses)
    summary = (
        ("registered", f"{registered} of {len(dataset.entries)} images"),
        ("maps", str(body.components)),
        ("edges", f"{len(body.edges)} used, {len(body.rejected_edges)} rejected"),
        *((f"not on a map: {row.image}", row.reason) for row in body.unregistered[:5]),
    )
    why = "no image could be linked to another" if registered < 2 else None
    if len(dataset.entries) == 1 and registered == 1:
        why = None
    return Outcome(body, dataset, no_result=why, summary=summary)


def write(outcome: Outcome[SlamBody, Dataset], folder: Path) -> None:
    """Write one trajectory a robot, and the drawn location graph."""
    poses = {row.image: Pose(row.R, row.t) for row in outcome.body.poses}
    for robot, entries in outcome.payload.robots.items():
        stamped = [
            (float(k), poses[entry.image_id])
            for k, entry in enumerate(entries)
            if entry.image_id in poses
        ]
        (folder / f"{robot}.tum").write_text(format_tum(stamped), encoding="utf-8")


def _known(dataset: Dataset) -> SlamBody:
    """Take known poses as they are."""
    rows = tuple(
        _pose_row(entry, dataset.poses[entry.image_id], np.zeros((6, 6)), 0)
        for entry in dataset.entries
    )
    return SlamBody(reference=None, poses=rows, edges=(), components=1, unregistered=())


def _mapped(context: Context) -> SlamBody:
    """Adjust all cameras over the plane."""
    entries = {entry.image_id: entry for entry in context.dataset.entries}
    reference = context.config.slam.reference or next(iter(entries))
    links = [*_matched(context), *_overlapping(context)]
    result = build_map(
        {image: entry.camera for image, entry in entries.items()},
        {image: entry.mount for image, entry in entries.items()},
        list(entries),
        links,
        reference,
        MapOptions(),
    )
    return _body(reference, entries, links, result)


def _matched(context: Context) -> Iterator[Link]:
    """Turn matched pairs into links."""
    match = context.artefact(MatchBody)
    points = match.arrays("match.npz")
    following = {
        (a.image_id, b.image_id)
        for robot in context.dataset.robots.values()
        for a, b in pairwise(robot)
    }
    for k, row in enumerate(match.body.pairs):
        if row.H is None:
            continue
        pair = row.image_i, row.image_j
        same = pair[0].split("/")[0] == pair[1].split("/")[0]
        odometry = pair in following or pair[::-1] in following
        kind = "odometry" if odometry else "loop" if same else "overlap"
        yield Link(*pair, kind, row.H, points[f"{k}/points_i"], points[f"{k}/points_j"])


def _overlapping(context: Context) -> Iterator[Link]:
    """Turn validated overlaps into links."""
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
                adjusted_m=closure.optimised_m,
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
