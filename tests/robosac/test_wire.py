import tracemalloc

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robosac import wire
from robosac.boxes import pose_matrix
from robosac.detectors import DetectorInfo, Message, TensorSpec

POSE = pose_matrix(1.0, 2.0, 1.7, 0.5)
INFO = DetectorInfo(
    "tiny",
    {
        "ego": {"features": TensorSpec("float16", (2, 3)), "grid": TensorSpec("uint8", (4,))},
        "teammate": {"features": TensorSpec("float16", (2, 3))},
    },
    (-32, -32, 32, 32),
    2.0,
    "0",
    0.3,
)
FEATURES = np.arange(6, dtype=np.float16).reshape(2, 3)
TEAMMATE = Message(POSE, {"features": FEATURES})
EGO = Message(POSE, {"features": FEATURES, "grid": np.array([1, 0, 1, 1], dtype=np.uint8)})


def test_a_message_survives_the_journey():
    envelope = wire.read_message(wire.pack_message(7, "car-2", TEAMMATE))
    assert (envelope.frame, envelope.vehicle_id) == (7, "car-2")
    message = wire.check_message(envelope.payload, INFO, "teammate")
    np.testing.assert_array_equal(message.pose, POSE)
    np.testing.assert_array_equal(message.tensors["features"], FEATURES)
    assert message.tensors["features"].dtype == np.float16


def test_a_frame_survives_the_journey():
    envelope = wire.read_frame(wire.pack_frame(3, EGO, {"car-2": TEAMMATE}))
    ego = wire.check_message(envelope.ego, INFO, "ego", "ego")
    np.testing.assert_array_equal(ego.tensors["grid"], EGO.tensors["grid"])
    assert list(envelope.teammates) == ["car-2"]


def test_a_number_may_be_an_integer_of_numpy():
    assert wire.pack_message(np.int64(7), "car-2", TEAMMATE) == wire.pack_message(7, "car-2", TEAMMATE)
    assert wire.pack_frame(np.int64(7), EGO, {}) == wire.pack_frame(7, EGO, {})


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (Message(POSE.tolist(), TEAMMATE.tensors), "pose must be a numpy array, got list"),
        (Message(POSE, {"features": FEATURES.tolist()}), "features must be a numpy array, got list"),
    ],
)
def test_what_is_no_array_is_packed_in_no_body(message, words):
    with pytest.raises(TypeError, match=f"^{words}$"):
        wire.pack_message(7, "car-2", message)


def test_tensors_travel_little_endian_in_c_order():
    odd = Message(POSE, {"features": np.asfortranarray(FEATURES.astype(">f2"))})
    packed = msgpack.unpackb(wire.pack_message(0, "x", odd))
    assert packed["tensors"]["features"]["data"] == FEATURES.astype("<f2").tobytes()
    assert packed["tensors"]["features"]["dtype"] == "float16"


def altered(path, value):
    fields = msgpack.unpackb(wire.pack_message(0, "car-2", TEAMMATE))
    *parents, last = path.split(".")
    target = fields
    for name in parents:
        target = target[name]
    if value is KeyError:
        del target[last]
    else:
        target[last] = value
    return msgpack.packb(fields)


def with_value(value):
    array = FEATURES.copy()
    array[1, 1] = value
    return array.tobytes()


