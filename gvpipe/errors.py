"""The errors a user can cause or meet, and the exit code each one ends with."""

from typing import ClassVar

EXIT_CODES = (
    "Exit codes: 0 done; 1 a defect in gvpipe; 2 wrong command line; 3 wrong configuration or "
    "calibration; 4 an input is missing, unreadable or stale; 5 ran, but there is no result; "
    "6 the output cannot be written; 7 a resource limit was hit; 130 interrupted; 143 terminated."
)

EXIT_DEFECT, EXIT_INTERRUPTED, EXIT_TERMINATED = 1, 130, 143
"""The codes that no expected failure has; the others stand with the errors below."""


class GvpipeError(Exception):
    """Base of all expected failures; printed as one message, never as a traceback."""

    exit_code: ClassVar[int] = EXIT_DEFECT


class UsageError(GvpipeError):
    """The command line is wrong."""

    exit_code = 2


class ConfigError(GvpipeError):
    """The configuration or a calibration is wrong; the message lists every error found."""

    exit_code = 3


class InputError(GvpipeError):
    """An input is missing, unreadable or stale."""

    exit_code = 4


class NoResultError(GvpipeError):
    """The stage ran, but there is no result; its JSON artefact is written and says why."""

    exit_code = 5


class OutputError(GvpipeError):
    """The output cannot be written: full, read-only or locked by another run."""

    exit_code = 6


class ResourceError(GvpipeError):
    """A configured resource limit was hit."""

    exit_code = 7
