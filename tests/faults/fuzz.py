"""Configurations and artefacts that went wrong in every way: an exit code and a message, always.

python -m tests.faults.fuzz [CONFIGURATIONS] [ARTEFACTS] [SEED]
"""

import contextlib
import hashlib
import io
import json
import random
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gvpipe.artefacts import digest
from gvpipe.cli import run
from tests.faults.rig import STAGES, make_small_set

ALLOWED = {0, 2, 3, 4, 5}
MOST_S = 10.0
"""Longest that a refusal may keep a processor busy."""

SCALARS = (
    ".nan .inf -.inf 1e999 -1 0 1 1e-300 1e300 017 0x1F 1_000 12:30:45 2024-01-01 yes NO ~ null "
    "true '' \"\" [] {} [1] [[1]] {a: 1} *a &a !!python/object:os.system !!binary auto A/0.png "
    "../../etc/passwd /dev/zero /proc/self/mem . .. ~root \\0 \u202e\u0085 \ud7ff 'é' " + "9" * 400
).split(" ")
"""What stands where something else is expected."""

JSON_VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 2**53, 10**400, 1e308, -1e308, 5e-324, "", "A/0.png", "ok"),
    *("rejected", "no/such.png", "\ud800", "\0", "../x", [], {}, [0], [[0]], [[]], {"a": 1}),
    *([[0, 0, 0]] * 3, [[1, 0, 0], [0, 1, 0], [0, 0, 1]], [1e308] * 3, [0, 0, 0], "nan"),
)


def mutate_bytes(data: bytes, rng: random.Random) -> bytes:
    """Damage anything."""
    out = bytearray(data)
    for _ in range(rng.choice([1, 1, 1, 2, 5])):
        at = rng.randrange(len(out) + 1)
        length = rng.choice([1, 1, 2, 8, 64, 1000])
        match rng.randrange(5):
            case 0 if at < len(out):
                out[at] ^= 1 << rng.randrange(8)
            case 1:
                del out[at : at + length]
            case 2:
                out[at:at] = bytes(rng.randrange(256) for _ in range(min(length, 64)))
            case 3:
                out[at:at] = out[rng.randrange(len(out) + 1) :][:length]
            case _:
                del out[at:]
    return bytes(out)


def mutate_text(data: bytes, rng: random.Random) -> bytes:
    """Damage YAML where it hurts: values, keys, lines, indentation."""
    lines = data.decode("utf-8", "surrogateescape").split("\n")
    at = rng.randrange(len(lines))
    words = lines[at].split(" ")
    word = rng.randrange(len(words))
    match rng.randrange(7):
        case 0 | 1:
            words[word] = rng.choice(SCALARS) + rng.choice(["", "", ",", "}"])
        case 2:
            words[word] += rng.choice([":", ",", "}", "]", "{", "[", "#", "\t", "'", '"', "x", "0"])
        case 3:
            lines.insert(rng.randrange(len(lines)), lines[at])
        case 4:
            words.insert(0, " " * rng.randrange(1, 6))
        case 5:
            words = ["[" * rng.choice([5, 40, 5000])]
        case _:
            words.pop(word)
    lines[at] = " ".join(words)
    return "\n".join(lines).encode("utf-8", "surrogateescape" if rng.random() < 0.9 else "replace")


def mutate_config(data: bytes, rng: random.Random) -> bytes:
    """Damage a configuration once or several times."""
    for _ in range(rng.choice([1, 1, 2, 4])):
        data = (mutate_text if rng.random() < 0.75 else mutate_bytes)(data, rng)
    return data


def mutate_json(value: Any, rng: random.Random) -> Any:
    """Replace, drop, repeat or add one value somewhere in a document."""
    if not isinstance(value, dict | list) or not value or rng.random() < 0.1:
        scaled = isinstance(value, int | float) and rng.random() < 0.5
        return value * rng.choice([-1, 0, 1e-9, 1.01, 1e9]) if scaled else rng.choice(JSON_VALUES)
    copy: Any = value.copy()
    key = rng.choice(list(copy)) if isinstance(copy, dict) else rng.randrange(len(copy))
    match rng.randrange(12):
        case 0:
            del copy[key]
        case 1 if isinstance(copy, list):
            copy.append(copy[key])
        case 1:
            copy["surprise"] = rng.choice(JSON_VALUES)
        case _:
            copy[key] = mutate_json(copy[key], rng)
    return copy


