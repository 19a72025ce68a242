"""The hash chain of an audit log.

A log is a sequence of lines. Each is one record as canonical JSON (RFC 8785) and holds its number ``seq``, from 1 on,
and ``previous``, the SHA-256 of the line before it; the *head* is the SHA-256 of the last line. Nothing can be changed,
taken out or moved without breaking the chain, and nothing cut off its end without missing the head.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import InitVar, dataclass, field
from functools import lru_cache
from typing import Any

from robosac.audit.lines import canonical

GENESIS = "0" * 64
"""``previous`` of a log's first record."""


@dataclass(frozen=True)
class Unsealed:
    """A record whose place in the log is not known yet; its parts are in canonical form, so that `seal` costs little.

    Parameters
    ----------
    event : mapping
        What the record says; JSON values, integers below 2**53.

    Raises
    ------
    rfc8785.CanonicalizationError
        If a value has no canonical form, such as NaN.
    """

    event: InitVar[Mapping[str, Any]]
    parts: Mapping[str, bytes] = field(init=False)

    def __post_init__(self, event: Mapping[str, Any]) -> None:
        object.__setattr__(self, "parts", {name: canonical(value) for name, value in event.items()})

    def seal(self, session_id: str, seq: int, previous: str) -> str:
        """The line of the record; see `seal`."""
        place: dict[str, Any] = {"session_id": session_id, "seq": seq, "previous": previous}
        parts = {**self.parts, **{name: canonical(value) for name, value in place.items()}}
        ordered = sorted(parts.items(), key=lambda part: part[0].encode("utf-16be"))  # as RFC 8785 has it
        return (b"{" + b",".join(_named(name) + b":" + value for name, value in ordered) + b"}").decode()


_named = lru_cache(maxsize=256)(canonical)
"""The canonical form of a field's name."""


def seal(event: Mapping[str, Any], session_id: str, seq: int, previous: str) -> str:
    """The line of a record.

    Parameters
    ----------
    event : mapping
        As `Unsealed` takes it.
    session_id : str
    seq : int
        Number of the record.
    previous : str
        `digest` of the line before, or `GENESIS`.

    Raises
    ------
    rfc8785.CanonicalizationError
        As `Unsealed`.
    """
    return Unsealed(event).seal(session_id, seq, previous)


def digest(line: str) -> str:
    """SHA-256 of a line without its line break, hexadecimal."""
    return hashlib.sha256(line.encode()).hexdigest()


def commitment(seed: str) -> str:
    """What is published of a seed before it is used: SHA-256 of its bytes.

    Parameters
    ----------
    seed : str
        Hexadecimal, at least 128 bits from a source that nobody can foresee, so that the commitment tells nothing.
    """
    return hashlib.sha256(bytes.fromhex(seed)).hexdigest()
