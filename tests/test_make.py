"""``make run`` leaves to gvpipe what is fresh, and to the configuration where results go."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent

pytestmark = pytest.mark.skipif(shutil.which("make") is None, reason="there is no make")


def made(tmp_path: Path, *arguments: str) -> list[str]:
    """Command lines that a stand-in for gvpipe was called with; its stages have no result."""
    programs = tmp_path / "venv" / "bin"
    if not programs.exists():
        programs.mkdir(parents=True)
        (programs / "python").touch()
        gvpipe = programs / "gvpipe"
        log = tmp_path / "calls"
        gvpipe.write_text(f'#!/bin/sh\necho "$*" >> {log}\n[ "$1" != run ] || exit 5\n')
        gvpipe.chmod(0o755)
        (programs.parent / ".installed").touch()
    command = ["make", f"VENV={programs.parent}", "JOBS=2", "run", *arguments]
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("MAKE", "MFLAGS"))}
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True, env=environment)
    lines = (tmp_path / "calls").read_text().splitlines()
    (tmp_path / "calls").unlink()
    return [" ".join(line.split()) for line in lines]


def test_make_asks_gvpipe_every_time_and_reports_where_there_is_no_result(tmp_path: Path) -> None:
    for _ in range(2):
        assert made(tmp_path, "CONFIG=a b.yaml") == [
            "run a b.yaml --jobs 2",
            "report a b.yaml --jobs 2",
        ]


def test_results_go_where_the_configuration_says_unless_told(tmp_path: Path) -> None:
    sample = "sample_runs/two_robots/two_robots.yaml"
    assert made(tmp_path)[0] == f"run {sample} --jobs 2"
    assert made(tmp_path, "OUT=there")[1] == f"report {sample} --out there --jobs 2"
