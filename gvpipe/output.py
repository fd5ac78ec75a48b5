"""Writing into the output folder: failures that name the path, files whole, one run at a time."""

import errno
import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gvpipe.errors import OutputError
from gvpipe.names import escape


@contextmanager
def writing_to(path: Path) -> Iterator[None]:
    """Turn failures to write into :class:`OutputError` that names what could not be written.

    Parameters
    ----------
    path : Path
        Named where the system does not say which file failed.
    """
    try:
        yield
    except OSError as error:
        where = escape(str(error.filename2 or error.filename or path))
        what = os.strerror(error.errno) if error.errno else str(error)
        raise OutputError(f"{where}: cannot be written: {what}") from error


def sync(path: Path) -> None:
    """Force a file or folder to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def refuse_link(folder: Path) -> None:
    """Refuse to write into a folder that is a link to another place.

    Raises
    ------
    OutputError
        If it is one.
    """
    if folder.is_symlink():
        where = escape(str(folder))
        raise OutputError(f"{where}: is a symbolic link; artefacts are not written through links")


@contextmanager
def locked(out: Path, stage: str) -> Iterator[None]:
    """Let one process at a time write a stage's artefact; the lock ends with its process.

    Parameters
    ----------
    out : Path
        The output folder.
    stage : str
        Whose artefact.

    Raises
    ------
    OutputError
        If another process holds the lock; the message names it.
    """
    path = out / f".{stage}.lock"
    with writing_to(path):
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno not in (errno.EACCES, errno.EAGAIN):
                raise OutputError(f"{escape(str(path))}: {error.strerror}") from error
            holder = escape(os.read(descriptor, 100).decode(errors="replace").strip())
            by = holder or "another process"
            raise OutputError(f"{escape(str(path))}: locked by {by}") from None
        with writing_to(path):
            os.ftruncate(descriptor, 0)
            os.write(descriptor, f"process {os.getpid()}\n".encode())
        yield
        os.ftruncate(descriptor, 0)
    finally:
        os.close(descriptor)
