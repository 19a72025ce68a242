"""Numbers of an audit record as short text: whole numbers of a stated unit, their bytes compressed, in base64.

Bytes of like weight stand together (all first bytes, then all second ones), which compresses several times better.
What is unpacked comes from somebody else's log: its size is bounded before it is made.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import json
import zlib
from collections.abc import Mapping, Sequence
from functools import cache, lru_cache
from typing import Any

import numpy as np

from robosac.answers import Standing, Support
from robosac.boxes import MOST_BOXES, FloatArray, from_units, in_units

MOST_BYTES = 2**23
"""Of one packed field, unpacked: several times the largest state of 1024 teammates. As Python's values it may take
sixty times as much.
"""
MOST_VEHICLES = 1025
"""Of a frame: a session has at most 1024 teammates."""
MOST_NAMES = 2**20
"""In all hypotheses of a frame, or beside all its boxes: more than a frame has time for."""
_BOX_BYTES = 24
_RAW = -15
"""No header of zlib's, and the largest window."""
_SCORE = 5
_STANDINGS = tuple(Standing)


def packed_state(state: Mapping[str, Any]) -> tuple[str, bytes]:
    """The digest of a state, and its text.

    The text is JSON, keys sorted, without spaces, numbers as Python writes them; the digest is its SHA-256.
    """
    text = json.dumps(dict(state), sort_keys=True, separators=(",", ":"), allow_nan=False).encode()
    return hashlib.sha256(text).hexdigest(), text


def state_digest(state: Mapping[str, Any]) -> str:
    """SHA-256 (hexadecimal) of a state's text, see `packed_state`."""
    return packed_state(state)[0]


def deflated(content: bytes) -> str:
    """Bytes as text: deflate (RFC 1951), then base64."""
    packer = zlib.compressobj(9, zlib.DEFLATED, _RAW)
    return base64.b64encode(packer.compress(content) + packer.flush()).decode()


def inflated(text: Any) -> bytes:
    """What `deflated` made text of.

    Raises
    ------
    ValueError
        If it is something else, or longer than `MOST_BYTES`.
    """
    if not isinstance(text, str):
        raise ValueError("must be text")
    try:
        opener = zlib.decompressobj(_RAW)
        content = opener.decompress(base64.b64decode(text, validate=True), MOST_BYTES)
    except (binascii.Error, zlib.error) as error:
        raise ValueError(f"cannot be unpacked: {error}") from error
    if not opener.eof or opener.unused_data:
        raise ValueError("cannot be unpacked: it is cut off, too long, or followed by more")
    return content


def pack_boxes(boxes: FloatArray) -> str:
    """Boxes (n, 6), whole numbers of `robosac.boxes.BOX_UNITS`.

    They stand as columns of 32 bits, little-endian, bytes of like weight together. Of the scores, which descend, each
    is given as what it is more than the one before. A number n stands as 2 n, or as -2 n - 1 where it is negative.
    """
    columns = in_units(boxes).T.copy()
    columns[_SCORE] = np.diff(columns[_SCORE], prepend=0)
    unsigned = np.ascontiguousarray(((columns << 1) ^ (columns >> 63)).astype("<u4"))
    return deflated(unsigned.view(np.uint8).reshape(6, -1, 4).transpose(2, 0, 1).tobytes())


