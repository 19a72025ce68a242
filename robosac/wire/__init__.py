"""Messages and frames as msgpack: the one codec, for service and clients alike.

A tensor travels as ``{dtype, shape, data}`` with its bytes little-endian in C order, as int8 with ``exponents``, and
with ``compression`` as zstd (`robosac.detectors.narrow`); a pose as 16 numbers, row-major.
What is read is never trusted: sizes and entries are bounded while a body is unpacked, and types, shapes, lengths and
finiteness are checked against what the detector declares. Each refusal is a `WireError` with a stable code and the
field it is about.
"""

from robosac.wire.bodies import (
    ID_PATTERN,
    MAX_ARRAY,
    MAX_ENTRIES,
    MAX_FRAME,
    MAX_MAP,
    MAX_STRING,
    FrameEnvelope,
    MessageEnvelope,
    check_message,
    content_digest,
    pack,
    pack_frame,
    pack_message,
    read_frame,
    read_message,
    read_signature,
    unpack,
)
from robosac.wire.fields import WireError
from robosac.wire.tensors import ZSTD, Packing

__all__ = [
    "ID_PATTERN",
    "MAX_ARRAY",
    "MAX_ENTRIES",
    "MAX_FRAME",
    "MAX_MAP",
    "MAX_STRING",
    "ZSTD",
    "FrameEnvelope",
    "MessageEnvelope",
    "Packing",
    "WireError",
    "check_message",
    "content_digest",
    "pack",
    "pack_frame",
    "pack_message",
    "read_frame",
    "read_message",
    "read_signature",
    "unpack",
]
