"""Run commands on a disk that fills up: exit code 6, the path named, what was there intact.

python -m tests.faults.fulldisk [SIZES_PER_COMMAND]      (as root: it mounts small file systems)
"""

import contextlib
import io
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gvpipe.cli import run
from tests.faults.rig import STAGES, make_small_set, snapshot

PAGE = 4096
"""Such a file system gives out space in pages."""


@contextmanager
def small_disk(pages: int) -> Iterator[Path]:
    """Mount a file system of so many pages; OSError where that is not allowed."""
    with tempfile.TemporaryDirectory() as folder:
        options = f"size={pages * PAGE}"
        command = ["mount", "-t", "tmpfs", "-o", options, "none", folder]
        done = subprocess.run(command, capture_output=True, check=False)
        if done.returncode:
            raise OSError(done.stderr.decode(errors="replace"))
        try:
            yield Path(folder)
        finally:
            subprocess.run(["umount", folder], check=True)


def fill(disk: Path, leave: int) -> Path:
    """Fill a file system but for some pages."""
    ballast = disk / "ballast"
    free = shutil.disk_usage(disk).free // PAGE
    ballast.write_bytes(bytes(max(free - leave, 0) * PAGE))
    return ballast


def command(stage: str, config: Path, out: Path, *options: str) -> tuple[int, str]:
    """Run a command here; return its exit code and what it said of errors."""
    said = io.StringIO()
    with contextlib.redirect_stderr(said):
        code = run([stage, str(config), "--out", str(out), "-q", "--jobs", "1", *options])
    return code, said.getvalue()


def everything(folder: Path) -> dict[str, bytes]:
    """Bytes of all files of a stage."""
    return {p.name: p.read_bytes() for p in sorted(folder.glob("*"))}


def trial(stage: str, config: Path, reference: Path, leave: int, *, old: bool) -> list[str]:
    """Run one command with so many free pages, then again with enough; return what was wrong."""
    problems = []
    what = f"{stage} with {leave} free pages, {'an' if old else 'no'} old artefact"
    with small_disk(4096) as disk:
        out = disk / "out"
        for done in STAGES[: STAGES.index(stage) + old]:
            shutil.copytree(reference / done, out / done)
        out.mkdir(exist_ok=True)
        before = everything(out / stage)
        ballast = fill(disk, leave)
        code, said = command(stage, config, out, *(["--force"] if old else []))
        if code not in (0, 6) or (code == 6 and str(disk) not in said):
            problems.append(f"{what}: ended with {code}: {said[-500:]}")
        if code == 6 and everything(out / stage) != before:
            problems.append(f"{what}: the old artefact has changed")
        problems += [f"{what}: {p.name} is left" for p in out.glob("*.writing-*")]
        ballast.unlink()
        again, said = command(stage, config, out)
        if again or snapshot(out, (stage,)) != snapshot(reference, (stage,)):
            problems.append(f"{what}: repeated, ended with {again}, or differs: {said[-500:]}")
    print(what, "->", code, flush=True)  # noqa: T201
    return problems


def main() -> int:
    """Try many sizes, report, and fail if anything was wrong."""
    sizes = int(sys.argv[1]) if len(sys.argv) > 1 else 9
    problems = []
    count = 0
    with tempfile.TemporaryDirectory() as folder:
        config = make_small_set(Path(folder) / "set")
        reference = Path(folder) / "reference"
        for stage in STAGES:
            assert command(stage, config, reference)[0] == 0
            need = sum(-(-p.stat().st_size // PAGE) for p in (reference / stage).glob("*"))
            for k in range(sizes):
                leave = round(k * (1.1 * need + 2) / max(sizes - 1, 1))
                problems += trial(stage, config, reference, leave, old=bool(k % 2))
                count += 1
    print(f"{count} sizes of a full disk, {len(problems)} problems", *problems, sep="\n")  # noqa: T201
    return int(bool(problems))


if __name__ == "__main__":
    sys.exit(main())
