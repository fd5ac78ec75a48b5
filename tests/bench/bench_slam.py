"""Cost and accuracy of the map against COLMAP with the true intrinsics, in one run.

Run ``python -m tests.bench.bench_slam`` from the repository; pycolmap must be installed. Without
arguments, eight pictures of a synthetic floor with two boxes are taken. CPU seconds of all
processes, pictures decoded anew by each, one thread. COLMAP knows no scale: both are compared with
the scale fitted.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

from gvpipe.config import Config
from gvpipe.configfile import load_config
from gvpipe.core.geometry.pose import planar_pose
from gvpipe.core.types import Camera, Float, Mount, Pose
from gvpipe.dataset import open_dataset
from gvpipe.formats.colmap import read_images
from gvpipe.formats.tum import format_tum, read_tum
from tests.synthetic import Box, Scene, texture

STAGES = "match,overlap,slam"
CAMERA = Camera(width=640, height=480, fx=545.0, fy=545.0, cx=319.5, cy=239.5)
TILT_DEG, HEIGHT = 38.0, 0.6


def take_pictures(folder: Path) -> tuple[Path, Path]:
    """Drive one robot along an arc of eight stops; write configuration and true trajectory."""
    rng = np.random.default_rng(5)
    faces = texture(rng, 512)
    boxes = (
        Box((0.2, 0.5, 0.0), (0.5, 0.8, 0.3), faces),
        Box((-0.4, -0.9, 0), (0, -0.6, 0.2), faces),
    )
    scene = Scene(texture(rng, 2048), boxes=boxes)
    (folder / "images").mkdir()
    stamped = []
    x, y, heading = -1.2, -0.6, 0.1
    for k in range(8):
        mount = Mount(np.radians(TILT_DEG + rng.normal(0, 0.2)), rng.normal(0, 0.003), HEIGHT)
        pose = planar_pose(x, y, heading, mount)
        picture = scene.photograph(pose, CAMERA, noise=1.0, rng=rng)
        ok, png = cv2.imencode(".png", picture[..., ::-1])
        if not ok:
            raise RuntimeError("the picture cannot be encoded")
        (folder / "images" / f"{k}.png").write_bytes(png.tobytes())
        stamped.append((float(k), pose))
        x, y = x + 0.3 * np.cos(heading), y + 0.3 * np.sin(heading)
        heading += np.radians(9.0)
    (folder / "truth.tum").write_text(format_tum(stamped))
    c = CAMERA
    (folder / "run.yaml").write_text(
        f"cameras: {{c: {{width: {c.width}, height: {c.height}, fx: {c.fx}, fy: {c.fy}, "
        f"cx: {c.cx}, cy: {c.cy}}}}}\n"
        f"robots: {{A: {{images: images, height: {HEIGHT}, tilt: {TILT_DEG + 1.5}}}}}\n"
    )
    return folder / "run.yaml", folder / "truth.tum"


def cpu_s(command: list[str]) -> float:
    """Run a command on one thread; CPU seconds of it and all it starts."""
    threads = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    environment = os.environ | threads
    environment.pop("PYTHONDONTWRITEBYTECODE", None)  # an installation has its modules compiled
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, check=True, env=environment, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def run_colmap(config: Config, images: Path, work: Path) -> None:
    """Reconstruct with COLMAP's defaults, the true intrinsics held; text model into `work`."""
    import pycolmap

    [camera] = config.cameras.values()
    values = [camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5]
    reader = pycolmap.ImageReaderOptions()
    model, numbers = "PINHOLE", values
    if any(camera.distortion):
        k1, k2, p1, p2, k3, *rest = (*camera.distortion, 0.0, 0.0, 0.0, 0.0)[:8]
        model, numbers = "FULL_OPENCV", [*values, k1, k2, p1, p2, k3, *rest]
    reader.camera_model, reader.camera_params = model, ",".join(map(repr, numbers))
    database = work / "database.db"
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads = 1
    pycolmap.extract_features(
        database,
        images,
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader,
        extraction_options=extraction,
        device=pycolmap.Device.cpu,
    )
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = 1
    pycolmap.match_exhaustive(database, matching_options=matching, device=pycolmap.Device.cpu)
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = 1
    options.ba_refine_focal_length = False
    options.ba_refine_principal_point = False
    options.ba_refine_extra_params = False
    found = pycolmap.incremental_mapping(database, images, work, options=options)
    if found:
        best = max(found.values(), key=lambda m: m.num_reg_images())
        best.write_text(str(work))


def ate_mm(found: Float, true: Float, *, scaled: bool) -> float:
    """RMS distance (millimetres) of positions (N, 3) after the best rigid or similarity motion."""
    a, b = found - found.mean(axis=0), true - true.mean(axis=0)
    u, _, vt = np.linalg.svd(a.T @ b)
    turned = a @ u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    scale = float((turned * b).sum() / (a**2).sum()) if scaled else 1.0
    return 1e3 * float(np.sqrt(((scale * turned - b) ** 2).sum(axis=1).mean()))


def compare(config_path: Path, truth_path: Path, work: Path) -> None:
    """Run both and print one line each, then the ratio of their costs."""
    config = load_config(config_path, (), work / "run")
    names = [entry.image_id.split("/", 1)[1] for entry in open_dataset(config).entries]
    truth = dict(zip(names, (pose for _, pose in read_tum(truth_path)), strict=True))
    [robot] = config.robots.values()
    gvpipe = [sys.executable, "-m", "gvpipe"]
    tail = [str(config_path), "--out", str(work / "run"), "--jobs", "1", "-q"]
    command = [*gvpipe, "run", *tail, "--stages", STAGES]
    cpu_s(command)  # compiles what is compiled once an installation
    ours = cpu_s([*command, "--force"])
    (work / "colmap").mkdir()
    arguments = [str(config_path), str(robot.images), str(work / "colmap")]
    theirs = cpu_s([sys.executable, "-m", "tests.bench.bench_slam", "--colmap", *arguments])
    report("gvpipe", ours, work / "run" / "slam", truth)
    report("COLMAP", theirs, work / "colmap", truth)
    sys.stdout.write(f"CPU ratio {ours / theirs:.2f}\n")


def report(name: str, cost_s: float, folder: Path, truth: dict[str, Pose]) -> None:
    """Print cost and accuracy of one of the two."""
    file = folder / "images.txt"
    images = read_images(file) if file.exists() else []
    if len(images) < 3:
        sys.stdout.write(f"{name}: {cost_s:6.1f} s CPU, no model\n")
        return
    found = np.array([image.map_from_camera.translation for image in images])
    true = np.array([truth[image.name.rsplit("/", 1)[-1]].translation for image in images])
    metric = f", {ate_mm(found, true, scaled=False):.2f} mm metric" if name == "gvpipe" else ""
    sys.stdout.write(
        f"{name}: {cost_s:6.1f} s CPU, {len(images)} of {len(truth)} images, "
        f"ATE {ate_mm(found, true, scaled=True):.2f} mm scaled{metric}\n"
    )


def main() -> None:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", nargs="*", type=Path, help="CONFIG of one robot, and TUM truth")
    parser.add_argument("--colmap", nargs=3, type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.colmap:
        config, images, work = arguments.colmap
        run_colmap(load_config(config), images, work)
        return
    with tempfile.TemporaryDirectory() as scratch:
        work = Path(scratch)
        config, truth = arguments.data or take_pictures(work)
        compare(config, truth, work)


if __name__ == "__main__":
    main()
