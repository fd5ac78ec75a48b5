"""The program: the command line in a process of its own, watched over by a small one."""

import os
import re
import sys

from gvpipe.supervisor import supervised

PARTING = "what is finished stays, run again to go on"
"""Said after Ctrl-C and the like."""


def main() -> None:
    """Run the command line and exit with the documented code."""
    sys.exit(supervised(_command_line, "" if _quiet(sys.argv[1:]) else PARTING))


def _quiet(arguments: list[str]) -> bool:
    """Whether nothing but errors is to be said: `-q`, alone or among short flags."""
    return any(word == "--quiet" or re.match(r"-[a-zA-Z]*q", word) for word in arguments)


def _command_line() -> int:
    # small matrices only: threads of their own would fight with gvpipe's workers for the cores
    for library in ("OPENBLAS", "MKL", "OMP"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    from gvpipe.parallel import spare_housekeeping

    spare_housekeeping()
    from gvpipe.cli import run  # late: a signal during this import is handled already

    return run()


if __name__ == "__main__":
    main()
