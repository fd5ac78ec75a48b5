"""Artefact files: canonical JSON, NPZ without pickle, whole or not at all."""

import hashlib
import json
import os
import re
import shutil
import tempfile
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from gvpipe.core.types import Rejected
from gvpipe.errors import InputError
from gvpipe.formats.files import file_sha256, read_regular_file
from gvpipe.output import refuse_link, sync
from gvpipe.records import Body, Header

SCHEMA_VERSION = 1
VOLATILE = ("wall_s", "content_sha256")
"""Keys left out of digests: the time differs between runs, the digest cannot hold itself."""
MAX_JSON_BYTES = 1 << 30
MAX_NPZ_BYTES = 1 << 34
"""Sizes beyond which a file is refused unread: no artefact of ours comes near."""

B = TypeVar("B", bound=Body)


@dataclass(frozen=True)
class Artefact(Generic[B]):
    """A JSON artefact read back.

    Attributes
    ----------
    header : Header
        Provenance.
    body : Body
        The stage's own records.
    folder : Path
        Where its other files lie.
    digest : str
        sha256 of the JSON without its volatile keys.
    """

    header: Header
    body: B
    folder: Path
    digest: str

    def arrays(self, name: str) -> "Members":
        """Load an NPZ file of this artefact."""
        return read_npz(self.folder / name)


class Members(dict[str, NDArray[Any]]):
    """Arrays of an NPZ file by name; asking for one it lacks is an error of the file."""

    def __init__(self, path: Path, arrays: Mapping[str, NDArray[Any]]):
        super().__init__(arrays)
        self._path = path

    def __missing__(self, name: str) -> NDArray[Any]:
        raise InputError(f"{self._path}: lacks the array {name!r}")


def canonical_json(value: Any) -> str:
    """Render JSON the same way every time; lists of plain values stay on one line.

    Raises
    ------
    ValueError
        If a number is not finite.
    """
    return _render(value, 0) + "\n"


def _render(value: Any, depth: int) -> str:
    pad = " " * (depth + 1)
    if isinstance(value, dict) and value:
        rows = (f"{pad}{_scalar(k)}: {_render(v, depth + 1)}" for k, v in value.items())
        return "{\n" + ",\n".join(rows) + f"\n{' ' * depth}}}"
    if isinstance(value, list | tuple):
        nested = any(isinstance(v, dict) for v in value) or any(
            isinstance(v, list | tuple) and any(isinstance(w, list | tuple | dict) for w in v)
            for v in value
        )
        if nested:
            rows = (pad + _render(v, depth + 1) for v in value)
            return "[\n" + ",\n".join(rows) + f"\n{' ' * depth}]"
    return _scalar(value)


def _scalar(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False)


def digest(document: Mapping[str, Any]) -> str:
    """Sha256 of a document's canonical JSON without its volatile keys."""
    kept = {k: v for k, v in document.items() if k not in VOLATILE}
    return hashlib.sha256(canonical_json(kept).encode()).hexdigest()


def read_artefact(folder: Path, body: type[B]) -> Artefact[B]:
    """Read and check one stage's JSON artefact.

    Parameters
    ----------
    folder : Path
        The stage's folder; its JSON has the stage's name.
    body : type
        Which record it must hold.

    Raises
    ------
    InputError
        If the file is missing, unreadable, of another stage or version, or breaks a rule; the
        message names the file and the key.
    """
    path = folder / body.file
    document = _load_json(path)
    expected = schema_of(body)
    if document.get("schema") != expected:
        found = document.get("schema", "none")
        raise InputError(f"{path}: schema: expected {expected!r}, found {found!r}")
    try:
        header_keys = {f.alias or k for k, f in Header.model_fields.items()}
        header = Header.model_validate({k: v for k, v in document.items() if k in header_keys})
        content = body.model_validate({k: v for k, v in document.items() if k not in header_keys})
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise InputError(f"{path}: {key}: {first['msg']}") from None
    for name, want in header.files.items():
        file = folder / name
        if not re.fullmatch(r"[^/\x00]+", name) or not file.is_file():
            raise InputError(f"{file}: missing, though {path.name} lists it")
        if file_sha256(file)[0] != want:
            raise InputError(f"{file}: its content is not what {path.name} recorded")
    try:
        found = digest(document)
    except UnicodeEncodeError:
        raise InputError(f"{path}: not valid JSON: half a surrogate pair") from None
    if header.content_sha256 != found:
        raise InputError(f"{path}: content_sha256: does not fit; it was changed or damaged")
    return Artefact(header, content, folder, found)