SHEAR = [1, 1, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
MIRROR = [1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]

UPSIDE_DOWN = [1, 0, 0, 0, 0, -1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1]
AFAR = [1, 0, 0, 1e300, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]


@pytest.mark.parametrize(
    ("path", "value", "code"),
    [
        ("frame", KeyError, "missing-field"),
        ("frame", "1", "wrong-type"),
        ("frame", True, "wrong-type"),
        ("frame", 1.0, "wrong-type"),
        ("frame", -1, "out-of-range"),
        ("frame", 2**60, "out-of-range"),
        ("vehicle_id", KeyError, "missing-field"),
        ("vehicle_id", 5, "wrong-type"),
        ("pose", KeyError, "missing-field"),
        ("pose", [1.0] * 15, "bad-pose"),
        ("pose", "identity", "bad-pose"),
        ("pose", [[1.0] * 4] * 4, "bad-pose"),
        ("pose", ["0"] * 16, "bad-pose"),
        ("pose", [float("nan")] * 16, "non-finite"),
        ("pose", [0.0] * 16, "bad-pose"),
        ("pose", [1e300] * 16, "bad-pose"),
        ("pose", SHEAR, "bad-pose"),
        ("pose", MIRROR, "bad-pose"),
        ("pose", AFAR, "bad-pose"),
        ("pose", [*np.eye(4).ravel()[:15].tolist(), 2.0], "bad-pose"),
        ("pose", UPSIDE_DOWN, "bad-pose"),
        ("tensors", KeyError, "missing-field"),
        ("tensors", [], "wrong-type"),
        ("tensors.features", KeyError, "missing-field"),
        ("tensors.features", None, "wrong-type"),
        ("tensors.extra", {}, "unknown-tensor"),
        ("tensors.features.dtype", "float64", "wrong-dtype"),
        ("tensors.features.dtype", 3, "wrong-type"),
        ("tensors.features.shape", [3, 2], "wrong-shape"),
        ("tensors.features.shape", [65536, 65536], "wrong-shape"),
        ("tensors.features.shape", "2x3", "wrong-type"),
        ("tensors.features.shape", [2.0, 3.0], "wrong-type"),
        ("tensors.features.data", b"123", "wrong-length"),
        ("tensors.features.data", FEATURES.tobytes() + b"12", "wrong-length"),
        ("tensors.features.data", "text", "wrong-type"),
        ("tensors.features.data", with_value(np.nan), "non-finite"),
        ("tensors.features.data", with_value(-np.inf), "non-finite"),
    ],
)
def test_what_is_wrong_is_named(path, value, code):
    with pytest.raises(wire.WireError) as caught:
        wire.check_message(wire.read_message(altered(path, value)).payload, INFO, "teammate")
    assert caught.value.code == code
    expected = "tensors" if path == "tensors.extra" else path
    assert caught.value.field == expected
    assert caught.value.detail


def test_an_ego_must_send_its_own_tensors_too():
    with pytest.raises(wire.WireError) as caught:
        wire.check_message(wire.read_message(wire.pack_message(0, "e", TEAMMATE)).payload, INFO, "ego", "ego")
    assert (caught.value.code, caught.value.field) == ("missing-field", "ego.tensors.grid")


GOOD = wire.pack_message(0, "car-2", TEAMMATE)


@pytest.mark.parametrize(
    "body",
    [
        b"",
        GOOD[:-1],
        GOOD + b"\x00",
        b"\xc6\xff\xff\xff\xff",  # a binary of 4 GiB
        b"\xdb\xff\xff\xff\xff",  # a string of 4 GiB
        b"\xdd\xff\xff\xff\xff",  # an array of 4 Gi entries
        b"\xdf\xff\xff\xff\xff",  # a map of 4 Gi entries
        b"\x91" * 5000,  # nesting
        b"\x81\x90\x02",  # a key that is an array
        b"\x92" + (b"\xdc\x00\x40" + b"\x80" * 64) * 2000,  # too many small containers
        b"\xdc\x00\x41" + b"\x00" * 65,  # a long array
        b"\xa2\xff\xfe",  # a string that is not UTF-8
        b"\xc1",
    ],
)
def test_a_body_that_is_no_msgpack_within_limits_is_refused(body):
    with pytest.raises(wire.WireError) as caught:
        wire.read_message(body)
    assert (caught.value.code, caught.value.field) == ("malformed-msgpack", "")


@pytest.mark.parametrize("body", [GOOD + b"\x00", b"hello", b'{"frame": 0}'])
def test_bytes_after_the_value_are_told_as_such(body):
    with pytest.raises(wire.WireError, match="is no msgpack, or has bytes left over after its one value"):
        wire.read_message(body)


@pytest.mark.parametrize("value", [None, 3, [], "x", msgpack.ExtType(1, b"abcd"), msgpack.Timestamp(0)])
def test_a_body_that_is_no_map_is_refused(value):
    for read in (wire.read_message, wire.read_frame):
        with pytest.raises(wire.WireError, match="must be a map"):
            read(msgpack.packb(value))


@pytest.mark.parametrize(("value", "told"), [(3, "an integer"), (0.5, "a float"), (True, "a boolean")])
def test_what_came_instead_is_told_in_the_words_of_msgpack(value, told):
    with pytest.raises(wire.WireError, match=f"^body: must be a map, got {told}$"):
        wire.read_message(msgpack.packb(value))


def frame_with(name: bytes, member: bytes, times: int = 1) -> bytes:
    """A frame with further members, so many of a name that takes one number."""
    more = b"".join(name.replace(b"%", msgpack.packb(number)) + member for number in range(times))
    known = msgpack.packb({"frame": 0, "ego": {}, "teammates": {}})[1:]
    return b"\xde" + (3 + times).to_bytes(2, "big") + more + known


FEW = b"\xdc\x00\x40" + (b"\xdc\x00\x40" + b"\x90" * 64) * 64
"""Small containers, as many as a body may have."""


@pytest.mark.parametrize(
    "body",
    [
        frame_with(b"\xdd" + (2**18).to_bytes(4, "big") + b"\x90" * 2**18, b"\xc0"),  # a name that is a long array
        frame_with(b"%", FEW, 60),  # members that are small enough each, and too much together
    ],
    ids=["name", "members"],
)
def test_a_frame_that_is_unpacked_in_parts_is_bounded_as_a_whole(body):
    tracemalloc.start()
    try:
        with pytest.raises(wire.WireError) as caught:
            wire.read_frame(body)
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert caught.value.code == "malformed-msgpack"
    assert most < 4 * len(body) + 2**22


def test_broken_parts_of_others_than_the_team_are_not_unpacked_one_by_one(monkeypatch):
    good = msgpack.packb({"frame": 0, "ego": {}})[1:]
    parts = b"".join(msgpack.packb(f"car-{number}") + b"\xa1\xff" for number in range(400))
    body = b"\x83" + good + msgpack.packb("teammates") + b"\xde" + (401).to_bytes(2, "big") + b"\xa3rsu\x80" + parts
    unpacked, unpack = [], wire.bodies.unpack
    monkeypatch.setattr("robosac.wire.bodies.unpack", lambda body, **how: unpacked.append(body) or unpack(body, **how))
    frame = wire.read_frame(body, ("rsu", "car-3"))
    assert frame.teammates == {"rsu": {}}
    assert len(frame.unreadable) == 400
    assert frame.unreadable["car-3"].field == "teammates.car-3"
    assert len(unpacked) == 1 + 2 + 2  # the whole, the frame's other members, the parts of the team


@pytest.mark.parametrize("body", [b"\x82\xa1a\x01\xa1a\x02", b"\x81\xa1b\x82\xa1a\x01\xa1a\x01"], ids=["top", "inside"])
def test_a_name_that_comes_twice_is_refused(body):
    with pytest.raises(wire.WireError, match="'a' comes more than once in a map") as caught:
        wire.unpack(body)
    assert caught.value.code == "malformed-msgpack"


@pytest.mark.parametrize("team", [None, ("rsu", "car-3")])
def test_a_teammate_that_comes_twice_in_a_frame_is_unreadable_and_no_other(team):
    good = msgpack.packb({"frame": 0, "ego": {}})[1:]
    body = b"\x83" + good + msgpack.packb("teammates") + b"\x83\xa3rsu\x80\xa5car-3\x80\xa5car-3\x81\x00\x00"
    frame = wire.read_frame(body, team)
    assert frame.teammates == {"rsu": {}}
    assert str(frame.unreadable["car-3"]) == "teammates.car-3: comes more than once in the frame"


def test_a_frame_with_a_member_twice_is_refused():
    body = b"\x84" + msgpack.packb({"frame": 0, "ego": {}, "teammates": {}})[1:] + msgpack.packb("frame") + b"\x01"
    with pytest.raises(wire.WireError, match="'frame' comes more than once"):
        wire.read_frame(body)


plain = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text(max_size=8)
    | st.binary(max_size=16),
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text(max_size=8), inner, max_size=5),
    max_leaves=20,
)


def survives(body):
    try:
        envelope = wire.read_message(body)
        wire.check_message(envelope.payload, INFO, "teammate")
    except wire.WireError as error:
        assert error.code
        assert len(error.detail) < 1000
    try:
        frame = wire.read_frame(body)
        wire.check_message(frame.ego, INFO, "ego", "ego")
    except wire.WireError:
        pass


@given(st.binary(max_size=200))
def test_random_bytes_raise_nothing_but_wire_errors(body):
    survives(body)


@given(st.integers(0, len(GOOD) - 1), st.binary(min_size=1, max_size=3))
def test_damaged_messages_raise_nothing_but_wire_errors(at, patch):
    survives(GOOD[:at] + patch + GOOD[at + len(patch) :])


@given(plain, st.sampled_from(["frame", "vehicle_id", "pose", "tensors", "tensors.features"]))
def test_any_value_in_any_place_raises_nothing_but_wire_errors(value, path):
    survives(altered(path, value))
