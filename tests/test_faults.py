"""Faults: interruption, death, full disks, little memory, broken and degenerate input.

The long versions are `make faults` and `make fuzz`; what is here is bounded.
"""

import ast
import errno
import json
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import gvpipe
from gvpipe import checkpoint, output
from gvpipe.__main__ import PARTING, _quiet
from gvpipe.artefacts import digest, read_artefact
from gvpipe.checkpoint import Checkpoints
from gvpipe.cli import run
from gvpipe.configfile import load_config
from gvpipe.core.geometry.pose import planar_pose
from gvpipe.core.types import Mount
from gvpipe.dataset import open_dataset
from gvpipe.errors import UsageError
from gvpipe.memory import PROCESS_BYTES, jobs_within, parse_size
from gvpipe.parallel import Crashed, Workers
from gvpipe.records import MatchBody, OverlapBody
from gvpipe.report import Reporter
from gvpipe.supervisor import GRACE_S
from tests.faults.broken import add_broken_images
from tests.faults.fulldisk import small_disk, trial
from tests.faults.fuzz import Findings, try_artefact, try_config
from tests.faults.kills import Target, kill_and_resume
from tests.faults.rig import CAMERA, STAGES, make_small_set, snapshot, write_png
from tests.faults.rig import run as start_and_wait
from tests.synthetic import Scene, texture

BRIEF = settings(
    max_examples=40,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Configuration of the small set, matched and localized."""
    config = make_small_set(tmp_path_factory.mktemp("small"))
    for stage in STAGES[:2]:
        assert run([stage, str(config), "-q", "--jobs", "1"]) == 0
    return config


def reference(config: Path) -> Path:
    return config.parent / "run"


# Interruption and death


def test_an_interrupted_run_continues_where_it_stopped(
    small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    save, saved = Checkpoints.save, []

    def save_and_stop(self: Checkpoints, key: str, record: object) -> None:
        save(self, key, record)
        saved.append(key)
        if len(saved) == 2:
            raise KeyboardInterrupt

    command = ["match", str(small), "--out", str(tmp_path), "--jobs", "1"]
    with monkeypatch.context() as patched:
        patched.setattr(Checkpoints, "save", save_and_stop)
        assert run(command) == 130
    assert {p.name for p in tmp_path.iterdir()} == {".match.lock", ".match.checkpoints"}
    assert run(command) == 0
    assert "2 items were done" in capsys.readouterr().out
    assert snapshot(tmp_path, ("match",)) == snapshot(reference(small), ("match",))
    assert {p.name for p in tmp_path.iterdir()} == {".match.lock", "match"}


def test_other_code_starts_anew(
    small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = Checkpoints(tmp_path)
    before = kept.key("pair")
    monkeypatch.setattr(checkpoint, "_code_sha256", lambda: "other code")
    assert kept.key("pair") != before


def test_killed_runs_leave_nothing_partial_and_lose_nothing(small: Path, tmp_path: Path) -> None:
    target = Target(tmp_path, small, {"match": 3.0})
    figures = kill_and_resume(target, "match", 2, random.Random(5))
    assert not figures.problems
    assert figures.resumed == 1


def test_what_kills_its_worker_twice_is_recorded(
    small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    undisturbed = Workers.map

    def deadly(self: Workers[Any], function: Any, items: Sequence[Any]) -> Iterator[Any]:
        for item in items:
            image = item[0] if isinstance(item, tuple) else item
            dies = image == "B/2.png" or getattr(item, "image_j", "") == "A/1.png"
            yield Crashed(item) if dies else next(undisturbed(self, function, [item]))

    monkeypatch.setattr(Workers, "map", deadly)
    for stage in ("match", "overlap"):
        assert run([stage, str(small), "--out", str(tmp_path), "-q", "--jobs", "1"]) == 0
    had = read_artefact(reference(small) / "match", MatchBody).body.pairs
    have = read_artefact(tmp_path / "match", MatchBody).body.pairs
    reasons = [row.reason for row in have]
    assert reasons[0] == "the worker process died twice on this pair"
    assert reasons[3] == "the worker process died twice on B/2.png"
    assert [row.model_dump_json() for row in have[1:3]] == [r.model_dump_json() for r in had[1:3]]
    overlap = read_artefact(tmp_path / "overlap", OverlapBody)
    assert [row.image for row in overlap.body.left_out] == ["B/2.png"]
    assert "B/2.png" not in overlap.arrays("overlap.npz")["image_ids"]
    assert any(row.validated for row in overlap.body.overlaps[0].candidates)


SUPERVISED = """
import atexit, ctypes, os, signal, sys, time
from gvpipe import cli, supervisor
def deaf():
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT, signal.SIGTERM])
    print("ready", flush=True)
    time.sleep(60)
