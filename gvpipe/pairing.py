"""Match many pairs of a dataset's pictures: features once an image, pairs in parallel."""

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from gvpipe.checkpoint import Checkpoints
from gvpipe.config import Config
from gvpipe.core.matching.features import Features, MatchOptions
from gvpipe.core.matching.matchers import extract, match_views
from gvpipe.core.types import PairMatch, Rejected
from gvpipe.dataset import Dataset
from gvpipe.featurestore import FeatureStore
from gvpipe.parallel import Crashed, Workers


@dataclass(frozen=True)
class _Pair:
    """One pair to be matched, with its features."""

    image_i: str
    image_j: str
    features_i: Features
    features_j: Features
    options: MatchOptions
    seed: int


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
    workers: Workers[Dataset],
    checkpoints: Checkpoints,
    store: FeatureStore,
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
    workers : Workers
        Processes that have the same dataset.
    checkpoints : Checkpoints
        Verdicts of an earlier run; every new one is added.
    store : FeatureStore
        Features made before of the same pictures; new ones are added.
    on_step : callable
        Called once an image and once a pair.
    """
    keys = {(i, j): _key(checkpoints, dataset, i, j, options, seed) for i, j in pairs}
    known: dict[tuple[str, str], PairMatch | Rejected | None] = {
        pair: checkpoints.load(key, PairMatch, Rejected) for pair, key in keys.items()
    }
    images = list(dict.fromkeys(image for pair in pairs for image in pair))
    wanted = {image for pair in pairs if known[pair] is None for image in pair}
    features: dict[str, Features | Crashed[tuple[str, MatchOptions]]] = {
        image: kept for image in images if (kept := store.get(image, options)) is not None
    }
    new = [image for image in images if image in wanted and image not in features]
    extracted = workers.map(_extract, [(image, options) for image in new])
    for image in images:
        if image in wanted and image not in features:
            made = features[image] = next(extracted)
            if not isinstance(made, Crashed):
                store.add(image, options, made)
        on_step()
    usable = [
        _Pair(i, j, fi, fj, options, seed)
        for i, j in pairs
        if known[i, j] is None
        and not isinstance(fi := features[i], Crashed)
        and not isinstance(fj := features[j], Crashed)
    ]
    verdicts = workers.map(_match, usable)
    for pair in pairs:
        on_step()
        if (verdict := known[pair]) is not None:
            yield verdict
            continue
        crashed = [image for image in pair if isinstance(features[image], Crashed)]
        if crashed:
            yield Rejected(f"the worker process died twice on {crashed[0]}")
            continue
        result = next(verdicts)
        if isinstance(result, Crashed):
            yield Rejected("the worker process died twice on this pair")
            continue
        checkpoints.save(keys[pair], result)
        yield result


def _key(
    checkpoints: Checkpoints,
    dataset: Dataset,
    image_i: str,
    image_j: str,
    options: MatchOptions,
    seed: int,
) -> str:
    """Name all that decides the verdict on a pair."""
    views = [
        (e.image_id, e.sha256, e.source.frame, e.camera, e.source.distortion, e.mount)
        for e in (dataset.entry(image_i), dataset.entry(image_j))
    ]
    return checkpoints.key("pair", views, options, seed)


def _extract(dataset: Dataset, image: tuple[str, MatchOptions]) -> Features:
    name, options = image
    return extract(dataset.view(name), options)


def _match(dataset: Dataset, pair: _Pair) -> PairMatch | Rejected:
    return match_views(
        dataset.view(pair.image_i),
        dataset.view(pair.image_j),
        pair.features_i,
        pair.features_j,
        pair.options,
        pair_generator(pair.seed, pair.image_i, pair.image_j),
    )
