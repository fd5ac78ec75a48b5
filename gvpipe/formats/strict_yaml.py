"""Strict YAML with positions: plain data only, and every mistake at once.

A subset of YAML 1.2's core schema is read from PyYAML's event stream without recursion: no tags,
no aliases, no duplicate keys, one document, bounded size and depth. ``on``, ``yes`` and ``NO``
stay text, ``1e3`` is a number, ``017`` is text.
"""

import json
import re
from collections.abc import Collection
from dataclasses import dataclass, field

import yaml

MAX_BYTES = 1 << 20
"""Largest file accepted; a configuration is a few kilobytes."""

MAX_DEPTH = 32
"""Deepest nesting accepted; a configuration needs six levels."""

MAX_VALUES = 30_000
"""Most keys and values accepted: two seconds of reading; a list of pairs may be long."""

KeyPath = tuple[str | int, ...]
"""Keys and list positions from the root to a value."""

_INT = re.compile(r"[-+]?(0|[1-9][0-9]*)\Z")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+\.[0-9]*|[0-9]+(?=[eE]))([eE][-+]?[0-9]+)?\Z")
_LONGEST_INT = 300  # digits; beyond that a float says "infinite" and no time is lost
_PLAIN = re.compile(r"[A-Za-z0-9_/.~][A-Za-z0-9_/.~@+-]*\Z")
_UNWRITABLE = re.compile("[\x7f-\x9f\u2028\u2029\ufeff\ufffe\uffff\ud800-\udfff]")
_WORDS: dict[str, object] = {"": None, "~": None}
for _word, _value in (("null", None), ("true", True), ("false", False)):
    _WORDS |= {_word: _value, _word.capitalize(): _value, _word.upper(): _value}
for _sign in ("", "+", "-"):
    for _word in (".inf", ".Inf", ".INF"):
        _WORDS[_sign + _word] = float(_sign + "inf")
for _word in (".nan", ".NaN", ".Nan", ".NAN"):
    _WORDS[_word] = float("nan")


@dataclass(frozen=True, order=True)
class Mark:
    """A position in a text, both counted from 1."""

    line: int
    column: int


@dataclass(frozen=True)
class Problem:
    """One mistake: where, under which key path, and what."""

    mark: Mark
    path: KeyPath
    message: str


@dataclass
class Document:
    """What a text holds, where each part stands, and what is wrong with it.

    Attributes
    ----------
    value : object
        Dicts with text keys, lists, str, int, float, bool and None; incomplete if there are
        problems.
    key_marks, value_marks : dict
        Position of each key (of each item in a list) and of each value.
    problems : list of Problem
        In the order of the text; empty if the text is sound.
    complete : bool
        False if reading had to stop before the end of the text.
    """

    value: object = None
    key_marks: dict[KeyPath, Mark] = field(default_factory=dict)
    value_marks: dict[KeyPath, Mark] = field(default_factory=dict)
    problems: list[Problem] = field(default_factory=list)
    complete: bool = False


def parse_bytes(raw: bytes, tags: Collection[str] = ()) -> Document:
    """Parse UTF-8 bytes; see :func:`parse_text`."""
    if len(raw) > MAX_BYTES:
        message = f"{len(raw)} bytes; expected at most {MAX_BYTES}"
        return Document(problems=[Problem(Mark(1, 1), (), message)])
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        before = raw[: error.start]
        mark = Mark(before.count(b"\n") + 1, error.start - before.rfind(b"\n"))
        message = f"byte 0x{raw[error.start]:02x} is not UTF-8; expected UTF-8 text"
        return Document(problems=[Problem(mark, (), message)])
    return parse_text(text, tags)


def parse_text(text: str, tags: Collection[str] = ()) -> Document:
    """Parse one YAML document.

    Parameters
    ----------
    text : str
        The YAML.
    tags : collection of str
        Full names of tags that are allowed and ignored.

    Returns
    -------
    document : Document
        Syntax errors are problems of it, not exceptions.
    """
    builder = _Builder(tags)
    try:
        for event in yaml.parse(text, Loader=yaml.SafeLoader):
            if not builder.take(event):
                return builder.document
        builder.document.complete = True
    except yaml.MarkedYAMLError as error:
        what = " ".join(part for part in (error.context, error.problem) if part)
        builder.problem(error.problem_mark or error.context_mark, f"is not valid YAML: {what}")
    except yaml.reader.ReaderError as error:
        before = text[: error.position]
        mark = Mark(before.count("\n") + 1, error.position - before.rfind("\n"))
        message = f"character U+{ord(text[error.position]):04X} is not allowed in YAML"
        builder.document.problems.append(Problem(mark, (), message))
    except (RecursionError, ValueError) as error:
        builder.problem(None, f"cannot be read as YAML: {type(error).__name__}")
    return builder.document


@dataclass
class _Level:
    """An open mapping or list."""

    container: dict[str, object] | list[object]
    path: KeyPath
    key: str | None = None