def die(number):
    os.kill(os.getpid(), number)
    time.sleep(60)
def swallow():
    def load(*arguments, **options):
        try:
            print("ready", flush=True)
            time.sleep(60)
        except BaseException:
            raise ImportError("initialization failed") from None
    cli.app = load
    return cli.run([])
def obey():
    signal.signal(signal.SIGINT, lambda number, frame: os._exit(130))
    print("ready", flush=True)
    time.sleep(60)
def owe():
    atexit.register(lambda: print("done", file=sys.stderr))
    print("owed")
    return 5
supervisor.GRACE_S = {grace_s}
sys.exit(supervisor.supervised(lambda: {work}, {parting!r}))
"""


def supervised(work: str, grace_s: float = GRACE_S, parting: str = "") -> subprocess.Popen[str]:
    program = SUPERVISED.format(work=work, grace_s=grace_s, parting=parting)
    command = [sys.executable, "-c", program]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_process_that_does_not_listen_is_ended_in_time(number: int, code: int) -> None:
    process = supervised("deaf()")
    assert process.stdout
    assert process.stdout.readline() == "ready\n"
    process.send_signal(number)
    started = time.monotonic()
    assert process.wait(10) == code
    assert time.monotonic() - started < 2.0
    process.communicate()


@pytest.mark.parametrize(
    ("number", "said"), [(signal.SIGINT, "interrupted"), (signal.SIGTERM, "terminated")]
)
@pytest.mark.parametrize("work", ["deaf()", "swallow()"])
def test_a_signal_ends_in_one_line(work: str, number: int, said: str) -> None:
    process = supervised(work, grace_s=0.2, parting=PARTING)
    assert process.stdout
    assert process.stdout.readline() == "ready\n"
    process.send_signal(number)
    assert process.communicate(timeout=10)[1] == f"gvpipe: {said}; {PARTING}\n"


@pytest.mark.parametrize(
    ("arguments", "quiet"),
    [("run a.yaml -q", True), ("run a.yaml -fq", True), ("run --quiet a.yaml", True)]
    + [(f"run {name} --out q", False) for name in ("q.yaml", "a-q.yaml")],
)
def test_quiet_is_told_from_the_command_line(arguments: str, quiet: bool) -> None:
    assert _quiet(arguments.split()) == quiet


def test_what_a_signal_breaks_is_no_defect() -> None:
    process = supervised("swallow()")
    assert process.stdout
    assert process.stdout.readline() == "ready\n"
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=10)
    assert (process.returncode, err) == (143, "")


def test_signals_just_when_it_ends_are_harmless() -> None:
    for _ in range(10):
        process = supervised("obey()", grace_s=0.001)
        assert process.stdout
        assert process.stdout.readline() == "ready\n"
        process.send_signal(signal.SIGINT)  # it ends about when it would be killed
        process.send_signal(signal.SIGTERM)
        _, err = process.communicate(timeout=10)
        assert (process.returncode, err) == (130, "")


@pytest.mark.parametrize(
    ("work", "code", "said"),
    [
        ("5", 5, ""),
        ("die(signal.SIGKILL)", 7, "memory"),
        ("die(signal.SIGSEGV)", 1, "SIGSEGV"),
        ("die(signal.SIGTERM)", 143, ""),
        ("os.write(2, b'libpng error') and 0", 0, ""),
    ],
)
def test_every_end_has_its_code(work: str, code: int, said: str) -> None:
    process = supervised(work)
    _, err = process.communicate(timeout=10)
    assert process.returncode == code
    assert said in err
    assert bool(said) == bool(err)


def test_what_is_due_at_the_end_is_done() -> None:
    process = supervised("owe()")
    assert process.communicate(timeout=10) == ("owed\n", "done\n")
    assert process.returncode == 5


# Output


def test_a_full_disk_leaves_what_was_there(small: Path) -> None:
    try:
        with small_disk(1):
            pass
    except OSError as error:
        pytest.skip(f"no file system can be mounted here: {error}")
    for leave, old in [(0, False), (2, True), (3, False)]:
        assert not trial("localize", small, reference(small), leave, old=old)


def test_a_read_only_folder_is_named(small: Path, tmp_path: Path, capsys) -> None:  # type: ignore[no-untyped-def]
    out = tmp_path / "sealed"
    out.mkdir(mode=0o555)
    if os.geteuid() == 0:
        try:
            with small_disk(4) as disk:
                subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
                assert run(["match", str(small), "--out", str(disk)]) == 6
                assert str(disk) in capsys.readouterr().err
        except OSError as error:
            pytest.skip(f"no file system can be mounted here: {error}")
    else:
        assert run(["match", str(small), "--out", str(out)]) == 6
        assert str(out) in capsys.readouterr().err


def test_a_folder_without_permission_is_named(small: Path, tmp_path: Path) -> None:
    sealed = tmp_path / "sealed"
    sealed.mkdir(mode=0o555)
    command = [sys.executable, "-m", "gvpipe", "match", str(small), "--out", str(sealed / "new")]
    if os.geteuid() == 0:  # permissions bind root only without this power
        if shutil.which("setpriv") is None:
            pytest.skip("needs setpriv")
        command = ["setpriv", "--bounding-set=-dac_override", *command]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 6
    assert ended.stderr == f"gvpipe: {sealed / 'new'}: cannot be written: Permission denied\n"


def test_a_failing_disk_leaves_the_old_artefact(
    small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(reference(small), tmp_path / "run")
    before = snapshot(tmp_path / "run", STAGES[:2])

    def fail(descriptor: int) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(output.os, "fsync", fail)
    command = ["localize", str(small), "--out", str(tmp_path / "run"), "--force"]
    assert run(command) == 6
    assert "run/localize: cannot be written: Input/output error" in capsys.readouterr().err
    assert snapshot(tmp_path / "run", STAGES[:2]) == before
    assert not list((tmp_path / "run").glob("*.writing-*"))


def test_locks_are_not_followed_through_links(small: Path, tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("mine")
    (tmp_path / ".match.lock").symlink_to(tmp_path / "precious")
    assert run(["match", str(small), "--out", str(tmp_path)]) == 6
    assert (tmp_path / "precious").read_text() == "mine"


# Memory


@pytest.mark.parametrize(
    ("text", "size"),
    [
        ("1", 1),
        ("2k", 2048),
        ("500M", 500 << 20),
        ("1.5G", 3 << 29),
        ("2 GiB", None),
        ("2GiB", 2 << 30),
    ],
)
def test_sizes(text: str, size: int | None) -> None:
    if size is None:
        with pytest.raises(UsageError):
            parse_size(text)
    else:
        assert parse_size(text) == size


@pytest.mark.parametrize("text", ["", "0", "-1G", "G", "1Q", "1e9", "nan", "٣M", "9" * 50])
def test_what_is_no_size(text: str) -> None:
    with pytest.raises(UsageError, match="for example"):
        parse_size(text)


def test_little_memory_means_fewer_jobs() -> None:
    assert jobs_within(1, 8) == 1
    assert jobs_within(4 * PROCESS_BYTES, 8) == 3
    assert jobs_within(100 * PROCESS_BYTES, 8) == 8


def test_a_memory_limit_is_kept(small: Path, tmp_path: Path) -> None:
    ended = start_and_wait("match", small, "--out", str(tmp_path), "--memory-limit", "60M")
    assert ended.code == 7
    assert "memory limit of 60 MB" in ended.err
    assert len(ended.err.splitlines()) == 1


def test_running_out_of_memory_ends_with_7(
    small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def greedy(*arguments: object, **options: object) -> None:
        raise np.exceptions.AxisError(0) if not arguments else MemoryError

    monkeypatch.setattr("gvpipe.session.open_dataset", greedy)
    assert run(["match", str(small), "--out", str(tmp_path)]) == 7
    assert "memory" in capsys.readouterr().err


# Input


@BRIEF
@given(rng=st.randoms(use_true_random=False))
def test_damaged_configurations_get_a_code_and_a_message(
    small: Path, tmp_path: Path, rng: random.Random
) -> None:
    findings = Findings()
    try_config(tmp_path / "damaged.yaml", small.read_bytes(), rng, findings)
    assert not findings.problems


@BRIEF
@given(rng=st.randoms(use_true_random=False))
def test_damaged_artefacts_get_a_code_and_a_message(small: Path, rng: random.Random) -> None:
    findings = Findings()
    try_artefact(small, reference(small), rng, findings, ("localize",))
    assert not findings.problems


def test_broken_images_are_listed_and_change_nothing(small: Path, tmp_path: Path) -> None:
    shutil.copytree(small.parent, tmp_path / "mixed")
    count = add_broken_images(tmp_path / "mixed" / "A")
    alone = open_dataset(load_config(small))
    mixed = open_dataset(load_config(tmp_path / "mixed" / small.name), jobs=2)
    assert [e.image_id for e in mixed.entries] == [e.image_id for e in alone.entries]
    assert [e.sha256 for e in mixed.entries] == [e.sha256 for e in alone.entries]
    assert len(mixed.skipped) == count == 40
    for skipped in mixed.skipped:
        assert skipped.reason
        assert skipped.image.isprintable()


def photographs(folder: Path, tilt_deg: float, stops: list[tuple[float, float, float]]) -> None:
    rng = np.random.default_rng(1)
    scene = Scene(texture(rng))
    for k, (x, y, yaw_deg) in enumerate(stops):
        mount = Mount(np.radians(tilt_deg), 0.0, 0.6)
        picture = scene.photograph(planar_pose(x, y, np.radians(yaw_deg), mount), CAMERA)
        write_png(folder / f"{k}.png", picture)


def flat(folder: Path) -> None:
    for k in range(2):
        write_png(folder / f"{k}.png", np.full((CAMERA.height, CAMERA.width, 3), 120, np.uint8))


def collinear(folder: Path) -> None:
    for k in range(2):
        picture = np.full((CAMERA.height, CAMERA.width, 3), 200, np.uint8)
        picture[90:96, ::16] = 20
        write_png(folder / f"{k}.png", picture)


def identical(folder: Path) -> None:
    photographs(folder, 40.0, [(0, 0, 0)])
    shutil.copy(folder / "0.png", folder / "1.png")


def straight_down(folder: Path) -> None:
    photographs(folder, 90.0, [(0, 0, 0), (0.1, 0.03, 10)])


def level(folder: Path) -> None:
    photographs(folder, 0.01, [(0, 0, 0), (0.1, 0.03, 10)])


def alone(folder: Path) -> None:
    photographs(folder, 40.0, [(0, 0, 0)])


@pytest.mark.parametrize(
    ("make", "tilt_deg", "codes"),
    [
        (flat, 40, [5, 5, 0, 5, 4, 4]),
        (collinear, 40, None),
        (identical, 40, [0, 0, 0, 0, 0]),
        (straight_down, 90, [0, 0, 0, 0, 0]),
        (level, 0.01, None),
        (alone, 40, [5, 5, 0, 0, 0, 5]),
    ],
)
def test_degenerate_geometry_ends_in_words(
    make: Callable[[Path], None],
    tilt_deg: float,
    codes: list[int] | None,
    small: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "A").mkdir()
    make(tmp_path / "A")
    lines = [line for line in small.read_text().splitlines() if not line.startswith("  B:")]
    config = tmp_path / "c.yaml"
    config.write_text("\n".join(lines).replace("tilt: 43.0", f"tilt: {tilt_deg}"))
    chain = STAGES if codes is None else STAGES[: len(codes)]
    ended = [run([stage, str(config), "-q", "--jobs", "1"]) for stage in chain]
    # what the priors on tilt and height still fix may match; without a result it says so
    assert ended == codes if codes else set(ended) <= {0, 4, 5}
    assert "Traceback" not in capsys.readouterr().err


def test_an_artefact_that_names_no_image_is_refused(small: Path, tmp_path: Path, capsys) -> None:  # type: ignore[no-untyped-def]
    shutil.copytree(reference(small) / "match", tmp_path / "match")
    path = tmp_path / "match" / "match.json"
    document = json.loads(path.read_bytes())
    document["pairs"][0]["image_i"] = "A/9.png"
    document["content_sha256"] = digest(document)
    path.write_text(json.dumps(document))
    assert run(["localize", str(small), "--out", str(tmp_path)]) == 4
    assert f"{path}: 'A/9.png' is no image; `gvpipe match" in capsys.readouterr().err


# Discretion


def test_nothing_reaches_for_the_network(
    small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*arguments: object, **options: object) -> None:
        raise AssertionError("the network is not ours")

    for name in ("socket", "create_connection", "getaddrinfo"):
        monkeypatch.setattr(socket, name, refuse)
    for stage in STAGES[:2]:
        command = [stage, str(small), "--out", str(tmp_path), "--jobs", "1", "-q"]
        assert run(command) == 0
    package = Path(gvpipe.__file__).parent
    barred = {"socket", "urllib", "http", "requests", "ftplib", "pickle", "marshal", "shelve"}
    for path in package.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not {name.split(".")[0] for name in names} & barred, path


def test_a_defect_shows_neither_variables_nor_control_characters(
    small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(*arguments: object, **options: object) -> None:
        password = "sesame" + str(len(arguments))
        raise RuntimeError(f"\x1b[31mred of {len(password)}")

    monkeypatch.setattr("gvpipe.session.open_dataset", broken)
    assert run(["match", str(small), "--out", str(tmp_path)]) == 1
    said = capsys.readouterr().err
    assert "RuntimeError" in said
    assert "defect" in said
    assert "sesame1" not in said
    assert "\x1b" not in said


def test_names_are_shown_as_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    name = "[red]A[/red] :smile: \x1b[2J\r\n"
    Reporter().result("gvpipe", [(name, name)], [Path(name)])
    shown = capsys.readouterr().out
    assert shown.count("[red]A[/red] :smile: \\x1b[2J\\r\\n") == 3
    assert "\x1b" not in shown
