"""``gvpipe evaluate``: trajectories and homographies against the truth."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gvpipe.artefacts import read_artefact
from gvpipe.commands.output import finish
from gvpipe.commands.trajectories import Trajectory, associate, paired, read_trajectory
from gvpipe.core.evaluation.homography_error import common_ground, homography_errors
from gvpipe.core.evaluation.trajectory_error import (
    Alignment,
    Errors,
    absolute_errors,
    align,
    path_length,
    relative_errors,
    statistics,
)
from gvpipe.core.types import Rejected
from gvpipe.errors import InputError
from gvpipe.names import escape
from gvpipe.records import MatchBody
from gvpipe.report import Reporter


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
        view_i, view_j = ((true.cameras[k], true.poses[k]) for k in (i, j))
        points = common_ground(view_i, view_j)
        entry: dict[str, Any] = {"image_i": row.image_i, "image_j": row.image_j}
        entry |= {"status": row.status, "common_px": len(points)}
        if row.H is not None and len(points):
            errors = homography_errors(row.H, view_i, view_j, points)
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
