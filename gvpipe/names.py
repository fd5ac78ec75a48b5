"""Names of files and images: natural order, and a printable, reversible spelling."""

import difflib
import re
import unicodedata
from collections.abc import Iterable

# Invisible characters that reorder or break the text around them; the categories Cc, Cs, Zl, Zp
# (controls, undecodable bytes, separators) are escaped too.
_REORDERING = frozenset("\u200e\u200f\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069\ufeff")
_ESCAPED_CATEGORIES = frozenset({"Cc", "Cs", "Zl", "Zp"})


def natural_key(name: str) -> tuple[tuple[tuple[int, int, str], ...], str]:
    """Sort key under which ``img9`` comes before ``img10``."""
    parts = re.split(r"([0-9]+)", name)
    return tuple((0, int(p), "") if p.isdecimal() else (1, 0, p) for p in parts if p), name


def escape(name: str) -> str:
    """Spell a file name so that it can be printed and stored as UTF-8.

    Parameters
    ----------
    name : str
        As the file system gave it (undecodable bytes as surrogates).

    Returns
    -------
    escaped : str
        The same, with each byte of an unprintable character as ``%XX``. A ``%`` that already
        stands before two hexadecimal digits becomes ``%25``, so that percent-decoding
        (``urllib.parse.unquote(escaped, errors="surrogateescape")``) gives the name back.
    """
    out = []
    for k, character in enumerate(name):
        if character == "%" and re.match(r"%[0-9A-Fa-f]{2}", name[k : k + 3]):
            out.append("%25")
        elif character in _REORDERING or unicodedata.category(character) in _ESCAPED_CATEGORIES:
            raw = character.encode("utf-8", "surrogateescape" if _is_byte(character) else "replace")
            out.append("".join(f"%{byte:02X}" for byte in raw))
        else:
            out.append(character)
    return "".join(out)


def _is_byte(character: str) -> bool:
    """Whether the character stands for one undecodable byte of a file name."""
    return "\udc80" <= character <= "\udcff"


def nearest(name: str, known: Iterable[str]) -> str:
    """`` (did you mean X?)`` if a known name is near, else nothing."""
    near = difflib.get_close_matches(name, list(known), n=1, cutoff=0.6)
    return f" (did you mean {near[0]}?)" if near else ""
