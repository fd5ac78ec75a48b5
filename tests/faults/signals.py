"""Interrupt commands at random instants: they end within 2 s, with their code, all of them.

python -m tests.faults.signals [HOW_MANY] [SEED]
"""

import random
import shutil
import signal
import sys
import tempfile
import time
from pathlib import Path

from gvpipe.__main__ import PARTING
from tests.faults.kills import Figures, Target, add, hit
from tests.faults.rig import COMMANDS, start

MOST_S = 2.0
BOOT_S = 0.3
"""Until then the interpreter itself may be starting, and end as any program does."""


def interrupt(target: Target, stage: str, delay_s: float, rng: random.Random) -> Figures:
    """Interrupt one stage after a while."""
    figures = Figures()
    out = target.prepare(stage)
    number, code = rng.choice([(signal.SIGINT, 130), (signal.SIGTERM, 143)])
    whom = rng.choice(["all", "first process"])
    process = start(stage, target.config, "--out", str(out), "--jobs", rng.choice(["1", "2"]))
    time.sleep(delay_s)
    late = process.poll() is not None
    ended, _, err = hit(process, number, whom, figures)
    figures.too_late, figures.kills = int(late), int(not late)
    what = f"{stage}: {number.name} to {whom} after {delay_s:.2f} s"
    if not late and ended not in {code, 0, *([-number, 1] if delay_s < BOOT_S else [])}:
        figures.problems.append(f"{what}: ended with {ended}: {err[-300:]}")
    if not late and delay_s > BOOT_S and err and (len(err.splitlines()) > 1 or PARTING not in err):
        figures.problems.append(f"{what}: said {err[-300:]!r}")
    if figures.seconds[-1] > MOST_S:
        figures.problems.append(f"{what}: took {figures.seconds[-1]:.2f} s to end")
    figures.problems += [f"{what}: {name}" for name in target.wrong_files(out, stage)]
    shutil.rmtree(out)
    return figures


def main() -> int:
    """Interrupt, report, and fail if anything was wrong."""
    wanted = int(sys.argv[1]) if len(sys.argv) > 1 else 60
    rng = random.Random(int(sys.argv[2]) if len(sys.argv) > 2 else 0)
    total = Figures()
    with tempfile.TemporaryDirectory() as folder:
        target = Target.make(Path(folder))
        while total.kills < wanted and len(total.problems) < 20:
            for stage in COMMANDS:
                delay_s = rng.uniform(0.05, target.seconds[stage])
                add(total, interrupt(target, stage, delay_s, rng))
            print(total, flush=True)  # noqa: T201
    return int(bool(total.problems))


if __name__ == "__main__":
    sys.exit(main())
