"""What every stage receives and returns."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Literal, Protocol, TypeVar, cast

from gvpipe.artefacts import Artefact
from gvpipe.checkpoint import Checkpoints
from gvpipe.config import Config
from gvpipe.core.types import Pose, PosedView
from gvpipe.dataset import Dataset
from gvpipe.featurestore import FeatureStore
from gvpipe.parallel import Workers
from gvpipe.records import Body, SlamBody

B = TypeVar("B", bound=Body)
P = TypeVar("P")


class Ticker(Protocol):
    """Counts the steps of a loop."""

    def advance(self, steps: int = 1) -> None:
        """Count `steps` more."""


@dataclass(frozen=True)
class Context:
    """All a stage may use.

    Attributes
    ----------
    config : Config
        The whole configuration; a stage reads only the sections it declares.
    dataset : Dataset
        The images.
    upstream : mapping
        Fresh artefacts of the stages it needs, by name.
    jobs : int
        Threads it may use; results do not depend on it.
    workers : Workers
        As many processes, which have the dataset.
    progress : callable
        ``progress(what, total)`` gives a context manager with a ticker.
    checkpoints : Checkpoints
        Finished items of an interrupted run.
    features : FeatureStore
        Made of the same pictures by other stages of this run.
    """

    config: Config
    dataset: Dataset
    upstream: Mapping[str, Artefact[Any]]
    jobs: int
    workers: Workers[Dataset]
    progress: Callable[[str, int], AbstractContextManager[Ticker]]
    checkpoints: Checkpoints
    features: FeatureStore

    def artefact(self, body: type[B]) -> Artefact[B]:
        """Return the artefact of the stage that writes `body`."""
        return cast(Artefact[B], self.upstream[body.stage])


@dataclass(frozen=True)
class Outcome(Generic[B, P]):
    """What a stage found, before it is written.

    Attributes
    ----------
    body : Body
        The JSON's own part.
    payload : object
        Whatever the stage's `write` turns into further files.
    no_result : str or None
        Why there is no result, if there is none.
    summary : tuple of (str, str)
        Rows of the closing table.
    """

    body: B
    payload: P
    no_result: str | None = None
    summary: tuple[tuple[str, str], ...] = ()


class Stage(Protocol):
    """A module of :mod:`gvpipe.stages`."""

    SECTIONS: tuple[str, ...]
    """Configuration sections the stage reads; a change elsewhere leaves its artefact fresh."""
    BODY: type[Body]
    """Record it writes."""
    PARALLEL: Literal["processes", "threads"] | None
    """How it uses several cores. Threads share what they hold: a stage that works by them is one
    that needs memory, and has it to itself."""

    def needs(self, config: Config) -> tuple[type[Body], ...]:
        """Artefacts it reads."""

    def run(self, context: Context) -> Outcome[Any, Any]:
        """Compute, without writing."""

    def write(self, outcome: Outcome[Any, Any], folder: Path) -> None:
        """Write the files beside the JSON into a staging folder."""


def shortened(rows: Sequence[tuple[str, str]], most: int) -> tuple[tuple[str, str], ...]:
    """Keep the first `most` rows of a summary, and say how many more there are."""
    more = len(rows) - most
    return (*rows[:most], *((("", f"... and {more} more"),) if more > 0 else ()))


def main_component(slam: SlamBody) -> int:
    """Return the component with most images; the first of them if several are as large."""
    sizes = Counter(row.component for row in slam.poses)
    return min(sizes, key=lambda component: (-sizes[component], component), default=0)


def posed_views(
    dataset: Dataset, slam: SlamBody, *, photograph_only: bool = False
) -> list[PosedView]:
    """Read the pictures of the main component with their poses, in the order of the poses.

    Parameters
    ----------
    dataset, slam : Dataset, SlamBody
        Pictures and poses.
    photograph_only : bool
        Blacken what lies outside the photograph after undistortion; else its border goes on.
    """
    component = main_component(slam)
    views = []
    for row in slam.poses:
        if row.component == component:
            view = dataset.view(row.image)
            inside = dataset.inside(row.image) if photograph_only else None
            pixels = view.pixels if inside is None else view.pixels * inside[..., None]
            views.append(PosedView(row.image, pixels, view.camera, Pose(row.R, row.t)))
    return views
