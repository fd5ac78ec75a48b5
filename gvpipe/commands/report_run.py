"""What a report is about: the artefacts of one run that are there."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, cast

from gvpipe.artefacts import Artefact
from gvpipe.chain import scale_source
from gvpipe.config import Config
from gvpipe.core.reconstruct.agreement import ONE_SIDE_DEG
from gvpipe.dataset import Dataset
from gvpipe.names import escape
from gvpipe.records import (
    Body,
    LocalizeBody,
    MatchBody,
    MotionRow,
    ReconstructBody,
    SlamBody,
)

B = TypeVar("B", bound=Body)

DOUBTFUL = 0.5
"""An obstacle whose outline agrees with the silhouettes less than this is warned of."""


@dataclass(frozen=True)
class Run:
    """One run.

    Attributes
    ----------
    config : Config
        Its settings.
    dataset : Dataset
        Its pictures.
    artefacts : dict of str to Artefact
        Fresh artefacts by stage.
    missing : dict of str to str
        Of the other stages: what is wrong, and which command makes it.
    """

    config: Config
    dataset: Dataset
    artefacts: dict[str, Artefact[Any]]
    missing: dict[str, str]

    def get(self, body: type[B]) -> Artefact[B] | None:
        """Artefact of the stage that writes `body`, if it is there."""
        return cast("Artefact[B] | None", self.artefacts.get(body.stage))

    @property
    def title(self) -> str:
        """Name of the output folder, and of the one it lies in."""
        return escape("/".join(Path(self.config.output).parts[-2:]))

    @property
    def known(self) -> bool:
        """Whether all poses were given: the map then does not rest on matches."""
        return scale_source(self.config) == "poses"

    @property
    def motions(self) -> dict[tuple[str, str], MotionRow]:
        """Motions by their pair of images."""
        artefact = self.get(LocalizeBody)
        rows = artefact.body.motions if artefact else ()
        return {(row.image_i, row.image_j): row for row in rows}

    def warnings(self) -> Iterator[str]:
        """Say all that a reader should not overlook."""
        for name, artefact in self.artefacts.items():
            needed = not self.known or name not in ("match", "localize")
            if artefact.header.reason and needed:
                yield f"{name}: no result: {artefact.header.reason}"
        for skipped in self.dataset.skipped:
            yield f"{skipped.image}: skipped: {skipped.reason}"
        yield from self._of_pairs()
        yield from self._of_map()
        yield from self._of_obstacles()

    def _of_pairs(self) -> Iterator[str]:
        match = self.get(MatchBody)
        rejected = [row for row in match.body.pairs if row.status != "ok"] if match else []
        # listed pairs and neighbours are meant to match; of all pairs most never could
        if match and self.config.match.pairs != "exhaustive" and not self.known:
            for row in rejected:
                yield f"{row.image_i} and {row.image_j}: not matched: {row.reason}"

    def _of_map(self) -> Iterator[str]:
        slam = self.get(SlamBody)
        if slam is None:
            return
        if slam.body.components > 1:
            yield f"{slam.body.components} maps that are not connected with each other"
        for image in slam.body.unregistered:
            yield f"{image.image}: on no map: {image.reason}"
        for edge in slam.body.rejected_edges:
            yield f"{edge.image_i} and {edge.image_j}: {edge.kind} left out: {edge.reason}"

    def _of_obstacles(self) -> Iterator[str]:
        found = self.get(ReconstructBody)
        if found is None:
            return
        if found.body.obstacles and not found.body.converged:
            yield f"the surfaces still moved after {found.body.iterations} iterations"
        for row in found.body.obstacles:
            if row.confidence < DOUBTFUL:
                yield f"obstacle {row.id}: doubtful, confidence {row.confidence:.2f}"
            if row.azimuth_span_deg < ONE_SIDE_DEG:
                side = f"from one side only, over {row.azimuth_span_deg:.0f} degrees"
                yield f"obstacle {row.id}: seen {side}; its far side is a guess"