class _Builder:
    """Turns YAML events into plain data."""

    def __init__(self, tags: Collection[str]) -> None:
        self.document = Document()
        self._tags = tags
        self._levels: list[_Level] = []
        self._documents = 0
        self._values = 0

    def problem(self, mark: object, message: str, path: KeyPath | None = None) -> None:
        """Record a mistake at a PyYAML mark."""
        path = self._next_path() if path is None else path
        self.document.problems.append(Problem(_mark(mark), path, message))

    def take(self, event: yaml.Event) -> bool:
        """Add one event; False if reading on is pointless."""
        self._values += isinstance(event, yaml.NodeEvent)
        if self._values > MAX_VALUES:
            self.problem(event.start_mark, f"more than {MAX_VALUES} keys and values", ())
            return False
        if isinstance(event, yaml.DocumentStartEvent):
            self._documents += 1
            if self._documents > 1:
                self.problem(event.start_mark, "a second document begins; expected one")
                return False
        elif isinstance(event, yaml.AliasEvent):
            self.problem(event.start_mark, f"alias *{event.anchor}; expected the value itself")
            self._place(None, event)
        elif isinstance(event, yaml.ScalarEvent):
            return self._scalar(event)
        elif isinstance(event, yaml.CollectionStartEvent):
            return self._open(event)
        elif isinstance(event, yaml.CollectionEndEvent):
            self._levels.pop()
        return True

    def _scalar(self, event: yaml.ScalarEvent) -> bool:
        """Take a key or a plain value."""
        self._check_tag(event)
        if self._expects_key():
            self._key(event)
            return True
        plain = event.style is None
        self._place(resolve_scalar(event.value) if plain else event.value, event)
        return True

    def _open(self, event: yaml.CollectionStartEvent) -> bool:
        """Begin a mapping or a list."""
        self._check_tag(event)
        if self._expects_key():
            self.problem(event.start_mark, "a key is a list or a mapping; expected text")
            return False
        if len(self._levels) >= MAX_DEPTH:
            message = f"nested deeper than {MAX_DEPTH} levels"
            self.problem(event.start_mark, message, self._levels[2].path)
            return False
        container: dict[str, object] | list[object]
        container = {} if isinstance(event, yaml.MappingStartEvent) else []
        path = self._place(container, event)
        self._levels.append(_Level(container, path))
        return True

    def _check_tag(self, event: yaml.ScalarEvent | yaml.CollectionStartEvent) -> None:
        """Record anchors, and tags that are not allowed."""
        if event.anchor is not None:
            self.problem(event.start_mark, f"anchor &{event.anchor}; expected a plain value")
        if event.tag is not None and event.tag not in self._tags:
            self.problem(event.start_mark, f"tag {event.tag}; expected a plain value")

    def _next_path(self) -> KeyPath:
        """Key path of the value that comes next."""
        if not self._levels:
            return ()
        level = self._levels[-1]
        if isinstance(level.container, list):
            return (*level.path, len(level.container))
        return level.path if level.key is None else (*level.path, level.key)

    def _expects_key(self) -> bool:
        """Whether a key comes next."""
        level = self._levels[-1] if self._levels else None
        return level is not None and isinstance(level.container, dict) and level.key is None

    def _key(self, event: yaml.ScalarEvent) -> None:
        """Take a key of the innermost mapping."""
        level = self._levels[-1]
        level.key = event.value
        path = (*level.path, event.value)
        first = self.document.key_marks.get(path)
        if first is not None:
            message = f"is given twice, first in line {first.line}; expected once"
            self.problem(event.start_mark, message, path)
        else:
            self.document.key_marks[path] = _mark(event.start_mark)

    def _place(self, value: object, event: yaml.Event) -> KeyPath:
        """Put a value into the innermost open container; return its key path."""
        path = self._next_path()
        level = self._levels[-1] if self._levels else None
        if level is None:
            self.document.value = value
        elif isinstance(level.container, list):
            self.document.key_marks[path] = _mark(event.start_mark)
            level.container.append(value)
        elif level.key is None:  # an alias where a key should be; it is a problem already
            level.key = ""
            return path
        else:
            level.container.setdefault(level.key, value)
            level.key = None
        self.document.value_marks.setdefault(path, _mark(event.start_mark))
        return path


def _mark(mark: object) -> Mark:
    """Count from 1 what PyYAML counts from 0."""
    if isinstance(mark, yaml.Mark):
        return Mark(mark.line + 1, mark.column + 1)
    return Mark(1, 1)


def resolve_scalar(text: str) -> object:
    """Value of an unquoted scalar: None, bool, int, float or the text itself."""
    if text in _WORDS:
        return _WORDS[text]
    if _INT.match(text):
        return int(text) if len(text) <= _LONGEST_INT else float(text)
    if _FLOAT.match(text):
        return float(text)
    return text


def format_value(value: object) -> str:
    """Write plain data on one line so that :func:`parse_text` gives it back.

    Parameters
    ----------
    value : object
        Dicts, lists, tuples, str, int, float, bool or None.

    Returns
    -------
    text : str
        On one line.
    """
    if isinstance(value, dict):
        return (
            "{" + ", ".join(f"{format_value(k)}: {format_value(v)}" for k, v in value.items()) + "}"
        )
    if isinstance(value, list | tuple):
        return "[" + ", ".join(format_value(item) for item in value) + "]"
    if isinstance(value, str) and not (_PLAIN.match(value) and resolve_scalar(value) == value):
        quoted = json.dumps(value, ensure_ascii=False)
        return _UNWRITABLE.sub(lambda m: f"\\u{ord(m[0]):04x}", quoted)
    return value if isinstance(value, str) else json.dumps(value)
