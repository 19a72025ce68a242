"""Words of others, and of exceptions, that may be kept or shown: short, and without what belongs in no log."""

from __future__ import annotations

import re
import sysconfig
from collections.abc import Collection, Mapping
from pathlib import Path
from traceback import walk_tb
from types import TracebackType
from typing import Any

MESSAGE_CHARS = 240
"""What is kept of an exception's message."""
_LOOKED_AT_CHARS = 2048
_UNKEPT = (
    re.compile(r"(?<=with text )'.*", re.DOTALL),  # a value that SQLite cannot read
    re.compile(r"[A-Za-z0-9_-]{40,}"),  # keys, tokens, seeds and digests, whole or in part
    re.compile(r"\bb(['\"])(?:\\.|(?!\1)[^\\]){24,}+\1?"),  # tensors as bytes
    re.compile(r"(?:[-+]?\d[\w.+-]*+[\s,;\[\](){}]++){6,}"),  # and as numbers
)
_PLAIN = {"missing": "is missing", "extra_forbidden": "there is no such field"}
_PART_OF_A_WORD = re.compile(r"[\w.~+/=-]*+$")


def printable(text: str, *, lines: bool = False) -> str:
    """A text of others that no terminal or page obeys: with escapes in the place of what is not printable. The ends of
    its ``lines`` may stay.
    """
    return "".join(c if c.isprintable() or (lines and c == "\n") else repr(c)[1:-1] for c in text)


def in_short(text: str) -> str:
    """At most `MESSAGE_CHARS` of a text, without long words, bytes and rows of numbers.

    To shorten a text again changes nothing.
    """
    text = _cut(text, _LOOKED_AT_CHARS)
    for unkept in _UNKEPT:
        text = unkept.sub("<...>", text)
    return _cut(text, MESSAGE_CHARS)


def _cut(text: str, most: int) -> str:
    """At most so many characters, never a part of a word: half a secret would not be recognised as one."""
    return text if len(text) <= most else _PART_OF_A_WORD.sub("", text[: most - 3]) + "..."


def describe(error: BaseException) -> str:
    """Type and message of an exception, in short."""
    try:
        message = str(error)
    except Exception as failure:
        message = f"no message, for a {type(failure).__name__}"
    return in_short(f"{type(error).__name__}: {message}")


def in_one_line(error: BaseException) -> str:
    """Type and message of an exception, whole, in a line."""
    return " ".join(f"{type(error).__name__}: {error}".split()).removesuffix(":")


def foreign_place(traceback: TracebackType | None, packages: Collection[str]) -> str | None:
    """Where code failed that these packages called and that is neither theirs nor installed: the user's own.

    Parameters
    ----------
    traceback : traceback or None
        Of the exception.
    packages : collection of str

    Returns
    -------
    str or None
        ``my_attack.py, line 12``, the last such line that was running; None if there was none.
    """
    installed = tuple(f"{sysconfig.get_path(name)}/" for name in ("stdlib", "platstdlib", "purelib", "platlib"))
    called, place = False, None
    for frame, line in walk_tb(traceback):
        path, module = frame.f_code.co_filename, str(frame.f_globals.get("__name__"))
        if module.partition(".")[0] in packages:
            called = True
        elif called and not path.startswith(("<", *installed)):
            place = f"{Path(path).name}, line {line}"
    return place


def told(error: Exception) -> str:
    """The message of an exception, without the number that the system has for it."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror if error.filename is None else f"{error.filename}: {error.strerror}"
    return str(error)


def unreadable(error: OSError | UnicodeError) -> str:
    """Why a file cannot be read as text, without anything of what is in it."""
    return (error.strerror or type(error).__name__) if isinstance(error, OSError) else "it is no text"


def in_words(fault: Mapping[str, Any]) -> str:
    """What is wrong with a value by one of `pydantic.ValidationError.errors`, without where it stands."""
    return _PLAIN.get(fault["type"]) or str(fault["msg"]).removeprefix("Value error, ")
