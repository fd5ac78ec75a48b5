"""Dry runs say what would happen, and change nothing."""

from pathlib import Path

import pytest

from gvpipe.cli import run
from gvpipe.configfile import load_config
from gvpipe.dataset import open_dataset
from gvpipe.plan import estimate
from tests.conftest import STAGES, TinySet


def said(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert run([*arguments, "--dry-run"]) == 0
    return " ".join(capsys.readouterr().out.split())


def test_a_dry_run_before_anything_names_what_is_missing_and_writes_nothing(
    tiny: TinySet,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("COLUMNS", "400")  # no folded paths
    out = tmp_path / "run"
    text = said(capsys, "slam", str(tiny.config), "--out", str(out))
    assert "match/match.json: missing; `gvpipe match CONFIG` makes it" in text
    assert "overlap/overlap.json: missing; `gvpipe overlap CONFIG` makes it" in text
    assert "slam cannot run before what it reads is fresh" in text
    text = said(capsys, "match", str(tiny.config), "--out", str(out))
    assert "match would run" in text
    assert "pairs 11" in text
    assert not out.exists()


def test_a_dry_run_of_several_commands_knows_what_runs_before(
    tiny: TinySet,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("COLUMNS", "400")
    out = tmp_path / "run"
    text = said(capsys, "run", str(tiny.config), "--out", str(out))
    assert "slam would run: after what it reads" in text
    assert "cannot run" not in text
    assert "commands 6 of 6 would run time about" in text
    # the matches that all of these need are nobody's task
    some = said(capsys, "run", str(tiny.config), "--out", str(out), "--stages", "slam,mosaic")
    assert "slam cannot run" in some
    assert "mosaic cannot run" in some
    assert not out.exists()


def test_a_dry_run_after_everything_finds_nothing_to_do(
    chain: TinySet, capsys: pytest.CaptureFixture[str]
) -> None:
    for stage in STAGES:
        text = said(capsys, stage, str(chain.config))
        assert f"{stage} fresh, nothing to do" in text
        assert "time" not in text
    assert "commands 0 of 6 would run" in said(capsys, "run", str(chain.config))
    text = said(capsys, "reconstruct", str(chain.config), "--force")
    assert "reconstruct would run: forced" in text
    changed = said(capsys, "mosaic", str(chain.config), "--set", "mosaic.resolution=0.01")
    assert "mosaic would run" in changed
    assert "another configuration" in changed


def test_estimates_grow_with_the_work(tiny: TinySet) -> None:
    config = load_config(tiny.config)
    dataset = open_dataset(config)
    more = load_config(tiny.config, ("match.pairs=exhaustive", "reconstruct.grid=[200,200,100]"))
    for stage in ("match", "reconstruct"):
        seconds, size = estimate(stage, config, dataset, 1)
        longer, larger = estimate(stage, more, dataset, 1)
        assert 0 < seconds <= longer
        assert 0 < size <= larger
    assert estimate("match", config, dataset, 2)[0] < estimate("match", config, dataset, 1)[0]
