"""Finished items of a stage, kept so that an interrupted run continues where it stopped."""

import dataclasses
import hashlib
import io
import json
import os
import platform
import shutil
import zipfile
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from gvpipe.output import refuse_link, writing_to

_PLAIN = "plain"
"""Member of a checkpoint that holds, as JSON, all fields that are not arrays."""

_DIGEST_BYTES = 32


class Checkpoints:
    """Results of single items, found again by the content they were made from.

    Parameters
    ----------
    folder : Path
        Where they are kept, hidden in the output folder; its user holds the stage's lock. It is
        made with the first checkpoint and removed by :meth:`sweep`.

    Attributes
    ----------
    reused : int
        How many results of an earlier run were found.

    Notes
    -----
    One file an item, whole by a rename, with a checksum over key and content. No forced write to
    the disk: a file that a power failure damaged is as if it had never been there.
    """

    def __init__(self, folder: Path):
        self._folder = folder
        self.reused = 0

    def key(self, *parts: object) -> str:
        """Name everything that decides an item's result; the code itself is added.

        Parameters
        ----------
        *parts : object
            Values whose `repr` is complete and the same in every process.
        """
        return hashlib.sha256(repr((_code_sha256(), *parts)).encode()).hexdigest()

    def load(self, key: str, *kinds: type[Any]) -> Any:
        """Find the result of an item, of one of these dataclasses; None if no sound one is kept."""
        try:
            content = self._path(key).read_bytes()
        except OSError:
            return None
        head, body = content[:_DIGEST_BYTES], content[_DIGEST_BYTES:]
        if head != _checksum(key, body):
            return None
        try:
            record = _unpack(body, kinds)
        except (ValueError, KeyError, TypeError, zipfile.BadZipFile):
            return None
        self.reused += 1
        return record

    def save(self, key: str, record: Any) -> None:
        """Keep the result of an item.

        Parameters
        ----------
        key : str
            From :meth:`key`.
        record : dataclass
            Its fields are arrays without objects, or what JSON can hold.

        Raises
        ------
        OutputError
            If it cannot be written.
        """
        body = _pack(record)
        path = self._path(key)
        unfinished = path.with_suffix(".unfinished")
        with writing_to(path):
            refuse_link(self._folder)
            self._folder.mkdir(exist_ok=True)
            flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC
            with open(os.open(unfinished, flags, 0o666), "wb") as stream:  # noqa: PTH123
                stream.write(_checksum(key, body) + body)
            unfinished.replace(path)

    def sweep(self) -> None:
        """Remove all checkpoints: the artefact they were made for is whole."""
        shutil.rmtree(self._folder, ignore_errors=True)

    def _path(self, key: str) -> Path:
        return self._folder / key


def _checksum(key: str, body: bytes) -> bytes:
    return hashlib.sha256(key.encode() + body).digest()


def _pack(record: Any) -> bytes:
    """Write a dataclass as NPZ bytes."""
    fields = {f.name: getattr(record, f.name) for f in dataclasses.fields(record)}
    arrays = {name: v for name, v in fields.items() if isinstance(v, np.ndarray)}
    plain = {name: v for name, v in fields.items() if name not in arrays}
    text = json.dumps([type(record).__name__, plain], default=lambda number: number.item())
    stream = io.BytesIO()
    members: dict[str, Any] = {_PLAIN: np.frombuffer(text.encode(), np.uint8), **arrays}
    np.savez_compressed(stream, allow_pickle=False, **members)
    return stream.getvalue()


def _unpack(body: bytes, kinds: tuple[type[Any], ...]) -> Any:
    """Undo :func:`_pack`; tuples come back as lists."""
    with np.load(io.BytesIO(body), allow_pickle=False) as data:
        arrays = {name: data[name] for name in data.files}
    name, plain = json.loads(arrays.pop(_PLAIN).tobytes())
    by_name = {kind.__name__: kind for kind in kinds}
    return by_name[name](**plain, **arrays)


@cache
def _code_sha256() -> str:
    """Hash gvpipe's own source and name the libraries that results depend on."""
    import cv2
    import numba
    import scipy

    package = Path(__file__).parent
    digest = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        digest.update(str(path.relative_to(package)).encode() + b"\0" + path.read_bytes() + b"\0")
    libraries = (np, scipy, cv2, numba)
    versions = [platform.python_version(), platform.machine(), *(m.__version__ for m in libraries)]
    digest.update(" ".join(versions).encode())
    return digest.hexdigest()
