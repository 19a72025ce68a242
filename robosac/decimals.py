"""Many numbers as one text, as what is remembered between frames holds them.

As JSON, ten thousand numbers take milliseconds to write, to read, and to write again into a log.
"""

from __future__ import annotations

import base64
import binascii
from collections.abc import Mapping
from typing import Any

import numpy as np

from robosac.boxes import FloatArray

_HEAD = "decimals"
_TYPES: Mapping[str, np.dtype[np.signedinteger[Any]]] = {"i4": np.dtype("<i4"), "i8": np.dtype("<i8")}
_MOST_DIGITS = 9


def as_text(values: FloatArray, digits: int) -> str:
    """Finite numbers (n,), each rounded to so many decimals and at most 9e18 in that unit, as text.

    ``decimals:DIGITS:TYPE:`` and then, in base64, the whole numbers of that unit, little-endian: TYPE is ``i4`` for 32
    bits, ``i8`` for 64.
    """
    whole = np.rint(values * 10.0**digits)
    kind = "i4" if len(whole) == 0 or np.abs(whole).max() < 2**31 else "i8"
    return f"{_HEAD}:{digits}:{kind}:{base64.b64encode(whole.astype(_TYPES[kind]).tobytes()).decode()}"


def from_text(text: Any) -> FloatArray:
    """The numbers (n,) of `as_text`.

    Raises
    ------
    ValueError
        If it is something else.
    """
    if not is_text(text):
        raise ValueError("no text of decimals")
    _, digits, kind, content = [*text.split(":", 3), "", ""][:4]
    if not digits.isdecimal() or int(digits) > _MOST_DIGITS or kind not in _TYPES:
        raise ValueError(f"decimals of an unknown form: {digits[:8]}, {kind[:8]}")
    try:
        whole = np.frombuffer(base64.b64decode(content, validate=True), dtype=_TYPES[kind])
    except binascii.Error as error:
        raise ValueError(f"decimals cannot be read: {error}") from error
    values: FloatArray = whole / 10.0 ** int(digits)
    return values


def is_text(value: Any) -> bool:
    """Whether a JSON value says that it is what `as_text` writes."""
    return isinstance(value, str) and value.startswith(f"{_HEAD}:")
