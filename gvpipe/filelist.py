"""The files that an ``images:`` entry stands for: a folder, a glob or one file."""

import fnmatch
import os
from collections.abc import Iterator
from pathlib import Path

from gvpipe.errors import InputError
from gvpipe.names import escape, natural_key

_MAGIC = frozenset("*?[")


def list_files(path: Path) -> tuple[Path, ...]:
    """Files under a folder (not below its subfolders), matching a glob, or the one file named.

    Parameters
    ----------
    path : Path
        A name that exists is taken as it is, even if it holds glob characters. In a glob, ``**``
        stands for any subfolders; links to folders are not followed by it.

    Returns
    -------
    files : tuple of Path
        In natural order of their names; hidden ones and folders left out. Pipes, devices and
        broken links are among them.

    Raises
    ------
    InputError
        If there is nothing of that name, or the folder cannot be read.
    """
    try:
        if path.is_dir():
            found = [child for child in _children(path) if not child.is_dir()]
        elif os.path.lexists(path):
            return (path,)
        elif not _is_glob(path):
            raise InputError(f"{escape(str(path))}: no such file or folder")
        else:
            root = Path(path.anchor or ".")
            matches = dict.fromkeys(_match(root, path.parts[1 if path.anchor else 0 :]))
            found = [match for match in matches if not match.is_dir()]
    except OSError as error:
        raise InputError(f"{escape(str(path))}: cannot be read: {error.strerror}") from error
    return tuple(sorted(found, key=lambda p: (natural_key(p.name), natural_key(str(p)))))


def _is_glob(path: Path) -> bool:
    """Whether the part of a path that does not exist holds glob characters."""
    parts = []
    while not os.path.lexists(path) and path.name:
        parts.append(path.name)
        path = path.parent
    return not _MAGIC.isdisjoint("".join(parts))


def _children(folder: Path) -> list[Path]:
    """Visible entries of a folder."""
    return [child for child in folder.iterdir() if not child.name.startswith(".")]


def _match(folder: Path, parts: tuple[str, ...]) -> Iterator[Path]:
    """Paths below a folder that match the parts of a glob."""
    if not parts:
        yield folder
        return
    part, rest = parts[0], parts[1:]
    if part == "**":
        yield from _match(folder, rest)
        for child in _children(folder):
            if child.is_dir() and not child.is_symlink():
                yield from _match(child, parts)
    elif _MAGIC.isdisjoint(part) or os.path.lexists(folder / part):
        if os.path.lexists(folder / part):
            yield from _match(folder / part, rest)
    elif folder.is_dir():
        for child in _children(folder):
            if fnmatch.fnmatchcase(child.name, part):
                yield from _match(child, rest)
