"""Exceptions in words that may be kept: short, and without what belongs in no log."""

from __future__ import annotations

import re
from collections.abc import Mapping
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


def told(error: Exception) -> str:
    """The message of an exception, without the number that the system has for it."""
    if isinstance(error, OSError) and error.strerror and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    return str(error)


def unreadable(error: OSError | UnicodeError) -> str:
    """Why a file cannot be read as text, without anything of what is in it."""
    return (error.strerror or type(error).__name__) if isinstance(error, OSError) else "it is no text"


def in_words(fault: Mapping[str, Any]) -> str:
    """What is wrong with a value by one of `pydantic.ValidationError.errors`, without where it stands."""
    return _PLAIN.get(fault["type"]) or str(fault["msg"]).removeprefix("Value error, ")
