"""Kill commands at random instants; nothing half-written may be left, and nothing may be lost.

python -m tests.faults.kills [HOW_MANY] [SEED]
"""

import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from tests.faults.rig import (
    COMMANDS,
    STAGES,
    Ended,
    make_small_set,
    run,
    session_members,
    snapshot,
    start,
)

KILLS_PER_RESUME = 4
"""So often is a run killed and started again before it may end."""

UNFINISHED = ("*.writing-*", ".*.checkpoints")


@dataclass
class Figures:
    """What happened."""

    kills: int = 0
    too_late: int = 0
    resumed: int = 0
    items_reused: int = 0
    problems: list[str] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)

    def __str__(self) -> str:
        slowest = f", slowest end {max(self.seconds):.2f} s" if self.seconds else ""
        lines = [
            f"{self.kills} kills ({self.too_late} more came after the end), {self.resumed} resumed "
            f"runs that reused {self.items_reused} items{slowest}, {len(self.problems)} problems"
        ]
        return "\n".join(lines + self.problems)


@dataclass(frozen=True)
class Target:
    """A set whose chain has run undisturbed, and how long its commands take."""

    folder: Path
    config: Path
    seconds: dict[str, float]

    @classmethod
    def make(cls, folder: Path) -> "Target":
        """Make a set in a folder and run the chain on it."""
        config = make_small_set(folder / "set")
        seconds = {}
        for stage in COMMANDS:
            run(stage, config)  # compiles what is not compiled yet
            started = time.monotonic()
            ended = run(stage, config, "--force")
            assert ended.code == 0, ended
            seconds[stage] = time.monotonic() - started
        return cls(folder, config, seconds)

    @cached_property
    def reference(self) -> dict[str, bytes]:
        """What undisturbed runs write."""
        return snapshot(self.config.parent / "run")

    def prepare(self, stage: str) -> Path:
        """Make an output folder in which everything before a command is done."""
        out = Path(tempfile.mkdtemp(dir=self.folder))
        for done in STAGES[: STAGES.index(COMMANDS[stage][0])]:
            shutil.copytree(self.config.parent / "run" / done, out / done)
        return out

    def wrong_files(self, out: Path, stage: str) -> list[str]:
        """Final names whose content is not what an undisturbed run writes."""
        try:
            have = snapshot(out, COMMANDS[stage])
        except ValueError as error:
            return [f"{stage}: unreadable JSON: {error}"]
        return [name for name, content in have.items() if self.reference.get(name) != content]

    def left_over(self, out: Path) -> list[str]:
        """Names in an output folder that no finished run leaves."""
        return [str(p.relative_to(out)) for pattern in UNFINISHED for p in out.glob(pattern)]


def hit(
    process: subprocess.Popen[str], number: int, whom: str, figures: Figures
) -> tuple[int, str, str]:
    """Send a signal and wait until everything the command started is gone."""
    started = time.monotonic()
    try:
        if whom == "all":
            os.killpg(process.pid, number)
        elif whom == "working process":
            children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
            os.kill(int(children[0]) if children else process.pid, number)
        else:
            os.kill(process.pid, number)
    except (ProcessLookupError, FileNotFoundError):
        pass
    out, err = process.communicate(timeout=60)
    while session_members(process.pid) and time.monotonic() - started < 10:
        time.sleep(0.02)
    figures.seconds.append(time.monotonic() - started)
    for orphan in session_members(process.pid):
        figures.problems.append(f"process {orphan} lives on 10 s after {whom} got signal {number}")
        os.kill(orphan, signal.SIGKILL)
    return process.returncode, out, err


def kill_and_resume(target: Target, stage: str, kills: int, rng: random.Random) -> Figures:
    """Kill one stage several times, then let it end and compare."""
    figures = Figures()
    out = target.prepare(stage)
    for _ in range(kills):
        jobs = rng.choice(["1", "2"])
        process = start(stage, target.config, "--out", str(out), "--jobs", jobs, "-q")
        time.sleep(rng.uniform(0.0, 1.05 * target.seconds[stage]))
        late = process.poll() is not None
        whom = rng.choice(["all", "first process", "working process"])
        hit(process, signal.SIGKILL, whom, figures)
        figures.too_late += late
        figures.kills += not late
        wrong = target.wrong_files(out, stage)
        figures.problems += [f"{stage}: after a kill of {whom}: {name}" for name in wrong]
        if late:
            break
    ended = run(stage, target.config, "--out", str(out), "--jobs", "2")
    figures.resumed += 1
    check_ended(target, stage, out, ended, figures)
    shutil.rmtree(out)
    return figures


def check_ended(target: Target, stage: str, out: Path, ended: Ended, figures: Figures) -> None:
    """Compare an undisturbed end with the reference."""
    if ended.code != 0:
        figures.problems.append(f"{stage}: resumed, ended with {ended.code}: {ended.err}")
    for line in ended.out.splitlines():
        if line.startswith("resumed"):
            figures.items_reused += int(line.split()[1])
    for name in target.wrong_files(out, stage) + target.left_over(out):
        figures.problems.append(f"{stage}: after resuming: {name}")
    made = {name for name in target.reference if name.split("/")[0] in COMMANDS[stage]}
    missing = made - snapshot(out).keys()
    figures.problems += [f"{stage}: after resuming: {name} is missing" for name in missing]


def add(total: Figures, part: Figures) -> None:
    """Sum up."""
    total.kills += part.kills
    total.too_late += part.too_late
    total.resumed += part.resumed
    total.items_reused += part.items_reused
    total.problems += part.problems
    total.seconds += part.seconds


def main() -> int:
    """Kill, report, and fail if anything was wrong."""
    wanted = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    rng = random.Random(int(sys.argv[2]) if len(sys.argv) > 2 else 0)
    total = Figures()
    with tempfile.TemporaryDirectory() as folder:
        target = Target.make(Path(folder))
        while total.kills < wanted and len(total.problems) < 20:
            for stage in COMMANDS:
                kills = min(KILLS_PER_RESUME, wanted - total.kills)
                if kills > 0:
                    add(total, kill_and_resume(target, stage, kills, rng))
            print(total, flush=True)  # noqa: T201
    return int(bool(total.problems))


if __name__ == "__main__":
    sys.exit(main())
