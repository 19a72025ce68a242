"""Lines of an audit log as JSON: read, and told whether they are in canonical form."""

from __future__ import annotations

import codecs
import json
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import Any, BinaryIO, NoReturn

import rfc8785

MOST_BYTES = 2**24
"""Of a line: far more than a gateway writes. A longer one is not read: it would take many times as much memory."""
_FOREIGN = {codecs.BOM_UTF8: "a byte order mark", b"\x1f\x8b": "the mark of gzip"}
"""What other programs put before a text, or before what they have packed."""


class RecordError(ValueError):
    """A line that is no record, or a record without what its event has to say."""


def _no_number(text: str) -> NoReturn:
    raise ValueError(f"{text} is no number")


_READER = json.JSONDecoder(parse_constant=_no_number)
_AS_CANONICAL = json.JSONEncoder(ensure_ascii=False, allow_nan=False, sort_keys=True, separators=(",", ":"))
"""Several times faster than rfc8785. It orders names otherwise where they are not ASCII, and writes some numbers
otherwise."""
_NUMBER = re.compile(r"[:\[,]-?(?:\d{16}|\d+(?:\.0*[,\]}]|(?:\.\d+)?[eE]))")
"""A number that Python may write otherwise than RFC 8785: large, with an exponent, or a whole one with a point."""


def lines_in(file: BinaryIO) -> Iterator[bytes]:
    """The lines of a file with their line breaks; of one that is too long no more than shows that it is."""
    while line := file.readline(MOST_BYTES + 2):
        yield line
        while len(line) > MOST_BYTES and not line.endswith(b"\n"):
            line = file.readline(MOST_BYTES + 2)
            if not line:
                return


def read(line: bytes) -> dict[str, Any]:
    """The record on a line, its line break taken off.

    Raises
    ------
    RecordError
        If it is not a JSON object, or too long.
    """
    if len(line) > MOST_BYTES:
        raise RecordError(f"not JSON: a line has at most {MOST_BYTES} bytes")
    try:
        record = _READER.decode(line.decode())
    except (ValueError, RecursionError) as error:
        raise RecordError(f"not JSON: {_why(line, error)}") from error
    if not isinstance(record, dict):
        raise RecordError("not JSON: no object")
    return record


def _why(line: bytes, error: Exception) -> str:
    if not line.strip():
        return "the line is empty"
    for begin, what in _FOREIGN.items():
        if line.startswith(begin):
            return f"it begins with {what}"
    return f"{error.msg}: character {error.pos + 1}" if isinstance(error, json.JSONDecodeError) else str(error)


def canonical(value: Any) -> bytes:
    """The canonical form (RFC 8785) of a JSON value.

    Raises
    ------
    rfc8785.CanonicalizationError
        If it has none.
    """
    with suppress(TypeError, ValueError):
        text = _AS_CANONICAL.encode([value])  # in a list, so that a number has something before and after it
        if text.isascii() and not _NUMBER.search(text):
            return text[1:-1].encode()
    whole: bytes = rfc8785.dumps(value)
    return whole


def is_canonical(line: bytes, record: Mapping[str, Any]) -> bool:
    """Whether a line is the canonical form of its record, as `read` read it."""
    try:
        return canonical(dict(record)) == line
    except (ValueError, RecursionError):
        return False
