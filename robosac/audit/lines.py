"""Lines of an audit log as JSON: read, and told whether they are in canonical form."""

from __future__ import annotations

import codecs
import json
import re
from collections.abc import Mapping
from typing import Any, NoReturn

import rfc8785

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
_NUMBER = re.compile(rb"[:\[,]-?(?:\d{16}|\d+(?:\.0*[,\]}]|(?:\.\d+)?[eE]))")
"""A number that Python may write otherwise than RFC 8785: large, with an exponent, or a whole one with a point."""


def read(line: bytes) -> dict[str, Any]:
    """The record on a line, its line break taken off.

    Raises
    ------
    RecordError
        If it is not a JSON object.
    """
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


def is_canonical(line: bytes, record: Mapping[str, Any]) -> bool:
    """Whether a line is the canonical form (RFC 8785) of its record, as `read` read it."""
    try:
        if line.isascii() and not _NUMBER.search(line) and _AS_CANONICAL.encode(record).encode() == line:
            return True
        canonical: bytes = rfc8785.dumps(dict(record))
    except (ValueError, RecursionError):
        return False
    return canonical == line
