"""Run one stage: check what it needs, skip it if fresh, else compute and publish."""

import importlib
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

from gvpipe import __version__
from gvpipe.artefacts import Artefact, publish, read_artefact, schema_of, staging
from gvpipe.checkpoint import Checkpoints
from gvpipe.config import Config
from gvpipe.configfile import section_sha256
from gvpipe.dataset import Dataset, open_dataset
from gvpipe.errors import InputError, NoResultError
from gvpipe.names import escape
from gvpipe.output import locked, writing_to
from gvpipe.records import Body, Header, SkippedImage
from gvpipe.report import Reporter, log
from gvpipe.stages.contract import Context, Stage

STAGES = ("match", "localize", "overlap", "slam", "mosaic", "reconstruct")
"""All commands of the chain, in their order."""


def stage_module(name: str) -> Stage:
    """Import one stage; importing them lazily keeps the command line quick."""
    return cast(Stage, importlib.import_module(f"gvpipe.stages.{name}"))


@dataclass(frozen=True)
class _Expectation:
    """What a fresh artefact must have been made from."""

    config_sha256: str
    inputs: dict[str, str]
    skipped: tuple[SkippedImage, ...]

    def mismatch(self, header: Header) -> str | None:
        """Say what changed since an artefact was made, if anything."""
        if header.gvpipe_version != __version__:
            return f"was made by gvpipe {header.gvpipe_version}"
        if header.config_sha256 != self.config_sha256:
            return "was made with another configuration"
        for name in sorted(self.inputs.keys() ^ header.inputs.keys()):
            return f"{'lacks' if name in self.inputs else 'was made from the missing'} {name}"
        for name, want in self.inputs.items():
            if header.inputs[name] != want:
                return f"was made from another version of {name}"
        if header.skipped != self.skipped:
            return "was made with other images skipped"
        return None


class _Chain:
    """Artefacts of one output folder, checked against configuration and images."""

    def __init__(self, config: Config, dataset: Dataset):
        self._config, self._dataset = config, dataset
        self._loaded: dict[str, Artefact[Any]] = {}

    def folder(self, stage: str) -> Path:
        """Folder of one stage's artefact."""
        return Path(self._config.output) / stage

    def needed(self, stage: str) -> dict[str, Artefact[Any]]:
        """Load everything a stage reads, or say which command makes what is missing."""
        bodies = stage_module(stage).needs(self._config)
        return {body.stage: self.fresh(body) for body in bodies}

    def expectation(self, stage: str) -> _Expectation:
        """Work out what the stage's artefact must be made from to be fresh."""
        inputs = {entry.image_id: entry.sha256 for entry in self._dataset.entries}
        inputs |= {f"poses of {r}": h for r, h in self._dataset.pose_files.items()}
        inputs |= {f"{n}/{a.body.file}": a.digest for n, a in self.needed(stage).items()}
        sections = stage_module(stage).SECTIONS
        digest = section_sha256(self._config, sections)
        return _Expectation(digest, inputs, _unreadable(self._dataset))

    def fresh(self, body: type[Body]) -> Artefact[Any]:
        """Read an artefact and insist that it is up to date."""
        stage = body.stage
        if stage not in self._loaded:
            command = f"gvpipe {stage} CONFIG"
            try:
                artefact = read_artefact(self.folder(stage), body)
            except InputError as error:
                raise InputError(f"{error}; `{command}` makes it") from None
            changed = self.expectation(stage).mismatch(artefact.header)
            if changed:
                path = self.folder(stage) / body.file
                raise InputError(f"{path}: stale, it {changed}; `{command}` makes it anew")
            self._loaded[stage] = artefact
        return self._loaded[stage]


def run_stage(
    name: str, config: Config, reporter: Reporter, *, jobs: int, force: bool = False
) -> None:
    """Run one command of the chain.

    Parameters
    ----------
    name : str
        One of :data:`STAGES`.
    config : Config
        The loaded configuration.
    reporter : Reporter
        Progress and results.
    jobs : int
        Worker processes or threads.
    force : bool
        Run even if the artefact is fresh.

    Raises
    ------
    InputError, NoResultError, OutputError, ConfigError
        See :mod:`gvpipe.errors`.
    """
    out = Path(config.output)
    with writing_to(out):
        out.mkdir(parents=True, exist_ok=True)
    with locked(out, name):
        started = time.monotonic()
        dataset = _opened(config, jobs)
        chain = _Chain(config, dataset)
        upstream = chain.needed(name)
        expected = chain.expectation(name)
        folder = chain.folder(name)
        checkpoints = Checkpoints(out / f".{name}.checkpoints")
        fresh = None if force else _fresh(folder, name, expected)
        if fresh:
            checkpoints.sweep()  # a run killed right after it had published left them
            with writing_to(folder):
                (folder / fresh.body.file).touch()  # Make goes by time
            unchanged = ("fresh", "nothing has changed since it was made")
            reporter.result(f"gvpipe {name}", (unchanged,), [])
            return _conclude(name, fresh.header.reason)
        if force:
            checkpoints.sweep()
        context = Context(config, dataset, upstream, jobs, reporter.progress, checkpoints)
        stage = stage_module(name)
        outcome = stage.run(context)
        header = Header(
            schema_id=schema_of(stage.BODY),
            gvpipe_version=__version__,
            config_sha256=expected.config_sha256,
            inputs=expected.inputs,
            files={},
            seed=config.seed,
            scale_source=_scale_source(config),
            wall_s=round(time.monotonic() - started, 3),
            skipped=expected.skipped,
            reason=outcome.no_result,
        )
        with writing_to(folder), staging(out, name) as staged:
            stage.write(outcome, staged)
            names = sorted(p.name for p in staged.iterdir())
            publish(staged, folder, header, outcome.body)
        checkpoints.sweep()
    rows = [
        ("images", f"{len(dataset.entries)} used, {len(header.skipped)} skipped"),
        *outcome.summary,
        ("time", f"{time.monotonic() - started:.1f} s"),
    ]
    if checkpoints.reused:
        rows.append(("resumed", f"{checkpoints.reused} items were done by an interrupted run"))
    reporter.result(f"gvpipe {name}", rows, [folder / n for n in (outcome.body.file, *names)])
    return _conclude(name, outcome.no_result)


def _conclude(name: str, no_result: str | None) -> None:
    """End without an error only if there is a result."""
    if no_result:
        raise NoResultError(f"{name}: no result: {no_result}")


def _opened(config: Config, jobs: int) -> Dataset:
    """Open the images, and say which cannot be used."""
    try:
        dataset = open_dataset(config, jobs=jobs)
    except OSError as error:
        raise InputError(f"{escape(str(error.filename))}: {error.strerror}") from error
    for skipped in dataset.skipped:
        log.warning("skipped %s: %s", skipped.image, skipped.reason)
    return dataset


def _unreadable(dataset: Dataset) -> tuple[SkippedImage, ...]:
    return tuple(SkippedImage(image=s.image, reason=s.reason) for s in dataset.skipped)


def _fresh(folder: Path, name: str, expected: _Expectation) -> Artefact[Any] | None:
    """Read the artefact that is there, if it is what would be made."""
    try:
        artefact = read_artefact(folder, stage_module(name).BODY)
    except InputError:
        return None
    return None if expected.mismatch(artefact.header) else artefact


def _scale_source(config: Config) -> Literal["height", "poses", "control"]:
    if all(robot.poses is not None for robot in config.robots.values()):
        return "poses"
    return "control" if config.slam.control else "height"
