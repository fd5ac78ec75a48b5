"""The same bytes for any jobs, hash seed and place of the data, and from one process for all.

python -m tests.faults.same
"""

import random
import shutil
import sys
import tempfile
from pathlib import Path

from tests.faults.rig import STAGES, make_small_set, run, snapshot

VARIANTS = [(jobs, seed) for jobs in ("1", "2", "4") for seed in ("0", "1", "random")]


def main() -> int:
    """Run the chain in every way, report, and fail if anything differs."""
    problems = []
    with tempfile.TemporaryDirectory() as folder:
        config = make_small_set(Path(folder) / "set")
        reference: dict[str, bytes] = {}
        for jobs, seed in VARIANTS:
            name = "".join(random.choices("abcdefgh é", k=9)).strip() + "é"
            copy = Path(folder) / name / "further down"
            shutil.copytree(config.parent, copy)
            for stage in ("run",) if seed == "random" else STAGES:
                ended = run(stage, copy / config.name, "--jobs", jobs, PYTHONHASHSEED=seed)
                assert ended.code == 0, ended
            have = snapshot(copy / "run")
            reference = reference or have
            differing = [f for f in have.keys() | reference.keys() if have[f] != reference[f]]
            problems += [f"jobs {jobs}, hash seed {seed}: {file}" for file in differing]
            print(f"jobs {jobs}, hash seed {seed}: {len(have)} files", flush=True)  # noqa: T201
    print(f"{len(VARIANTS)} runs of the chain, {len(problems)} differing files")  # noqa: T201
    print(*problems, sep="\n")  # noqa: T201
    return int(bool(problems))


if __name__ == "__main__":
    sys.exit(main())
