"""Bytes of a file that may be anything: a pipe, a device, too large, gone."""

import hashlib
import os
import stat
from pathlib import Path

from gvpipe.core.types import Rejected


def read_regular_file(path: Path, max_bytes: int, first: int | None = None) -> bytes | Rejected:
    """Read a regular file without ever waiting for a pipe or touching a device.

    Parameters
    ----------
    path : Path
        Any name; a link is followed.
    max_bytes : int
        Larger files are refused.
    first : int, optional
        Read this many bytes at most, whatever the file's size.

    Returns
    -------
    raw : bytes or Rejected
        The reason reads well after the file's name and a colon.
    """
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            return Rejected("is not a regular file")
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        with open(descriptor, "rb") as file:  # noqa: PTH123  a descriptor, not a path
            found = os.fstat(descriptor)
            if not stat.S_ISREG(found.st_mode):
                return Rejected("is not a regular file")
            if first is not None:
                return file.read(min(first, found.st_size))
            if found.st_size > max_bytes:
                return Rejected(f"is {found.st_size} bytes; at most {max_bytes} are read")
            # a kernel's file, in /proc, says 0 and holds something else at every look
            return file.read(found.st_size)
    except OSError as error:
        return Rejected(f"cannot be read: {error.strerror}")
    except ValueError as error:
        return Rejected(f"cannot be read: {error}")


def file_sha256(path: Path) -> tuple[str, int]:
    """SHA-256 (hexadecimal) and size in bytes of a file of any size."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest(), os.fstat(file.fileno()).st_size
