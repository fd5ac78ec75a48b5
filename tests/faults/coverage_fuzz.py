"""Search for configurations that break the reader, led by coverage (needs atheris).

python -m tests.faults.coverage_fuzz [LIBFUZZER OPTIONS]
"""

import sys
import tempfile
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["gvpipe"]):
    from gvpipe.configfile import load_config
    from gvpipe.errors import GvpipeError


def main() -> None:
    """Give the reader whatever bytes reach new code."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "c.yaml"

        def once(data: bytes) -> None:
            path.write_bytes(data)
            try:
                load_config(path)
            except GvpipeError as error:
                if error.exit_code not in (2, 3, 4) or path.name not in str(error):
                    raise RuntimeError("an error without its file or of the wrong kind") from error

        atheris.Setup(sys.argv, once)
        atheris.Fuzz()


if __name__ == "__main__":
    main()