def mutate_artefact(folder: Path, rng: random.Random) -> None:
    """Damage one file of an artefact; often its checksums are made to fit."""
    document_path = next(folder.glob("*.json"))
    path = rng.choice(sorted(folder.iterdir())) if rng.random() < 0.3 else document_path
    if path == document_path and rng.random() < 0.8:
        document = mutate_json(json.loads(path.read_bytes()), rng)
        path.write_text(json.dumps(document), encoding="utf-8")
    else:
        path.write_bytes(mutate_bytes(path.read_bytes(), rng))
    if rng.random() < 0.7:
        with contextlib.suppress(ValueError, TypeError, KeyError, AttributeError, RecursionError):
            document = json.loads(document_path.read_bytes())
            if path != document_path:
                document["files"][path.name] = hashlib.sha256(path.read_bytes()).hexdigest()
            document["content_sha256"] = digest(document)
            document_path.write_text(json.dumps(document), encoding="utf-8")


@dataclass
class Findings:
    """Exit codes met, and what must not have happened."""

    codes: Counter[int] = field(default_factory=Counter)
    slowest_s: float = 0.0
    problems: list[str] = field(default_factory=list)

    def judge(self, arguments: list[str], named: str, detail: Callable[[], str]) -> None:
        """Run a command here and judge how it ended."""
        said = io.StringIO()
        started = time.process_time()
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
            code = run(arguments)
        seconds = time.process_time() - started
        self.codes[code] += 1
        self.slowest_s = max(self.slowest_s, seconds if code else 0.0)
        message = said.getvalue()
        wrong = code not in ALLOWED or "Traceback" in message or (code and seconds > MOST_S)
        if wrong or (code in (3, 4) and named not in message):
            said_last = "\n".join(message.splitlines()[-12:])
            self.problems.append(f"{arguments[0]} {code} {seconds:.1f} s: {said_last}\n{detail()}")


def try_config(config: Path, original: bytes, rng: random.Random, findings: Findings) -> None:
    """Check one damaged configuration."""
    damaged = mutate_config(original, rng)
    config.write_bytes(damaged)
    findings.judge(["config", "check", str(config)], config.name, lambda: repr(damaged))


READERS = ("localize",) * 16 + ("mosaic", "mosaic", "slam", "reconstruct")
"""Commands that read artefacts, the quick one most often."""


def try_artefact(
    config: Path,
    reference: Path,
    rng: random.Random,
    findings: Findings,
    readers: tuple[str, ...] = READERS,
) -> None:
    """Give a command a damaged artefact to read."""
    stage = rng.choice(readers)
    upstream = {"localize": "match", "mosaic": "slam", "reconstruct": "mosaic"}.get(
        stage, rng.choice(["match", "overlap"])
    )
    with tempfile.TemporaryDirectory(dir=reference.parent) as folder:
        out = Path(folder)
        for done in STAGES[: STAGES.index(stage)]:
            shutil.copytree(reference / done, out / done)
        mutate_artefact(out / upstream, rng)
        arguments = [stage, str(config), "--out", str(out), "-q", "--jobs", "1"]
        document = next((out / upstream).glob("*.json"))
        findings.judge(arguments, str(out / upstream), lambda: document.read_text()[:3000])


def main() -> int:
    """Try many, report, and fail if anything was wrong."""
    given = [int(argument) for argument in sys.argv[1:]]
    configurations, artefacts, seed = (given + [20_000, 5_000, 0][len(given) :])[:3]
    rng = random.Random(seed)
    configs, read = Findings(), Findings()
    with tempfile.TemporaryDirectory() as folder:
        config = make_small_set(Path(folder) / "set")
        reference = Path(folder) / "reference"
        for stage in STAGES:
            assert run([stage, str(config), "--out", str(reference), "-q"]) == 0
        original = config.read_bytes()
        for _ in range(configurations):
            try_config(config, original, rng, configs)
        config.write_bytes(original)
        for _ in range(artefacts):
            try_artefact(config, reference, rng, read)
    for what, findings in (("configurations", configs), ("artefacts", read)):
        count, codes = sum(findings.codes.values()), dict(sorted(findings.codes.items()))
        print(  # noqa: T201
            f"{count} {what}: exit codes {codes}, slowest refusal {findings.slowest_s:.1f} s, "
            f"{len(findings.problems)} problems",
            *findings.problems[:10],
            sep="\n",
        )
    return int(bool(configs.problems or read.problems))


if __name__ == "__main__":
    sys.exit(main())
