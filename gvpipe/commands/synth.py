"""``gvpipe synth``: photographs of a made-up scene with everything known about it."""

import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gvpipe.artefacts import canonical_json
from gvpipe.commands.scene_plan import Plan, Shot, advice, take_shots
from gvpipe.core.geometry.pose import mount_of
from gvpipe.core.reconstruct.mesh import join
from gvpipe.core.synthesis.scene import Scene, make_scene, photograph
from gvpipe.core.synthesis.solids import Solid
from gvpipe.core.synthesis.texture import TEXTURES, of_picture
from gvpipe.core.types import Float, Image, Rejected
from gvpipe.errors import InputError, OutputError
from gvpipe.formats.images import read_image
from gvpipe.formats.jpeg import jpeg_bytes
from gvpipe.formats.ply import encode_mesh
from gvpipe.formats.raster import png_bytes
from gvpipe.formats.strict_yaml import format_value
from gvpipe.formats.tum import format_tum
from gvpipe.names import escape
from gvpipe.report import Reporter


def run(plan: Plan, folder: Path, reporter: Reporter) -> None:
    """Render the plan into a new folder.

    Parameters
    ----------
    plan : Plan
        What to photograph.
    folder : Path
        Must not exist, or be empty.
    reporter : Reporter
        Progress and the closing table.

    Raises
    ------
    OutputError
        If the folder holds something or cannot be written.
    InputError
        If the path's file or the ground's picture cannot be read.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise OutputError(f"{escape(str(folder))}: is not empty; name a new folder")
    shots = take_shots(plan)
    rng = np.random.default_rng([plan.seed, 2])
    scene = make_scene(_ground(plan), plan.solids, rng=rng)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        staged = Path(tempfile.mkdtemp(prefix=f".{folder.name}.writing-", dir=folder.parent))
        try:
            _write(plan, scene, shots, staged, reporter)
            staged.chmod(0o755)
            staged.replace(folder)
        finally:
            shutil.rmtree(staged, ignore_errors=True)
    except OSError as error:
        where = escape(str(error.filename or folder))
        raise OutputError(f"{where}: cannot be written: {error.strerror}") from error
    rows = (
        ("images", str(len(shots))),
        ("obstacles", str(len(plan.solids))),
        *advice(plan, shots),
    )
    names = ("config.yaml", "groundtruth.json", "obstacles.ply")
    reporter.result("gvpipe synth", rows, [folder / name for name in names])


def _ground(plan: Plan) -> Image:
    """Texture of the ground: made up, or a picture of the user's."""
    if plan.ground in TEXTURES:
        return TEXTURES[plan.ground](np.random.default_rng([plan.seed, 0]))
    picture = read_image(Path(plan.ground))
    if isinstance(picture, Rejected):
        known = ", ".join(TEXTURES)
        raise InputError(
            f"--ground {escape(plan.ground)}: {picture.reason}; expected {known} or a picture"
        )
    return of_picture(picture.pixels)


def _write(
    plan: Plan, scene: Scene, shots: Sequence[Shot], folder: Path, reporter: Reporter
) -> None:
    """Write everything into a folder of its own."""
    rng = np.random.default_rng([plan.seed, 3])
    for robot in dict.fromkeys(shot.robot for shot in shots):
        (folder / "images" / robot).mkdir(parents=True)
        (folder / "masks" / robot).mkdir(parents=True)
        own = [(s.timestamp, s.map_from_camera) for s in shots if s.robot == robot]
        (folder / f"{robot}.tum").write_text(format_tum(own), encoding="utf-8")
    with reporter.progress("render", len(shots)) as ticker:
        for shot in shots:
            seen = photograph(scene, plan.camera, shot.map_from_camera, plan.distortion)
            noisy = seen.pixels + rng.normal(scale=plan.noise, size=seen.pixels.shape)
            pixels = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
            data = png_bytes(pixels) if plan.png else jpeg_bytes(pixels)
            (folder / "images" / shot.robot / shot.name).write_bytes(data)
            mask = np.clip(seen.solids + 1, 0, 255).astype(np.uint8)
            path = folder / "masks" / shot.robot / Path(shot.name).with_suffix(".png")
            path.write_bytes(png_bytes(mask[..., None]))
            ticker.advance()
    surface = join([solid.surface for solid in plan.solids])
    (folder / "obstacles.ply").write_bytes(encode_mesh(surface))
    (folder / "groundtruth.json").write_text(canonical_json(_truth(plan, shots)), encoding="utf-8")
    (folder / "config.yaml").write_text(config_text(plan, shots), encoding="utf-8")


