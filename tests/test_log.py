"""What -q, -v and --log-json let through."""

import json
import re
import shutil
from pathlib import Path

import pytest

from gvpipe.cli import run
from gvpipe.report import Reporter, section_help
from gvpipe.stages.contract import shortened
from tests.conftest import TinySet


@pytest.fixture
def damaged(tiny: TinySet, tmp_path: Path) -> tuple[str, ...]:
    """Arguments of a quick command on three pictures, one of them damaged."""
    (tmp_path / "A").mkdir()
    for k in (0, 1):
        shutil.copyfile(tiny.config.parent / "A" / f"{k}.png", tmp_path / "A" / f"{k}.png")
    (tmp_path / "A" / "2.png").write_bytes(b"damaged")
    (tmp_path / "a.yaml").write_text(tiny.config.read_text().split("  B:")[0])
    return ("match", str(tmp_path / "a.yaml"), "--out", str(tmp_path / "run"))


def test_each_switch_does_what_it_says(
    damaged: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run([*damaged]) == 0
    plain = capsys.readouterr()
    assert "1 of 1 matched" in plain.out
    assert "skipped A/2.png" in plain.err
    assert run([*damaged, "-q", "--force"]) == 0
    quiet = capsys.readouterr()
    assert quiet.out == quiet.err == ""
    assert run([*damaged, "-v", "--set", "seed=1"]) == 0
    verbose = capsys.readouterr()
    assert "runs anew: its artefact was made with another configuration" in verbose.err
    assert "computed in" in verbose.err
    assert run([*damaged, "-v", "--log-json", "--force"]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    assert {row["level"] for row in rows} == {"debug", "warning"}
    assert all(set(row) == {"time", "level", "message"} for row in rows)
    assert run([*damaged, "-q", "-v"]) == 2


def test_errors_are_said_even_in_silence(
    damaged: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["slam", *damaged[1:], "-q"]) == 4
    shown = capsys.readouterr()
    assert shown.out == ""
    assert "`gvpipe match CONFIG` makes it" in shown.err


def test_a_run_of_several_commands_says_each_warning_once(
    damaged: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["run", *damaged[1:], "--stages", "match,localize"]) == 0
    shown = capsys.readouterr()
    assert "gvpipe localize" in shown.out
    assert shown.err.count("skipped A/2.png") == 1


def test_paths_can_be_copied_whatever_the_terminal_is_wide(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    monkeypatch.setenv("COLUMNS", "40")
    deep = "/".join(["a folder"] * 20)
    paths = [here / ".." / "here" / deep / "m.json", here / ".." / "other.json", Path("own.json")]
    Reporter().result("gvpipe x", [("images", "2 used")], paths)
    lines = capsys.readouterr().out.splitlines()
    assert lines[1:] == [
        "images  2 used",
        f"wrote   {deep}/m.json",
        f"wrote   {tmp_path}/other.json",
        "wrote   own.json",
    ]


def test_rows_are_folded_on_a_terminal_only(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "30")
    rows = [("a", "some words that are too long"), ("longer", "1")]
    Reporter().result("gvpipe x", rows, [])
    assert capsys.readouterr().out.splitlines()[1:] == [
        "a       some words that are too long",
        "longer  1",
    ]
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("NO_COLOR", "1")
    Reporter().result("gvpipe x", rows, [])
    plain = re.sub(r"\x1b\[\d*m", "", capsys.readouterr().out).splitlines()
    assert [line.strip() for line in plain[1:]] == [
        "a       some words that are",
        "too long",
        "longer  1",
    ]


def test_a_summary_says_what_it_leaves_out() -> None:
    rows = [(str(k), "x") for k in range(5)]
    assert shortened(rows, 5) == tuple(rows)
    assert shortened(rows, 3) == (*rows[:3], ("", "... and 2 more"))


def test_help_lists_the_words_a_key_may_be(capsys: pytest.CaptureFixture[str]) -> None:
    section_help("overlap")
    assert "absolute, squared, intersection, chi2" in " ".join(capsys.readouterr().out.split())


def test_without_a_terminal_long_work_says_that_it_goes_on(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now = 0.0
    monkeypatch.setattr("gvpipe.report.time.monotonic", lambda: now)
    reporter = Reporter()
    for what in ("first", "second"):  # loops of 20 s each: silence counts, not the loop
        with reporter.progress(what, 2) as ticker:
            for _ in range(2):
                now += 10.0
                ticker.advance()
    assert capsys.readouterr().err.split() == ["INFO", "second:", "1", "of", "2"]
