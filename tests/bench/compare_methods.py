"""Compare the methods of ``gvpipe reconstruct`` on scenes with known truth, as a Markdown table.

Run it by ``python -m tests.bench.compare_methods FOLDER ...``; each folder is one that ``gvpipe
synth`` wrote. Without a folder it makes one scene first: a box, a cylinder and a sphere on stone.
All methods start from the same poses and mosaic, through the same command with default settings.
CPU seconds are those of the whole command, which spends most of them on the silhouettes that the
methods share.
"""

import argparse
import json
import resource
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import get_args

from gvpipe.config import ReconstructConfig

METHODS = get_args(ReconstructConfig.model_fields["method"].annotation)
BEFORE = ("match", "overlap", "slam", "mosaic")


def gvpipe(*arguments: str | Path) -> float:
    """Run a command; how many CPU seconds it took."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, "-m", "gvpipe", *map(str, arguments), "-q"]
    code = subprocess.run(command, check=False).returncode
    if code not in (0, 5):  # 5: ran, and found nothing, which is what the table then says
        raise SystemExit(code)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def row(folder: Path, out: Path, method: str) -> str:
    """Reconstruct by a method and score what it found."""
    config, choice = folder / "config.yaml", f"reconstruct.method={method}"
    seconds = gvpipe("reconstruct", config, "--out", out, "--jobs", "1", "--force", "--set", choice)
    found = json.loads((out / "reconstruct" / "obstacles.json").read_text())
    cells = [folder.name, method, str(len(found["obstacles"]))]
    if not found["obstacles"]:
        return " | ".join([*cells, "-", "-", "-", f"{seconds:.0f}"])
    scores = out / "scores.json"
    poses = ("--poses", out / "slam" / "A.tum", "--true-poses", truth_of(folder))
    mesh, truth = out / "reconstruct" / "obstacles.ply", folder / "obstacles.ply"
    gvpipe("evaluate", "mesh", mesh, truth, *poses, "--json", scores)
    score = json.loads(scores.read_text())
    figures = [f"{score['fscore']:.3f}", f"{score['iou']:.3f}", f"{1e3 * score['chamfer_m']:.1f}"]
    return " | ".join([*cells, *figures, f"{seconds:.0f}"])


def truth_of(folder: Path) -> Path:
    """Find the true poses of robot A."""
    return next(folder.rglob("A.tum"))


def main(arguments: list[str]) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="*", type=Path, help="written by gvpipe synth")
    folders = parser.parse_args(arguments).folders
    work = Path(tempfile.mkdtemp(prefix="gvpipe-methods-"))
    try:
        if not folders:
            folders = [work / "synth"]
            gvpipe("synth", folders[0])
        print("scene | method | obstacles | F-score at 1 cm | IoU | chamfer, mm | CPU, s")  # noqa: T201
        print("--- | --- | --- | --- | --- | --- | ---")  # noqa: T201
        for folder in folders:
            out = work / f"{folder.name}-run"
            for stage in BEFORE:
                gvpipe(stage, folder / "config.yaml", "--out", out)
            for method in METHODS:
                print(row(folder, out, method), flush=True)  # noqa: T201
    finally:
        shutil.rmtree(work)


if __name__ == "__main__":
    main(sys.argv[1:])
