"""What the commands of one run share: the images, their features, and processes that have them."""

from contextlib import ExitStack
from functools import cached_property
from typing import Self

from gvpipe.config import Config
from gvpipe.configcheck import doubts
from gvpipe.dataset import Dataset, open_dataset
from gvpipe.errors import InputError
from gvpipe.featurestore import FeatureStore
from gvpipe.names import escape
from gvpipe.parallel import Workers
from gvpipe.report import log


class Session:
    """Owns what outlives a command; each part is made when it is first asked for.

    Parameters
    ----------
    config : Config
        The loaded configuration.
    jobs : int
        Worker processes or threads.
    """

    def __init__(self, config: Config, jobs: int):
        self.config, self.jobs = config, jobs
        self.features = FeatureStore()
        self._open = ExitStack()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._open.close()

    @cached_property
    def dataset(self) -> Dataset:
        """The images; errors as of :func:`open_images`."""
        return open_images(self.config, self.jobs)

    @cached_property
    def workers(self) -> Workers[Dataset]:
        """Processes that have the images."""
        return self._open.enter_context(Workers(self.dataset, self.jobs))

    def make_room(self) -> None:
        """End the processes and forget the features; who needs them again pays for them again."""
        self.workers.stop()
        self.features = FeatureStore()


def open_images(config: Config, jobs: int) -> Dataset:
    """Open the images, and say which cannot be used and what of their settings is doubtful.

    Raises
    ------
    InputError, ConfigError
        If a robot has no usable image, or the configuration names one that is not there.
    """
    try:
        dataset = open_dataset(config, jobs=jobs)
    except OSError as error:
        raise InputError(f"{escape(str(error.filename))}: {error.strerror}") from error
    for robot, entries in dataset.robots.items():
        first = entries[0].camera
        log.debug("%s: %d pictures of %dx%d", robot, len(entries), first.width, first.height)
    for doubt in doubts(config):
        log.warning("%s", doubt)
    for skipped in dataset.skipped:
        log.warning("skipped %s: %s", skipped.image, skipped.reason)
    return dataset
