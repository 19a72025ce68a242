"""Chunks of a recording: a file may come from anybody, and none is unpacked to more than it says that it holds."""

from __future__ import annotations

import io
from dataclasses import replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mcap.records import Chunk, McapRecord


def records_in(chunk: Chunk) -> list[McapRecord]:
    """What is in a chunk.

    Raises
    ------
    ValueError
        If it holds more than it says, or less.
    Exception
        Whatever else a reader of MCAP, or what decompresses, makes of what is garbled.
    """
    from mcap.stream_reader import breakup_chunk  # noqa: PLC0415 (of an extra)

    data = _unpacked(chunk.data, chunk.compression, chunk.uncompressed_size + 1)
    if len(data) != chunk.uncompressed_size:
        raise ValueError(f"a chunk is not of {chunk.uncompressed_size} bytes")
    return breakup_chunk(replace(chunk, data=data, compression=""), validate_crc=True)


def _unpacked(data: bytes, compression: str, most: int) -> bytes:
    """The first bytes of what is packed, at most so many. mcap itself unpacks as many as there are."""
    if compression == "zstd":
        import zstandard  # noqa: PLC0415 (of an extra)

        return zstandard.ZstdDecompressor().stream_reader(io.BytesIO(data)).read(most)
    if compression == "lz4":
        import lz4.frame  # noqa: PLC0415 (of an extra)

        some: bytes = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=most)
        return some
    return data
