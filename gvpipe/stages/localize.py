"""Relative pose of two views from their ground homography."""

from pathlib import Path

import numpy as np

from gvpipe.config import Config
from gvpipe.core.geometry.ground import plane_normal
from gvpipe.core.geometry.pose import yaw_tilt_roll
from gvpipe.core.geometry.relative_pose import (
    RelativePose,
    choose,
    closed_form,
    decompose,
    ground_motion,
    location,
    motion_covariance,
    robot_motion,
)
from gvpipe.core.slam.correlation import shared_errors
from gvpipe.core.types import Float
from gvpipe.dataset import ImageEntry
from gvpipe.records import Body, GammaRow, LocalizeBody, MatchBody, MotionFields, MotionRow, PairRow
from gvpipe.stages.contract import Context, Outcome, shortened

SECTIONS = ("cameras", "robots", "match", "seed")
BODY = LocalizeBody
PARALLEL = None


def needs(config: Config) -> tuple[type[Body], ...]:
    """Read the homographies."""
    return (MatchBody,)


def run(context: Context) -> Outcome[LocalizeBody, None]:
    """Decompose the homography of every matched pair."""
    match = context.artefact(MatchBody)
    points = match.arrays("match.npz")
    entries = {entry.image_id: entry for entry in context.dataset.entries}
    matched = [
        (row, points[f"{k}/points_i"], points[f"{k}/points_j"])
        for k, row in enumerate(match.body.pairs)
        if row.status == "ok"
    ]
    # one pair says little about it, and all come from the same matcher
    shared = shared_errors((np.asarray(row.H), p, q) for row, p, q in matched)
    motions = tuple(
        _motion(row, entries[row.image_i], entries[row.image_j], p, q, shared)
        for row, p, q in matched
    )
    rows = [
        (f"{m.image_i} - {m.image_j}", f"{m.distance_m:.3f} m, turned {m.yaw_deg:.1f}°")
        for m in motions
    ]
    return Outcome(
        LocalizeBody(motions=motions),
        None,
        no_result=None if motions else f"no pair was matched: {match.header.reason}",
        summary=(("motions", str(len(motions))), *shortened(rows, 12)),
    )


def write(outcome: Outcome[LocalizeBody, None], folder: Path) -> None:
    """Write nothing beside the JSON."""


def _motion(
    row: PairRow,
    entry_i: ImageEntry,
    entry_j: ImageEntry,
    points_i: Float,
    points_j: Float,
    shared: float,
) -> MotionRow:
    """Estimate one pair's motion both ways."""
    motion = ground_motion(np.asarray(row.H), entry_i.camera, entry_j.camera)
    height = entry_i.mount.height
    best = choose(decompose(motion, height), plane_normal(entry_i.mount))
    covariance = motion_covariance(best, height, entry_i.camera, entry_j.camera, points_i, points_j)
    return MotionRow(
        image_i=row.image_i,
        image_j=row.image_j,
        geometric=_fields(closed_form(motion, height), height),
        covariance=shared * covariance,
        **_fields(best, height).model_dump(),
    )


def _fields(relative: RelativePose, height: float) -> MotionFields:
    """Express a motion in the file's terms."""
    robot_i_from_camera_j, mount_i, mount_j = robot_motion(relative, height)
    yaw, _, _ = yaw_tilt_roll(robot_i_from_camera_j.rotation)
    nadir_j, nadir_i = np.pi / 2 - mount_j.tilt, np.pi / 2 - mount_i.tilt
    gamma = location(relative, height, nadir_j, nadir_i)
    return MotionFields(
        R=relative.j_from_i.rotation,
        t=relative.j_from_i.translation,
        normal=relative.normal,
        tilt_i_deg=float(np.degrees(mount_i.tilt)),
        tilt_j_deg=float(np.degrees(mount_j.tilt)),
        yaw_deg=float(np.degrees(yaw)),
        distance_m=float(np.hypot(*robot_i_from_camera_j.translation[:2])),
        gamma=GammaRow(
            rho_heights=gamma.rho,
            phi1_deg=float(np.degrees(gamma.phi1)),
            phi2_deg=float(np.degrees(gamma.phi2)),
        ),
    )
