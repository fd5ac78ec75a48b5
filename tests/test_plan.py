"""Dry runs say what would happen, and change nothing."""

from pathlib import Path

import pytest

from gvpipe.cli import run
from gvpipe.configfile import load_config
from gvpipe.dataset import open_dataset
from gvpipe.plan import estimate
from tests.conftest import STAGES, TinySet


def said(capsys: pytest.CaptureFixture[str], *arguments: str, code: int = 0) -> str:
    assert run([*arguments, "--dry-run"]) == code
    return " ".join(capsys.readouterr().out.split())


def test_a_dry_run_before_anything_names_what_is_missing_and_writes_nothing(
    tiny: TinySet,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("COLUMNS", "400")  # no folded paths
    out = tmp_path / "run"
    text = said(capsys, "slam", str(tiny.config), "--out", str(out), code=4)
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
    part = [str(tiny.config), "--out", str(out), "--stages", "slam,mosaic"]
    some = said(capsys, "run", *part, code=4)
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
    finer = [str(chain.config), "--set", "mosaic.resolution=0.01"]
    changed = said(capsys, "mosaic", *finer)
    assert "mosaic would run" in changed
    assert "another configuration" in changed
    stale = said(capsys, "reconstruct", *finer, code=4)
    assert "reconstruct cannot run" in stale


def test_a_dry_run_ends_with_the_exit_code_of_the_run(
    tiny: TinySet, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for arguments in (["slam"], ["reconstruct"], ["run", "--stages", "mosaic,reconstruct"]):
        command = [*arguments, str(tiny.config), "--out", str(tmp_path / "run")]
        assert run(command) == 4
        capsys.readouterr()
        assert run([*command, "--dry-run"]) == 4
        # of all that is missing, what is to be made first
        assert "match.json: missing; `gvpipe match CONFIG` makes it" in capsys.readouterr().err


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