def _load_json(path: Path) -> dict[str, Any]:
    """Parse a JSON object strictly."""

    def refuse(constant: str) -> Any:
        raise ValueError(f"{constant} is not JSON")

    if not os.path.lexists(path):
        raise InputError(f"{path}: missing")
    raw = read_regular_file(path, MAX_JSON_BYTES)
    if isinstance(raw, Rejected):
        raise InputError(f"{path}: {raw.reason}")
    try:
        document = json.loads(raw, parse_constant=refuse)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not valid JSON: {error}") from None
    if not isinstance(document, dict):
        raise InputError(f"{path}: expected a JSON object")
    return document


def read_npz(path: Path) -> Members:
    """Load every array of an NPZ file, never unpickling.

    Raises
    ------
    InputError
        If the file is missing, damaged, too large or holds Python objects.
    """
    if not path.is_file():  # a pipe would be waited for
        raise InputError(f"{path}: missing")
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > MAX_NPZ_BYTES:
            raise ValueError(f"would take {size} bytes, more than {MAX_NPZ_BYTES}")
        with np.load(path, allow_pickle=False) as data:
            arrays = Members(path, {name: data[name] for name in data.files})
    except Exception as error:  # parsers of hostile bytes may raise anything
        raise InputError(f"{path}: not a valid NPZ file: {error}") from None
    for name, array in arrays.items():
        if array.dtype.kind in "fc" and not np.isfinite(array).all():
            raise InputError(f"{path}: {name}: expected finite numbers")
    return arrays


def write_npz(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays, compressed, the same bytes for the same content.

    Raises
    ------
    TypeError
        If an array holds Python objects, which would be pickled.
    """
    for name, array in arrays.items():
        if array.dtype.hasobject:
            raise TypeError(f"array {name!r} holds Python objects")
    np.savez_compressed(path, allow_pickle=False, **cast(dict[str, Any], dict(arrays)))


@contextmanager
def staging(out: Path, stage: str) -> Iterator[Path]:
    """Give a private folder to write into; it is removed whatever happens.

    Folders that a killed run of the same stage left behind are swept first, so the caller must
    hold the stage's lock.
    """
    for left in out.glob(f".{stage}.writing-*"):
        shutil.rmtree(left, ignore_errors=True)
    folder = Path(tempfile.mkdtemp(prefix=f".{stage}.writing-", dir=out))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def publish(staged: Path, folder: Path, header: Header, body: Body) -> None:
    """Move a staged artefact into place, its JSON last.

    Each file appears whole by a rename within one file system. The JSON records the checksums of
    the others, so a run killed between two renames leaves an artefact that is seen to be stale.
    """
    files = {p.name: file_sha256(p)[0] for p in sorted(staged.iterdir())}
    document = {
        **header.model_copy(update={"files": files}).model_dump(mode="json", by_alias=True),
        **body.model_dump(mode="json"),
    }
    document["content_sha256"] = digest(document)
    json_name = body.file
    (staged / json_name).write_text(canonical_json(document), encoding="utf-8")
    refuse_link(folder)
    folder.mkdir(parents=True, exist_ok=True)
    outdated = _files_of_previous(folder / json_name) - files.keys()
    for name in [*files, json_name]:  # a full disk shows here, before anything is replaced
        sync(staged / name)
    for name in [*files, json_name]:
        (staged / name).replace(folder / name)
    for name in outdated:
        (folder / name).unlink(missing_ok=True)
    sync(folder)


def _files_of_previous(json_path: Path) -> set[str]:
    """Names of the files an older artefact of the stage consists of; other files are not ours."""
    try:
        listed = _load_json(json_path).get("files")
    except InputError:
        return set()
    names = listed if isinstance(listed, dict) else {}
    return {name for name in names if re.fullmatch(r"[^/\x00]+", name) and name not in (".", "..")}


def schema_of(body: type[Body]) -> str:
    """Name the schema of a stage's JSON."""
    return f"gvpipe/{body.stage}/{SCHEMA_VERSION}"
