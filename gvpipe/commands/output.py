"""Files that tools write: whole or not at all."""

import os
import tempfile
from pathlib import Path
from typing import Any

from gvpipe.artefacts import canonical_json
from gvpipe.errors import OutputError
from gvpipe.names import escape
from gvpipe.report import Reporter


def write_file(path: Path, content: bytes | str) -> None:
    """Write a file under its final name only once it is complete.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    data = content.encode("utf-8", "surrogateescape") if isinstance(content, str) else content
    try:
        descriptor, name = tempfile.mkstemp(prefix=f".{path.name[:100]}.", dir=path.parent)
        try:
            with os.fdopen(descriptor, "wb") as stream:
                stream.write(data)
            mask = os.umask(0)
            os.umask(mask)
            Path(name).chmod(0o666 & ~mask)
            Path(name).replace(path)
        except BaseException:
            Path(name).unlink(missing_ok=True)
            raise
    except OSError as error:
        raise OutputError(f"{escape(str(path))}: cannot be written: {error.strerror}") from error


def finish(
    what: str,
    rows: list[tuple[str, str]],
    document: dict[str, Any],
    json_path: Path | None,
    reporter: Reporter,
) -> None:
    """Write the numbers, print the table."""
    if json_path is not None:
        write_file(json_path, canonical_json(document))
    reporter.result(f"gvpipe {what}", rows, [json_path] if json_path else [])
