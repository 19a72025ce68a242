"""Tensors on their way in fewer bytes: narrower types and compression."""

from dataclasses import replace

import msgpack
import numpy as np
import pytest
import zstandard

from robosac import wire
from robosac.detectors import Message, TensorSpec
from robosac.detectors.narrow import NarrowError, expanded, rounded
from tests.robosac.test_wire import EGO, FEATURES, INFO, POSE, TEAMMATE, with_value

BYTES = wire.Packing("int8")
NARROW = replace(INFO, tensors={"teammate": {"features": TensorSpec("float16", (2, 3), ("int8",))}})
ROUNDED = rounded(Message(POSE, {"features": np.array([[0.1, 2.0, -3.0], [5e-4, 0.0, 1e-3]], np.float16)}), "int8")


def test_maps_travel_as_bytes_where_nothing_is_lost_by_it():
    narrow, wide = (wire.pack_message(0, "car-2", ROUNDED, packing=packing) for packing in (BYTES, None))
    fields = msgpack.unpackb(narrow)["tensors"]["features"]
    assert (fields["dtype"], len(fields["data"]), len(fields["exponents"])) == ("int8", 6, 2)
    read = [wire.check_message(wire.read_message(body).payload, NARROW, "teammate") for body in (narrow, wide)]
    for message in read:
        assert message.tensors["features"].dtype == np.float16
        np.testing.assert_array_equal(message.tensors["features"], ROUNDED.tensors["features"])
    assert len({wire.content_digest(0, "car-2", message) for message in (*read, ROUNDED)}) == 1
    signed = wire.pack_message(0, "x", Message(POSE, {"features": -ROUNDED.tensors["features"]}), packing=BYTES)
    assert msgpack.unpackb(signed)["tensors"]["features"]["dtype"] == "float16"  # -0 is another message than 0
    odd = Message(POSE, {"features": FEATURES + np.float16(0.001)})
    assert msgpack.unpackb(wire.pack_message(0, "x", odd, packing=BYTES))["tensors"]["features"]["dtype"] == "float16"
    frame = msgpack.unpackb(wire.pack_frame(0, ROUNDED, {"car-2": odd, "rsu": ROUNDED}, packing=BYTES))
    sent = (frame["ego"], *frame["teammates"].values())
    assert [each["tensors"]["features"]["dtype"] for each in sent] == ["int8", "float16", "int8"]


@pytest.mark.parametrize(
    ("changed", "field", "code"),
    [
        ({"exponents": KeyError}, "exponents", "missing-field"),
        ({"exponents": [1, 2]}, "exponents", "wrong-type"),
        ({"exponents": bytes(3)}, "exponents", "wrong-length"),
        ({"exponents": bytes([127, 0])}, "exponents", "out-of-range"),
        ({"data": bytes(12)}, "data", "wrong-length"),
        ({"dtype": "float32"}, "dtype", "wrong-dtype"),
    ],
)
def test_what_is_wrong_with_a_map_of_bytes_is_named(changed, field, code):
    fields = msgpack.unpackb(wire.pack_message(0, "car-2", ROUNDED, packing=BYTES))
    tensor = fields["tensors"]["features"] | changed
    fields["tensors"]["features"] = {name: value for name, value in tensor.items() if value is not KeyError}
    with pytest.raises(wire.WireError) as caught:
        wire.check_message(fields, NARROW, "teammate")
    assert (caught.value.code, caught.value.field) == (code, f"tensors.features.{field}")


SMALL = wire.Packing(compress=True)


def test_tensors_travel_compressed():
    long = np.zeros((2, 3000), dtype=np.float16)
    long[0, ::7] = 1.5
    info = replace(INFO, tensors={"teammate": {"features": TensorSpec("float16", long.shape, ("int8",))}})
    message = Message(POSE, {"features": long})
    plain = wire.pack_message(0, "car-2", message)
    for packing in (SMALL, wire.Packing("int8", compress=True)):
        body = wire.pack_message(0, "car-2", message, packing=packing)
        assert len(body) < len(plain) / 10
        read = wire.check_message(wire.read_message(body).payload, info, "teammate")
        np.testing.assert_array_equal(read.tensors["features"], long)
        assert read.tensors["features"].dtype == np.float16
    frame = wire.read_frame(wire.pack_frame(0, EGO, {"rsu": TEAMMATE}, packing=SMALL))
    np.testing.assert_array_equal(wire.check_message(frame.ego, INFO, "ego").tensors["grid"], EGO.tensors["grid"])


def zstd(data, **options):
    return zstandard.ZstdCompressor(**options).compress(data)


GOOD_DATA = FEATURES.tobytes()


@pytest.mark.parametrize(
    ("changed", "field", "code", "says"),
    [
        ({"compression": "gzip"}, "compression", "bad-compression", "must be 'zstd', got 'gzip'"),
        ({"compression": None}, "compression", "wrong-type", "must be a string"),
        ({"data": "text"}, "data", "wrong-type", "must be binary"),
        ({"data": b""}, "data", "bad-compression", "is not one frame of zstd"),
        ({"data": GOOD_DATA}, "data", "bad-compression", "is not one frame of zstd"),
        ({"data": zstd(GOOD_DATA)[:-1]}, "data", "bad-compression", "is not one frame of zstd"),
        ({"data": zstd(GOOD_DATA) + b"more"}, "data", "bad-compression", "is not one frame of zstd"),
        ({"data": zstd(bytes(11))}, "data", "bad-compression", "tells 11 bytes, not 12"),
        ({"data": zstd(bytes(2**31))}, "data", "bad-compression", "tells 2147483648 bytes, not 12"),
        ({"data": zstd(GOOD_DATA, write_content_size=False)}, "data", "bad-compression", "does not tell its length"),
        ({"data": zstd(with_value(np.nan))}, "data", "non-finite", "NaN"),
    ],
)
def test_what_is_wrong_with_a_compressed_tensor_is_named(changed, field, code, says):
    fields = msgpack.unpackb(wire.pack_message(0, "car-2", TEAMMATE, packing=SMALL))
    fields["tensors"]["features"] |= changed
    with pytest.raises(wire.WireError, match=says) as caught:
        wire.check_message(fields, INFO, "teammate")
    assert (caught.value.code, caught.value.field) == (code, f"tensors.features.{field}")


def test_a_frame_that_lies_about_its_length_holds_no_more_than_it_says():
    bomb = bytearray(zstd(bytes(2**24)))
    honest = zstandard.get_frame_parameters(bytes(bomb))
    assert honest.content_size == 2**24
    at = bytes(bomb).index((2**24).to_bytes(4, "little"))
    bomb[at : at + 4] = (len(GOOD_DATA)).to_bytes(4, "little")
    assert zstandard.frame_content_size(bytes(bomb)) == len(GOOD_DATA)
    with pytest.raises(NarrowError, match="is not one frame of zstd"):
        expanded(bytes(bomb), len(GOOD_DATA))


def test_maps_of_bytes_are_refused_by_a_detector_that_does_not_take_them():
    with pytest.raises(wire.WireError, match="must be 'float16', got 'int8'"):
        wire.check_message(
            wire.read_message(wire.pack_message(0, "car-2", ROUNDED, packing=BYTES)).payload, INFO, "teammate"
        )
