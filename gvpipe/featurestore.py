"""Features of pictures that are matched more than once in a run."""

from gvpipe.core.matching.features import Features, MatchOptions

STORE_BYTES = 64 << 20
"""Features kept: those of some two hundred pictures."""


class FeatureStore:
    """Keeps the features of the first pictures; once it is full, others are made anew each time.

    Parameters
    ----------
    most_bytes : int
        What it may hold.

    Notes
    -----
    Were the most recent ones kept instead, all that the next stage begins with would be gone: every
    stage begins with the first picture.
    """

    def __init__(self, most_bytes: int = STORE_BYTES):
        self._room = most_bytes
        self._kept: dict[tuple[str, MatchOptions], Features] = {}

    def get(self, image: str, options: MatchOptions) -> Features | None:
        """Return what is kept of a picture, if anything is."""
        return self._kept.get((image, options))

    def add(self, image: str, options: MatchOptions, features: Features) -> None:
        """Keep the features of a picture if there is room."""
        size = features.nbytes
        if size <= self._room and (image, options) not in self._kept:
            self._room -= size
            self._kept[image, options] = features
