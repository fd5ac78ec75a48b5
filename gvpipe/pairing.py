"""Match many pairs of a dataset's pictures: features once an image, pairs in parallel."""

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from gvpipe.config import Config
from gvpipe.core.features import Features, MatchOptions
from gvpipe.core.matching import extract, match_views
from gvpipe.core.types import PairMatch, Rejected
from gvpipe.dataset import Dataset
from gvpipe.parallel import Crashed, Workers


@dataclass(frozen=True)
class _Shared:
    """What every worker needs."""

    dataset: Dataset
    options: MatchOptions
    seed: int


@dataclass(frozen=True)
class _Task:
    """One pair with its features."""

    image_i: str
    image_j: str
    features_i: Features
    features_j: Features


def pair_generator(seed: int, image_i: str, image_j: str) -> np.random.Generator:
    """Make the random generator of one pair, the same whoever matches it and when."""
    name = "\0".join((str(seed), image_i, image_j)).encode()
    return np.random.default_rng(int.from_bytes(hashlib.sha256(name).digest()[:16], "big"))


def options_from(config: Config) -> MatchOptions:
    """Take the matcher's settings from the configuration."""
    return MatchOptions(features=config.match.features)


def match_pairs(
    dataset: Dataset,
    pairs: Sequence[tuple[str, str]],
    options: MatchOptions,
    *,
    seed: int,
    jobs: int,
    on_step: Callable[[], object],
) -> Iterator[PairMatch | Rejected]:
    """Yield the verdict on each pair, in order.

    Parameters
    ----------
    dataset : Dataset
        Source of the pictures.
    pairs : sequence of (image id i, image id j)
        What to match.
    options : MatchOptions
        Thresholds and method.
    seed : int
        With the two ids it fixes all random choices of a pair.
    jobs : int
        Worker processes.
    on_step : callable
        Called once an image and once a pair.
    """
    images = list(dict.fromkeys(image for pair in pairs for image in pair))
    with Workers(_Shared(dataset, options, seed), jobs) as workers:
        features: dict[str, Features | Crashed[str]] = {}
        for image, result in zip(images, workers.map(_extract, images), strict=True):
            features[image] = result
            on_step()
        usable = [
            _Task(i, j, fi, fj)
            for i, j in pairs
            if not isinstance(fi := features[i], Crashed)
            and not isinstance(fj := features[j], Crashed)
        ]
        verdicts = workers.map(_match, usable)
        for i, j in pairs:
            on_step()
            crashed = [k for k in (i, j) if isinstance(features[k], Crashed)]
            if crashed:
                yield Rejected(f"the worker process died twice on {crashed[0]}")
                continue
            verdict = next(verdicts)
            if isinstance(verdict, Crashed):
                yield Rejected("the worker process died twice on this pair")
            else:
                yield verdict


def _extract(shared: _Shared, image: str) -> Features:
    return extract(shared.dataset.view(image), shared.options)


def _match(shared: _Shared, task: _Task) -> PairMatch | Rejected:
    return match_views(
        shared.dataset.view(task.image_i),
        shared.dataset.view(task.image_j),
        task.features_i,
        task.features_j,
        shared.options,
        pair_generator(shared.seed, task.image_i, task.image_j),
    )
