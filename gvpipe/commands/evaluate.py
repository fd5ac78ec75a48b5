"""``gvpipe evaluate``: trajectories and homographies against the truth."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gvpipe.artefacts import read_artefact
from gvpipe.commands.output import finish
from gvpipe.commands.trajectories import Trajectory, associate, paired, read_trajectory
from gvpipe.core.evaluation.trajectory_error import (
    Alignment,
    Errors,
    absolute_errors,
    align,
    path_length,
    relative_errors,
    statistics,
)
from gvpipe.core.geometry.ground import pixel_from_plane
from gvpipe.core.geometry.homography import apply
from gvpipe.core.types import Camera, Float, Pose, Rejected
from gvpipe.errors import InputError
from gvpipe.names import escape
from gvpipe.records import MatchBody
from gvpipe.report import Reporter

GRID_PX = 8.0
"""Homographies are compared at ground pixels this far apart."""

RANGE_HEIGHTS = 8.0
"""Ground farther than this many camera heights away does not count: a pixel there is metres."""


def trajectory(
    estimate: Path,
    reference: Path,
    *,
    how: Alignment,
    delta: int,
    all_pairs: bool,
    max_gap_s: float,
    json_path: Path | None,
    reporter: Reporter,
) -> None:
    """Print and write absolute and relative errors of a trajectory.

    Parameters
    ----------
    estimate, reference : Path
        See :func:`gvpipe.commands.trajectories.read_trajectory`.
    how : Alignment
        What is fitted first.
    delta : int
        Poses between the ends of relative motions.
    all_pairs : bool
        Relative motions may overlap.
    max_gap_s : float
        Largest difference of paired times.
    json_path : Path, optional
        Where to write the numbers.
    reporter : Reporter
        Prints the table.

    Raises
    ------
    InputError
        If a file is wrong, the two do not belong together, or the alignment is left open.
    """
    found, true, names = paired(estimate, reference, max_gap_s)
    fit = align(found, true, how)
    if isinstance(fit, Rejected):
        raise InputError(f"{escape(str(estimate))}: --align {how}: {fit.reason}")
    moved = [fit.pose(pose) for pose in found]
    absolute = absolute_errors(moved, true)
    document: dict[str, Any] = {
        "schema": "gvpipe/evaluate-trajectory/1",
        "align": how,
        "pairs": len(true),
        "path_m": path_length(true),
        "fit": {
            "scale": fit.scale,
            "rotation": fit.rotation.tolist(),
            "translation": fit.translation.tolist(),
        },
        "ate": _summary(absolute),
        "rows": [
            {"pose": name, "translation_m": t, "rotation_deg": r}
            for name, t, r in zip(
                names, absolute.translation_m.tolist(), absolute.rotation_deg.tolist(), strict=True
            )
        ],
    }
    rows = [
        ("poses", f"{len(true)} over {document['path_m']:.3f} m, aligned by {how}"),
        *_rows("ATE", document["ate"]),
    ]
    if len(true) > delta:
        document["rpe"] = _summary(relative_errors(moved, true, delta, all_pairs=all_pairs))
        document["delta"] = delta
        rows += _rows(f"RPE over {delta}", document["rpe"])
    if how == "sim3":
        rows.append(("scale", f"{fit.scale:.6f}"))
    finish("evaluate trajectory", rows, document, json_path, reporter)


def _summary(errors: Errors) -> dict[str, dict[str, float]]:
    return {
        "translation_m": statistics(errors.translation_m),
        "rotation_deg": statistics(errors.rotation_deg),
    }


def _rows(title: str, summary: Mapping[str, Mapping[str, float]]) -> list[tuple[str, str]]:
    """Lines of the table for one kind of error, not wider than a narrow terminal."""
    rows = []
    for key, unit in (("translation_m", "m"), ("rotation_deg", "°")):
        s = summary[key]
        parts = (f"{name} {_number(s[name])}" for name in ("rmse", "mean", "median", "max"))
        rows.append((f"{title}, {unit}", "  ".join(parts)))
    return rows


def _number(value: float) -> str:
    """Give at most five decimals, fewer of large numbers."""
    return f"{value:.5f}" if value < 10 else f"{value:#.6g}"


def homography(match: Path, truth: Path, *, json_path: Path | None, reporter: Reporter) -> None:
    """Print and write how far matched homographies move ground pixels from where they belong.

    Parameters
    ----------
    match : Path
        ``match.json``, or the folder that holds it.
    truth : Path
        ``groundtruth.json`` or a COLMAP text model with cameras whose world has the ground at
        z = 0.
    json_path : Path, optional
        Where to write the numbers.
    reporter : Reporter
        Prints the table.

    Raises
    ------
    InputError
        If a file is wrong or they have no image in common.
    """
    folder = match if match.is_dir() else match.parent
    pairs = read_artefact(folder, MatchBody).body.pairs
    true = read_trajectory(truth)
    if true.cameras is None:
        raise InputError(f"{true.source}: holds no cameras; expected K, or cameras.txt")
    names = list(dict.fromkeys(image for row in pairs for image in (row.image_i, row.image_j)))
    listed = Trajectory(str(match), tuple([true.poses[0]] * len(names)), names=tuple(names))
    where = {names[i]: j for i, j in associate(listed, true, 0.0)}
    rows = []
    for row in pairs:
        if row.image_i not in where or row.image_j not in where:
            continue
        i, j = where[row.image_i], where[row.image_j]
        points = common_ground(true.cameras[i], true.poses[i], true.cameras[j], true.poses[j])
        entry: dict[str, Any] = {"image_i": row.image_i, "image_j": row.image_j}
        entry |= {"status": row.status, "common_px": len(points)}
        if row.H is not None and len(points):
            wanted = _ground_homography(true, i, j)
            with np.errstate(divide="ignore", invalid="ignore"):
                errors = np.linalg.norm(apply(row.H, points) - apply(wanted, points), axis=1)
            errors = np.where(np.isfinite(errors), errors, 1e9)
            entry |= {f"{k}_px": v for k, v in statistics(errors).items() if k != "sse"}
        rows.append(entry)
    if not rows:
        raise InputError(f"{escape(str(match))} and {true.source}: no image in common")
    means = [row["mean_px"] for row in rows if "mean_px" in row]
    wrong = sum(row["status"] == "ok" and not row["common_px"] for row in rows)
    document: dict[str, Any] = {"schema": "gvpipe/evaluate-homography/1", "pairs": rows}
    table = [("pairs", f"{len(rows)}, {len(means)} matched with ground in common")]
    if means:
        document["mean_px"] = statistics(np.array(means))
        table.append(
            ("mean error a pair", f"median {np.median(means):.3f} px, worst {max(means):.3f}")
        )
    if wrong:
        table.append(("false", f"{wrong} matched though they share no ground"))
    finish("evaluate homography", table, document, json_path, reporter)


def _ground_homography(true: Trajectory, i: int, j: int) -> Float:
    """Pixels of i to pixels of j for the ground z = 0."""
    assert true.cameras is not None  # the caller has looked
    pixel_from_i = pixel_from_plane(true.cameras[i], true.poses[i])
    return np.asarray(
        pixel_from_plane(true.cameras[j], true.poses[j]) @ np.linalg.inv(pixel_from_i)
    )


def common_ground(camera_i: Camera, pose_i: Pose, camera_j: Camera, pose_j: Pose) -> Float:
    """Pixels of i, (N, 2), whose ground both cameras see, nearer than :data:`RANGE_HEIGHTS`."""
    u, v = np.meshgrid(
        np.arange(0, camera_i.width, GRID_PX), np.arange(0, camera_i.height, GRID_PX)
    )
    pixels = np.column_stack([u.ravel(), v.ravel()])
    ground_from_i = np.linalg.inv(pixel_from_plane(camera_i, pose_i)).astype(np.float64)
    below = pixels @ ground_from_i[2, :2] + ground_from_i[2, 2] > 1e-9
    pixels = pixels[below]
    points = apply(ground_from_i, pixels)
    pixel_from_ground = pixel_from_plane(camera_j, pose_j)
    depth = points @ pixel_from_ground[2, :2] + pixel_from_ground[2, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        seen = apply(pixel_from_ground, points)
    inside = (seen >= 0).all(axis=1) & (seen <= [camera_j.width - 1, camera_j.height - 1]).all(
        axis=1
    )
    away = np.linalg.norm(points - pose_i.translation[:2], axis=1)
    return pixels[(depth > 0) & inside & (away < RANGE_HEIGHTS * pose_i.translation[2])]
