"""What a command says while it works and at its end: progress, tables, logs."""

import json
import logging
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from rich.cells import cell_len
from rich.console import Console
from rich.logging import RichHandler
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table
from rich.text import Text

from gvpipe.errors import UsageError

HEARTBEAT_S = 30.0
"""Without a terminal, long work says this often that it is alive."""

log = logging.getLogger("gvpipe")


def printable(text: str) -> str:
    """Escape control characters, so that no file name can steer the terminal."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def shortest(path: Path) -> str:
    """Name a path from the current folder on if it lies below it, else in full; without ``..``."""
    try:
        here = Path.cwd()
    except OSError:  # the folder is gone
        return str(path)
    full = path.resolve() if ".." in path.parts else path.absolute()
    return str(full.relative_to(here) if full.is_relative_to(here) else full)


class _Lines(logging.Formatter):
    """One line a message, whatever names it holds."""

    def format(self, record: logging.LogRecord) -> str:
        return printable(super().format(record))


class _JsonLines(logging.Formatter):
    """One JSON object a line."""

    def format(self, record: logging.LogRecord) -> str:
        row = {
            "time": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(record.created)),
            "level": record.levelname.lower(),
            "message": record.getMessage(),
        }
        return json.dumps(row, ensure_ascii=True)


class _Once(logging.Filter):
    """Lets each warning pass once: the commands of one run meet the same pictures."""

    def __init__(self) -> None:
        super().__init__()
        self._said: set[str] = set()

    def filter(self, record: logging.LogRecord) -> bool:
        if record.levelno != logging.WARNING:
            return True
        message = record.getMessage()
        new = message not in self._said
        self._said.add(message)
        return new


class _Console(Console):
    """A console whose reader may leave."""

    def on_broken_pipe(self) -> None:
        """Go on in silence: whoever read the output has seen enough."""
        self.quiet = True
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, self.file.fileno())
        os.close(nowhere)


class Reporter:
    """Progress and results of one command.

    Parameters
    ----------
    quiet : bool
        Only errors.
    verbose : bool
        Also details.
    log_json : bool
        Log lines as JSON objects on standard error.

    Raises
    ------
    UsageError
        If it is to say both less and more.
    """

    def __init__(self, *, quiet: bool = False, verbose: bool = False, log_json: bool = False):
        if quiet and verbose:
            raise UsageError("--quiet and --verbose exclude each other")
        self.quiet = quiet
        self._out = _Console(soft_wrap=True, highlight=False)
        self._err = _Console(stderr=True, soft_wrap=True, highlight=False)
        self._live = self._err.is_terminal and not quiet and not log_json
        handler: logging.Handler
        if log_json:
            handler = logging.StreamHandler(sys.stderr)
            handler.setFormatter(_JsonLines())
        elif self._live:  # goes round the progress bar
            handler = RichHandler(
                console=self._err,
                show_time=False,
                show_path=False,
                markup=False,
                rich_tracebacks=False,
            )
            handler.setFormatter(_Lines("%(message)s"))
        else:
            handler = logging.StreamHandler(sys.stderr)
            handler.setFormatter(_Lines("%(levelname)-8s %(message)s"))
        handler.addFilter(_Once())
        self._spoke = time.monotonic()
        log.handlers[:] = [handler]
        log.propagate = False
        log.setLevel(logging.ERROR if quiet else logging.DEBUG if verbose else logging.INFO)

    @contextmanager
    def progress(self, what: str, total: int) -> Iterator["Ticker"]:
        """Show how far a loop is: a bar on a terminal, a line now and then elsewhere."""
        if not self._live:
            yield Ticker(what, total, self._alive)
            return
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
        )
        with Progress(*columns, console=self._err, transient=True) as bar:
            task = bar.add_task(what, total=total)
            yield _BarTicker(lambda n: bar.advance(task, n))

    def _alive(self, message: str) -> None:
        """Log a sign of life if nothing has been said for long, be it by an earlier loop."""
        now = time.monotonic()
        if now - self._spoke >= HEARTBEAT_S:
            self._spoke = now
            log.info("%s", message)

    def result(self, title: str, rows: Sequence[tuple[str, str]], paths: Sequence[Path]) -> None:
        """Print the closing table of a command and the files it wrote."""
        self._spoke = time.monotonic()
        if self.quiet:
            return
        keys = [printable(key) for key, _ in rows]
        width = max(map(cell_len, [*keys, "wrote"])) + 2
        self._out.print(Text(title, style="bold"))
        for key, (_, value) in zip(keys, rows, strict=True):
            self._row(key, Text(printable(value)), width, fold=self._out.is_terminal)
        for path in paths:  # never folded: a path is to be copied
            self._row("wrote", Text(printable(shortest(path))), width, fold=False)

    def _row(self, key: str, value: Text, width: int, *, fold: bool) -> None:
        """Print a key in bold and its value beside it, folded at the terminal's edge or not."""
        room = max(self._out.width - width, 20)
        for k, line in enumerate(value.wrap(self._out, room, overflow="fold") if fold else [value]):
            head = key if k == 0 else ""
            self._out.print(Text(head + " " * (width - cell_len(head)), style="bold"), end="")
            self._out.print(line)

    def text(self, lines: str) -> None:
        """Print lines that are to be copied, as they are."""
        for line in lines.splitlines() if not self.quiet else ():
            self._out.print(Text(printable(line)))


class Ticker:
    """Counts the steps of a loop and tells now and then how far it is."""

    def __init__(self, what: str, total: int, tell: Callable[[str], object]):
        self._what, self._total, self._done, self._tell = what, total, 0, tell
        self.advance(0)

    def advance(self, steps: int = 1) -> None:
        """Count `steps` more."""
        self._done += steps
        self._tell(f"{self._what}: {self._done} of {self._total}")


class _BarTicker(Ticker):
    """Moves a progress bar instead."""

    def __init__(self, move: Callable[[int], object]):
        self._move = move

    def advance(self, steps: int = 1) -> None:
        """Move the bar by `steps`."""
        self._move(steps)


def section_help(section: str) -> None:
    """Print the keys of a configuration section: default, meaning and unit."""
    from gvpipe.config import Config

    model = type(Config.model_fields[section].default)
    table = Table(title=f"{section}: in CONFIG, or by --set {section}.KEY=VALUE", box=None)
    table.title_justify = "left"
    for heading in ("key", "default", "meaning, unit"):
        table.add_column(heading, justify="left", overflow="fold")
    for key, field in model.model_fields.items():
        meaning = field.description or ""
        choices = _choices(field.annotation)
        if not all(choice in meaning for choice in choices):
            meaning = f"{meaning}: {', '.join(choices)}"
        shown = "null" if field.default is None else str(field.default).strip("()")
        table.add_row(Text(key), Text(shown), Text(meaning))
    Console(highlight=False).print(table)


def _choices(annotation: Any) -> list[str]:
    """List the words that a key may be, also those beside something else."""
    if get_origin(annotation) is Literal:
        return [str(choice) for choice in get_args(annotation)]
    return [word for part in get_args(annotation) for word in _choices(part)]