def config_text(plan: Plan, shots: Sequence[Shot]) -> str:
    """Write a configuration that runs on the pictures, as a careful user would."""
    cam, held = plan.camera, plan.mount
    intrinsics: dict[str, Any] = {"width": cam.width, "height": cam.height}
    intrinsics |= {k: round(float(getattr(cam, k)), 6) for k in ("fx", "fy", "cx", "cy")}
    if plan.distortion:
        intrinsics["distortion"] = list(plan.distortion)
    lines = [
        "# Made-up photographs; what is true of them is in groundtruth.json and *.tum.",
        "cameras:",
    ]
    lines += [f"  cam: {format_value(intrinsics)}", "robots:"]
    for robot in dict.fromkeys(shot.robot for shot in shots):
        mounts = [mount_of(s.map_from_camera) for s in shots if s.robot == robot]
        if plan.path not in ("circle", "line", "mower"):
            held = replace(
                held,
                tilt=float(np.median([m.tilt for m in mounts])),
                roll=float(np.median([m.roll for m in mounts])),
                height=float(np.median([m.height for m in mounts])),
            )
        entry = {"images": f"images/{robot}", "camera": "cam", "height": round(held.height, 4)}
        entry |= {"tilt": round(float(np.degrees(held.tilt)), 3)}
        entry |= {"roll": round(float(np.degrees(held.roll)), 3)}
        lines.append(f"  {robot}: {format_value(entry)}")
    lines += ["output: run", f"seed: {plan.seed}"]
    return "\n".join(lines) + "\n"


def _truth(plan: Plan, shots: Sequence[Shot]) -> dict[str, Any]:
    """Everything known, in the conventions of the artefacts; world is the map, ground z = 0."""
    images = []
    for shot in shots:
        held = mount_of(shot.map_from_camera)
        camera_from_map = shot.map_from_camera.inverse()
        images.append(
            {
                "file": f"images/{shot.robot}/{shot.name}",
                "image": f"{shot.robot}/{shot.name}",
                "robot": shot.robot,
                "width": plan.camera.width,
                "height": plan.camera.height,
                "K": plan.camera.matrix.tolist(),
                "dist": list(plan.distortion),
                "R": camera_from_map.rotation.tolist(),
                "t": camera_from_map.translation.tolist(),
                "C": shot.map_from_camera.translation.tolist(),
                "tilt_deg": float(np.degrees(held.tilt)),
                "roll_deg": float(np.degrees(held.roll)),
                "height_m": held.height,
            }
        )
    return {
        "schema": "gvpipe/groundtruth/1",
        "units": "metre",
        "frames": "x_camera = R X_map + t; camera x right, y down; map z up, ground z = 0",
        "nominal_height_m": plan.mount.height,
        "robots": list(dict.fromkeys(shot.robot for shot in shots)),
        "images": images,
        "obstacles": [_obstacle(k, solid) for k, solid in enumerate(plan.solids)],
    }


def _obstacle(number: int, solid: Solid) -> dict[str, Any]:
    corners: Float = solid.surface.vertices
    return {
        "id": number,
        "mask_value": number + 1,
        "kind": solid.kind,
        "x": solid.x,
        "y": solid.y,
        "yaw_deg": float(np.degrees(solid.yaw)),
        "size": list(solid.size),
        "bbox_min": corners.min(axis=0).tolist(),
        "bbox_max": corners.max(axis=0).tolist(),
    }
