"""A recording may come from anybody: some KiB of it must not become GiB."""

import tracemalloc
from contextlib import contextmanager

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.records import Chunk

from robosac import wire
from robosac.detectors import Message
from robosac.recording import reading, unpacking
from robosac.recording.reading import RecordingError
from robosac.wire.tensors import Packing

BYTES = 2**26


@contextmanager
def in_little_memory():
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < BYTES / 8
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("said", [1000, 0])
@pytest.mark.parametrize(
    ("compression", "packed"),
    [
        ("zstd", zstandard.compress),
        ("zstd", zstandard.ZstdCompressor(write_content_size=False).compress),
        ("lz4", lz4.frame.compress),
    ],
)
def test_no_chunk_is_unpacked_to_more_than_it_says(compression, packed, said):
    bomb = Chunk(compression, packed(bytes(BYTES)), 0, 0, 0, said)
    with in_little_memory(), pytest.raises(ValueError, match=f"not of {said} bytes"):
        unpacking.records_in(bomb)


@pytest.mark.parametrize("compression", ["zstd", "lz4", ""])
def test_a_chunk_of_less_than_it_says_is_not_read(compression):
    packed = {"zstd": zstandard.compress, "lz4": lz4.frame.compress, "": bytes}[compression]
    with pytest.raises(ValueError, match="not of 10 bytes"):
        unpacking.records_in(Chunk(compression, packed(bytes(9)), 0, 0, 0, 10))


def test_no_message_is_unpacked_to_more_than_a_chunk_may_hold(tmp_path, monkeypatch):
    monkeypatch.setattr(reading, "MOST_BYTES", BYTES // 16)
    message = Message(np.eye(4), {name: np.zeros(BYTES // 24, np.float32) for name in ("one", "two", "three")})
    body = wire.pack_message(0, "car-1", message, packing=Packing(compress=True))
    assert len(body) < BYTES / 1000
    with in_little_memory(), pytest.raises(RecordingError, match="more than"):
        reading._message(body, tmp_path)
