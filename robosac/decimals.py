"""Many numbers as one text, as what is remembered between frames holds them.

As JSON, ten thousand numbers take milliseconds to write, to read, and to write again into a log.
"""

from __future__ import annotations

import base64
import binascii
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from robosac.boxes import FloatArray

_HEAD = re.compile("decimals:(?P<digits>[0-9]):(?P<kind>i4|i8):")
_TYPES: Mapping[str, np.dtype[np.signedinteger[Any]]] = {"i4": np.dtype("<i4"), "i8": np.dtype("<i8")}


def as_text(values: FloatArray, digits: int) -> str:
    """Finite numbers (n,), each rounded to so many decimals (0 to 9) and at most 9e18 in that unit, as text.

    ``decimals:DIGITS:TYPE:`` and then, in base64, the whole numbers of that unit, little-endian: TYPE is ``i4`` for 32
    bits, ``i8`` for 64.
    """
    whole = np.rint(values * 10.0**digits)
    kind = "i4" if len(whole) == 0 or np.abs(whole).max() < 2**31 else "i8"
    return f"decimals:{digits}:{kind}:{base64.b64encode(whole.astype(_TYPES[kind]).tobytes()).decode()}"


def from_text(text: Any) -> FloatArray:
    """The numbers (n,) of `as_text`.

    Raises
    ------
    ValueError
        If it is something else.
    """
    head = _HEAD.match(text) if isinstance(text, str) else None
    if head is None:
        raise ValueError("no text of decimals")
    try:
        whole = np.frombuffer(base64.b64decode(text[head.end() :], validate=True), dtype=_TYPES[head["kind"]])
    except binascii.Error as error:
        raise ValueError(f"decimals cannot be read: {error}") from error
    values: FloatArray = whole / 10.0 ** int(head["digits"])
    return values


def is_text(value: Any) -> bool:
    """Whether a JSON value says that it is what `as_text` writes."""
    return isinstance(value, str) and _HEAD.match(value) is not None
