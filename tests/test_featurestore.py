"""Features are kept for those who ask again, within bounds."""

import numpy as np

from gvpipe.core.matching.features import Features, MatchOptions
from gvpipe.featurestore import FeatureStore


def features(count: int) -> Features:
    return Features("sift", np.zeros((count, 2)), np.zeros((count, 2)), np.zeros((count, 8)), 0.0)


def test_what_fits_is_kept_and_the_rest_is_not() -> None:
    small, large, options = features(10), features(1000), MatchOptions()
    assert small.nbytes == 10 * (2 + 2 + 8) * 8
    store = FeatureStore(most_bytes=2 * small.nbytes)
    for image, made in (("a", small), ("b", large), ("c", small), ("d", small)):
        store.add(image, options, made)
    assert store.get("a", options) is small
    assert store.get("b", options) is None
    assert store.get("c", options) is small
    assert store.get("d", options) is None


def test_other_settings_make_other_features() -> None:
    store = FeatureStore()
    store.add("a", MatchOptions(), features(1))
    assert store.get("a", MatchOptions(keypoints=7)) is None
