"""The chain of stages: what each is made from, and whether what is there is still fresh."""

import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

from gvpipe import __version__
from gvpipe.artefacts import Artefact, read_artefact
from gvpipe.config import Config
from gvpipe.configfile import section_sha256
from gvpipe.dataset import Dataset
from gvpipe.errors import InputError
from gvpipe.names import escape
from gvpipe.records import Body, Header, SkippedImage
from gvpipe.report import log
from gvpipe.stages.contract import Stage

STAGES = ("match", "localize", "overlap", "slam", "mosaic", "reconstruct")
"""All commands of the chain, in their order."""


def stage_module(name: str) -> Stage:
    """Import one stage; importing them lazily keeps the command line quick."""
    return cast(Stage, importlib.import_module(f"gvpipe.stages.{name}"))


@dataclass(frozen=True)
class Expectation:
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


class Chain:
    """Artefacts of one output folder, checked against configuration and images.

    Parameters
    ----------
    config : Config
        The loaded configuration.
    dataset : Dataset
        Its images.
    """

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

    def require(self, chosen: Sequence[str]) -> None:
        """Refuse commands that read what none before them makes, and what is not there.

        Raises
        ------
        InputError
            As the first of them would, but before anything is computed.
        """
        for k, stage in enumerate(chosen):
            for body in stage_module(stage).needs(self._config):
                if body.stage not in chosen[:k]:
                    self._read(body)

    def expectation(self, stage: str) -> Expectation:
        """Work out what the stage's artefact must be made from to be fresh."""
        inputs = {entry.image_id: entry.sha256 for entry in self._dataset.entries}
        inputs |= {f"poses of {r}": h for r, h in self._dataset.pose_files.items()}
        inputs |= {f"{n}/{a.body.file}": a.digest for n, a in self.needed(stage).items()}
        sections = stage_module(stage).SECTIONS
        digest = section_sha256(self._config, sections)
        return Expectation(digest, inputs, unreadable(self._dataset))

    def fresh(self, body: type[Body]) -> Artefact[Any]:
        """Read an artefact and insist that it is up to date."""
        stage = body.stage
        if stage not in self._loaded:
            command = f"gvpipe {stage} CONFIG"
            artefact = self._read(body)
            changed = self.expectation(stage).mismatch(artefact.header)
            if changed:
                path = self.folder(stage) / body.file
                raise InputError(f"{path}: stale, it {changed}; `{command}` makes it anew")
            known = {entry.image_id for entry in self._dataset.entries}
            for image in artefact.body.named_images():
                if image not in known:
                    path = self.folder(stage) / body.file
                    raise InputError(f"{path}: {image!r} is no image; `{command}` makes it anew")
            log.debug("read %s", escape(str(self.folder(stage) / body.file)))
            self._loaded[stage] = artefact
        return self._loaded[stage]

    def _read(self, body: type[Body]) -> Artefact[Any]:
        """Read an artefact, or say which command makes it."""
        try:
            return read_artefact(self.folder(body.stage), body)
        except InputError as error:
            raise InputError(f"{error}; `gvpipe {body.stage} CONFIG` makes it") from None


def unreadable(dataset: Dataset) -> tuple[SkippedImage, ...]:
    """List the images of a dataset that cannot be used, as artefacts record them."""
    return tuple(SkippedImage(image=s.image, reason=s.reason) for s in dataset.skipped)


def scale_source(config: Config) -> Literal["height", "poses", "control"]:
    """Say what fixes the lengths of a run."""
    if all(robot.poses is not None for robot in config.robots.values()):
        return "poses"
    return "control" if config.slam.control else "height"
