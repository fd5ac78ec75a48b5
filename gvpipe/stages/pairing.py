"""Match many pairs of pictures: features once an image, pairs in parallel."""

import hashlib
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from gvpipe.core.matching.features import Features, MatchOptions
from gvpipe.core.matching.matchers import extract, match_views
from gvpipe.core.types import PairMatch, Rejected
from gvpipe.dataset import Dataset
from gvpipe.parallel import Crashed
from gvpipe.stages.contract import Context

BLOCK = 1000
"""Pairs matched before the features of pictures that no later pair needs are let go: neighbours of
any number of pictures take no more memory than those of a thousand."""

_Described = dict[str, Features | Crashed[tuple[str, MatchOptions]]]


@dataclass(frozen=True)
class _Pair:
    """One pair to be matched, with its features."""

    image_i: str
    image_j: str
    features_i: Features
    features_j: Features
    options: MatchOptions
    seed: int


def count_steps(pairs: Sequence[tuple[str, str]]) -> int:
    """How often :func:`match_pairs` calls `on_step`: once an image and once a pair."""
    return len({image for pair in pairs for image in pair}) + len(pairs)


def match_pairs(
    context: Context, pairs: Sequence[tuple[str, str]], on_step: Callable[[], object]
) -> Iterator[PairMatch | Rejected]:
    """Yield the verdict on each pair, in order.

    Parameters
    ----------
    context : Context
        Verdicts of an earlier run and features of the same pictures are taken from there, and new
        ones added.
    pairs : sequence of (image id i, image id j)
        What to match.
    on_step : callable
        Called :func:`count_steps` times.
    """
    options = MatchOptions(features=context.config.match.features)
    keys = {pair: _key(context, pair, options) for pair in pairs}
    known: dict[tuple[str, str], PairMatch | Rejected | None] = {
        pair: context.checkpoints.load(key, PairMatch, Rejected) for pair, key in keys.items()
    }
    wanted = {image for pair in pairs if known[pair] is None for image in pair}
    last = {image: k for k, pair in enumerate(pairs) for image in pair}
    features: _Described = {}
    begun: set[str] = set()
    for start in range(0, len(pairs), BLOCK):
        block = pairs[start : start + BLOCK]
        new = [x for x in dict.fromkeys(x for pair in block for x in pair) if x not in begun]
        begun.update(new)
        features |= _described(context, new, wanted, options, on_step)
        usable = [
            _Pair(i, j, fi, fj, options, context.config.seed)
            for i, j in block
            if known[i, j] is None
            and not isinstance(fi := features[i], Crashed)
            and not isinstance(fj := features[j], Crashed)
        ]
        verdicts = context.workers.map(_match, usable)
        for pair in block:
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
            context.checkpoints.save(keys[pair], result)
            yield result
        features = {x: made for x, made in features.items() if last[x] >= start + BLOCK}


def _described(
    context: Context,
    images: Sequence[str],
    wanted: Collection[str],
    options: MatchOptions,
    on_step: Callable[[], object],
) -> _Described:
    """Features of the wanted images: those that are kept, and new ones."""
    store = context.features
    features: _Described = {
        image: kept for image in images if (kept := store.get(image, options)) is not None
    }
    new = [image for image in images if image in wanted and image not in features]
    extracted = context.workers.map(_extract, [(image, options) for image in new])
    for image in images:
        if image in wanted and image not in features:
            made = features[image] = next(extracted)
            if not isinstance(made, Crashed):
                store.add(image, options, made)
        on_step()
    return features


def _key(context: Context, pair: tuple[str, str], options: MatchOptions) -> str:
    """Name all that decides the verdict on a pair."""
    views = [
        (e.image_id, e.sha256, e.source.frame, e.camera, e.source.distortion, e.mount)
        for e in map(context.dataset.entry, pair)
    ]
    return context.checkpoints.key("pair", views, options, context.config.seed)


def _generator(seed: int, image_i: str, image_j: str) -> np.random.Generator:
    """Make the random generator of one pair, the same whoever matches it and when."""
    name = "\0".join((str(seed), image_i, image_j)).encode()
    return np.random.default_rng(int.from_bytes(hashlib.sha256(name).digest()[:16], "big"))


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
        _generator(pair.seed, pair.image_i, pair.image_j),
    )
