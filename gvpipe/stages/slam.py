"""All robots on one metric map; trajectories and the location graph."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from gvpipe.config import Config, SlamConfig
from gvpipe.core.geometry.pose import mount_of, yaw_tilt_roll
from gvpipe.core.slam.links import Link
from gvpipe.core.slam.location_graph import MapOptions, MapResult, build_map
from gvpipe.core.types import Float, Pose
from gvpipe.dataset import Dataset, ImageEntry
from gvpipe.errors import InputError
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
from gvpipe.stages.contract import Context, Outcome, shortened
from gvpipe.stages.slam_control import control_points, control_rows, control_summary
from gvpipe.stages.slam_files import SlamEvidence, write_files
from gvpipe.stages.slam_links import LinkSearch

SECTIONS = ("cameras", "robots", "match", "overlap", "slam", "seed")
BODY = SlamBody
PARALLEL = "processes"

LOOP_ROUNDS = 2
"""Searches for more links: the second sees the map that the first one's loops have mended."""


def needs(config: Config) -> tuple[type[Body], ...]:
    """Read homographies, unless every robot's poses are known; one robot meets no other."""
    if all(robot.poses is not None for robot in config.robots.values()):
        return ()
    return (MatchBody,) if len(config.robots) == 1 else (MatchBody, OverlapBody)


def run(context: Context) -> Outcome[SlamBody, SlamEvidence]:
    """Build the map from matches, or take the known poses."""
    dataset = context.dataset
    if needs(context.config):  # some poses are not known
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
        *control_summary(body),
        *shortened([(f"not on a map: {r.image}", r.reason) for r in body.unregistered], 5),
    )
    alone = registered < min(2, len(dataset.entries))
    why = "no image could be linked to another" if alone else None
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
    settings = context.config.slam
    entries = {entry.image_id: entry for entry in context.dataset.entries}
    reference = settings.reference or next(iter(entries))
    cameras = {image: entry.camera for image, entry in entries.items()}
    mounts = {image: entry.mount for image, entry in entries.items()}
    options = _options(settings)
    control = control_points(context.config, context.dataset)

    def adjusted(links: list[Link]) -> MapResult:
        return build_map(cameras, mounts, list(entries), links, reference, options, control)

    search = LinkSearch(context)
    links = search.given()
    result = adjusted(links)
    search.allow_again(links, result)
    if settings.loops:
        links, result = _grown(search, adjusted, links, result)
        confirming = search.confirming(links, result)
        if confirming:
            both = adjusted([*links, *confirming])
            # distant pairs that agree add noise, and no more than their word
            if not result.confirmed_by(both):
                links, result = _grown(search, adjusted, [*links, *confirming], both)
    if settings.control and not any(ground.fixed for ground in result.ground):
        raise InputError("slam.control: no map shows two different points of it")
    kept = tuple(link for link, x in zip(links, result.links, strict=True) if x.kept)
    evidence = SlamEvidence(context.dataset, kept, result.ground)
    body = _body(reference, entries, links, result)
    return body.model_copy(update={"control": control_rows(control, cameras, result)}), evidence


def _options(settings: SlamConfig) -> MapOptions:
    """Priors in radians."""
    return MapOptions(
        tilt_sigma=float(np.radians(settings.tilt_sigma_deg)),
        roll_sigma=float(np.radians(settings.roll_sigma_deg)),
        scale_sigma=settings.scale_sigma,
        height_sigma=settings.height_sigma,
    )


def _grown(
    search: LinkSearch,
    adjusted: Callable[[list[Link]], MapResult],
    links: list[Link],
    result: MapResult,
) -> tuple[list[Link], MapResult]:
    """Add links where the map suggests them, as long as there are some."""
    for _ in range(LOOP_ROUNDS):
        more = search.suggested(result)
        if not more:
            break
        links = [*links, *more]
        result = adjusted(links)
    return links, result


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
