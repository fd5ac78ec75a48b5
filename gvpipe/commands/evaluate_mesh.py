"""``gvpipe evaluate mesh``: a reconstructed surface against the true one."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from gvpipe.commands.output import finish
from gvpipe.commands.trajectories import paired
from gvpipe.core.evaluation.mesh_error import Surface, sample_surface, surface_errors, volume_iou
from gvpipe.core.evaluation.trajectory_error import Alignment, Similarity, align
from gvpipe.core.types import Float, Rejected
from gvpipe.errors import InputError
from gvpipe.formats.glb import GLTF_FROM_MAP
from gvpipe.names import escape
from gvpipe.report import Reporter

SAMPLES = 60_000
"""Points drawn on each surface: shares are then good to half a percent."""


def mesh(
    estimate: Path,
    truth: Path,
    *,
    tolerance_m: float,
    above_m: float,
    spacing_m: float,
    poses: tuple[Path, Path] | None,
    how: Alignment,
    seed: int,
    json_path: Path | None,
    reporter: Reporter,
) -> None:
    """Print and write how near a reconstructed mesh is to the true one.

    Parameters
    ----------
    estimate, truth : Path
        PLY, or whatever else trimesh reads; metres, z up (glTF: y up, as it asks).
    tolerance_m : float
        What counts as near.
    above_m : float
        Surface below this height is left out: the face on the ground cannot be seen.
    spacing_m : float
        Side of the cells for the intersection over union.
    poses : (Path, Path), optional
        Estimated and true trajectories; what aligns them is applied to the mesh.
    how : Alignment
        How they are aligned.
    seed : int
        For the points drawn.
    json_path : Path, optional
        Where to write the numbers.
    reporter : Reporter
        Prints the table.

    Raises
    ------
    InputError
        If a file is wrong or holds no surface.
    """
    found, true = _read_surface(estimate), _read_surface(truth)
    if poses is not None:
        found = Surface(_fit(poses, how).points(found.vertices), found.faces)
    clouds = [
        _sampled(path, surface, above_m, np.random.default_rng([seed, k]))
        for k, (path, surface) in enumerate(((estimate, found), (truth, true)))
    ]
    errors = surface_errors(clouds[0], clouds[1], tolerance_m)
    document: dict[str, Any] = {"schema": "gvpipe/evaluate-mesh/1", "tolerance_m": tolerance_m}
    document |= {"above_m": above_m, "align": how if poses else "none", **asdict(errors)}
    rows = [
        ("F-score", f"{errors.fscore:.4f} at {1e3 * tolerance_m:g} mm"),
        ("precision, recall", f"{errors.precision:.4f}, {errors.recall:.4f}"),
        ("chamfer", f"{1e3 * errors.chamfer_m:.2f} mm"),
        (
            "nine tenths within",
            f"{1e3 * errors.accuracy_p90_m:.2f} mm (estimate), "
            f"{1e3 * errors.completeness_p90_m:.2f} mm (truth)",
        ),
    ]
    try:
        document["iou"] = volume_iou(found, true, spacing_m)
        rows.append(("volume in common", f"{document['iou']:.4f} of the union"))
    except ValueError as error:
        rows.append(("volume in common", f"not measured: {error}"))
    if not errors.fscore:
        rows.append(("", "no surface is near the other: in another frame? see --poses"))
    finish("evaluate mesh", rows, document, json_path, reporter)


def _fit(poses: tuple[Path, Path], how: Alignment) -> Similarity:
    """Align two trajectories."""
    first, second, _ = paired(*poses, max_gap_s=0.02)
    fit = align(first, second, how)
    if isinstance(fit, Rejected):
        raise InputError(f"--align {how}: {fit.reason}")
    return fit


def _sampled(path: Path, surface: Surface, above_m: float, rng: np.random.Generator) -> Float:
    """Draw points on a surface; those near the ground are left out."""
    try:
        cloud = sample_surface(surface, SAMPLES, rng)
    except ValueError as error:
        raise InputError(f"{escape(str(path))}: {error}") from error
    cloud = cloud[cloud[:, 2] >= above_m] if above_m > 0 else cloud
    if not len(cloud):
        raise InputError(f"{escape(str(path))}: no surface above {above_m:g} m")
    return cloud


def _read_surface(path: Path) -> Surface:
    """Read a mesh with trimesh, all parts joined; glTF has y up, the map z."""
    name = escape(str(path))
    if not path.is_file():
        raise InputError(f"{name}: no such file; expected a mesh")
    try:
        loaded: Any = trimesh.load(path, force="mesh", process=False)
    except Exception as error:  # trimesh promises no particular one
        raise InputError(f"{name}: cannot be read as a mesh: {error}") from error
    faces = np.asarray(getattr(loaded, "faces", np.empty((0, 3), int)))
    if not len(faces) or not np.isfinite(loaded.vertices).all():
        raise InputError(f"{name}: holds no surface, or corners that are not finite")
    vertices = np.asarray(loaded.vertices, dtype=np.float64)
    if path.suffix.lower() in (".glb", ".gltf"):
        vertices = vertices @ GLTF_FROM_MAP
    return Surface(vertices, faces)
