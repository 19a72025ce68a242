"""Whatever bytes come, the codec answers with a value or a `WireError`, and its work is bounded."""

import os

import msgpack
import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from robosac import wire
from robosac.boxes import pose_matrix
from robosac.detectors import DetectorInfo, Message, TensorSpec

CASES = int(os.environ.get("ROBOSAC_FUZZ_CASES", "400"))
INFO = DetectorInfo(
    "tiny",
    {role: {"features": TensorSpec("float16", (2, 3, 3), ("int8",))} for role in ("ego", "teammate")},
    (-1.0, -1.0, 1.0, 1.0),
    1.0,
    "0" * 64,
    0.5,
)
MESSAGE = Message(pose_matrix(1.0, 2.0, 1.7, 0.3), {"features": np.ones((2, 3, 3), np.float16)})
BODIES = [
    wire.pack_message(7, "car-2", MESSAGE, bytes(64)),
    wire.pack_message(7, "car-2", MESSAGE, bytes(64), packing=wire.Packing("int8")),
    wire.pack_message(7, "car-2", MESSAGE, bytes(64), packing=wire.Packing(compress=True)),
    wire.pack_frame(7, MESSAGE, {"car-2": MESSAGE, "rsu": MESSAGE}, None, {"rsu": bytes(64)}),
]
fuzzed = settings(max_examples=CASES, deadline=None, suppress_health_check=list(HealthCheck), database=None)

numbers = st.one_of(st.integers(-(2**63), 2**64 - 1), st.floats(), st.booleans(), st.none())
words = st.one_of(
    st.sampled_from(
        ["frame", "vehicle_id", "pose", "tensors", "features", "dtype", "shape", "data", "exponents", "int8"]
        + ["ego", "teammates", "compression", "zstd"]
    ),
    st.text(max_size=20),
)
values = st.recursive(
    st.one_of(numbers, words, st.binary(max_size=64), st.just(bytes(36)), st.just("float16"), st.just([2, 3, 3])),
    lambda inner: st.one_of(st.lists(inner, max_size=17), st.dictionaries(words, inner, max_size=6)),
    max_leaves=30,
)


def read(body: bytes) -> int:
    """Read a body as both kinds; how many of its messages were good."""
    good = 0
    for kind in (wire.read_message, wire.read_frame):
        try:
            envelope = kind(body)
            parts = [envelope.payload] if kind is wire.read_message else [envelope.ego, *envelope.teammates.values()]
            for part in parts:
                message = wire.check_message(part, INFO, "teammate", "part")
                wire.read_signature(part)
                assert len(wire.content_digest(envelope.frame, "x", message)) == 64
                good += 1
        except wire.WireError as error:
            assert error.code
            assert len(str(error)) < 2000
            assert str(error).isprintable()
    return good


def test_the_bodies_that_are_mutated_are_good():
    assert [read(body) for body in BODIES] == [1, 1, 1, 3]


@fuzzed
@given(st.binary(max_size=300))
def test_any_bytes(body):
    read(body)


@fuzzed
@given(
    st.sampled_from(BODIES),
    st.lists(st.tuples(st.integers(0, 2000), st.integers(0, 255)), max_size=6),
    st.integers(0, 60),
)
def test_good_bodies_with_changed_and_missing_bytes(body, changes, cut):
    changed = bytearray(body)
    for place, value in changes:
        changed[place % len(changed)] = value
    read(bytes(changed[: len(changed) - cut]))


@fuzzed
@given(values)
def test_any_values(value):
    try:
        body = msgpack.packb(value, use_bin_type=True)
    except (OverflowError, ValueError):
        return
    read(body)


@fuzzed
@given(st.sampled_from(["frame", "vehicle_id", "pose", "tensors", "signature"]), values)
def test_good_messages_with_one_field_of_any_value(field, value):
    fields = msgpack.unpackb(BODIES[0])
    try:
        body = msgpack.packb(fields | {field: value}, use_bin_type=True)
    except (OverflowError, ValueError):
        return
    read(body)