def unpack_boxes(text: Any) -> FloatArray:
    """The boxes (n, 6) of `pack_boxes`.

    Raises
    ------
    ValueError
        If the text is something else, or holds more than `MOST_BOXES`.
    """
    content = inflated(text)
    if len(content) % _BOX_BYTES:
        raise ValueError("does not hold whole boxes")
    check_count(len(content) // _BOX_BYTES, MOST_BOXES)
    planes = np.frombuffer(content, dtype=np.uint8).reshape(4, 6, -1).transpose(1, 2, 0)
    unsigned = np.ascontiguousarray(planes).view("<u4")[..., 0].astype(np.int64)
    columns = (unsigned >> 1) ^ -(unsigned & 1)
    columns[_SCORE] = np.cumsum(columns[_SCORE])
    return from_units(columns.T)


def pack_supports(supports: Sequence[Support], names: Sequence[str]) -> str:
    """On whose word boxes stand: of each the number of its status, a bit for each witness, a bit for each denier.

    Parameters
    ----------
    supports : sequence of Support
    names : sequence of str
        Whom the bits stand for, the least first; all witnesses and deniers must be among them.
    """
    width, bits = -(-len(names) // 8), _bits(names)

    @cache  # most boxes have the same few witnesses
    def mask(chosen: Sequence[str]) -> bytes:
        return _mask(chosen, bits).to_bytes(width, "little")

    rows = [bytes([_STANDINGS.index(each.status)]) + mask(each.witnesses) + mask(each.deniers) for each in supports]
    columns = np.frombuffer(b"".join(rows), dtype=np.uint8).reshape(-1, 1 + 2 * width).T
    return deflated(columns.tobytes())


def unpack_supports(text: Any, names: Sequence[str]) -> list[Support]:
    """The supports of `pack_supports`; those that are alike are one object.

    Raises
    ------
    ValueError
        If the text is something else, or holds more than `MOST_BOXES` entries, or `MOST_NAMES` in them.
    """
    content, width = inflated(text), -(-len(names) // 8)
    if len(content) % (1 + 2 * width):
        raise ValueError("does not hold whole entries")
    number = 1 + 2 * width
    check_count(len(content) // number, MOST_BOXES)
    rows = np.ascontiguousarray(np.frombuffer(content, dtype=np.uint8).reshape(number, -1).T).tobytes()
    among = tuple(names)
    supports, named = [], 0
    for start in range(0, len(rows), number):
        supports.append(one := _support(rows[start : start + number], among))
        named += len(one.witnesses) + len(one.deniers)
        check_count(named, MOST_NAMES)
    return supports


@lru_cache(4096)  # most boxes of a log have the same few witnesses
def _support(row: bytes, names: tuple[str, ...]) -> Support:
    if row[0] >= len(_STANDINGS):
        raise ValueError(f"there is no status {row[0]}")
    width = -(-len(names) // 8)
    witnesses, deniers = (
        tuple(_members(int.from_bytes(mask, "little"), names)) for mask in (row[1 : 1 + width], row[1 + width :])
    )
    return Support.model_construct(status=_STANDINGS[row[0]], witnesses=witnesses, deniers=deniers)


def pack_names(chosen: Sequence[str], names: Sequence[str]) -> str | list[str]:
    """Some of ``names`` as a hexadecimal number, a bit for each, the least first.

    Where they are in another order than these, or others are among them, it stays a list.
    """
    among = set(chosen)
    if among <= set(names) and list(chosen) == [name for name in names if name in among]:
        return f"{_mask(chosen, _bits(names)):x}"
    return list(chosen)


def unpack_names(packed: Any, names: Sequence[str]) -> Any:
    """The list of `pack_names`; what is no text stays as it is.

    Raises
    ------
    ValueError
        If the text is no such number.
    """
    return _members(int(packed, 16), names) if isinstance(packed, str) else packed


def short_digest(digest: str) -> str:
    """A SHA-256 in hexadecimal as base64 (URL-safe, no padding)."""
    return base64.urlsafe_b64encode(bytes.fromhex(digest)).decode().rstrip("=")


def long_digest(text: str) -> str:
    """The digest of `short_digest`, hexadecimal.

    Raises
    ------
    ValueError
        If the text is something else.
    """
    raw = base64.b64decode(text.replace("-", "+").replace("_", "/") + "=", validate=True)
    if len(raw) != hashlib.sha256().digest_size:
        raise ValueError("is no SHA-256")
    return raw.hex()


def _bits(names: Sequence[str]) -> dict[str, int]:
    return {name: 1 << place for place, name in enumerate(names)}


def _mask(chosen: Sequence[str], bits: Mapping[str, int]) -> int:
    return sum({bits[name] for name in chosen})


def _members(mask: int, names: Sequence[str]) -> list[str]:
    if mask < 0 or mask >> len(names):
        raise ValueError("names more vehicles than there are")
    return [name for name, bit in zip(names, reversed(f"{mask:b}"), strict=False) if bit == "1"]


def check_count(count: int, most: int) -> None:
    """Raise ValueError if there are more than so many."""
    if count > most:
        raise ValueError(f"holds {count}; there are at most {most}")
