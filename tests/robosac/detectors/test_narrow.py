"""Maps in fewer bits: what is lost, and that nothing more is lost the second time."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from robosac import wire
from robosac.boxes import pose_matrix
from robosac.detectors import Message, load
from robosac.detectors.narrow import BYTES, MOST, NarrowError, narrowed, rounded, widened
from robosac.scenes import IntersectionScene

SHAPE = (3, 2, 4)


def wide(array, dtype):
    return widened(*narrowed(array, dtype), array.dtype.name)


def finite(dtype, width):
    return arrays.arrays(dtype, SHAPE, elements=st.floats(width=width, allow_nan=False, allow_infinity=False))


@given(array=finite(np.float16, 16))
@settings(max_examples=200, deadline=None)
def test_half_floats_as_bytes_are_near_and_the_same_ever_after(array):
    once = wide(array, BYTES)
    assert once.dtype == np.float16
    assert np.isfinite(once).all()
    largest = np.abs(array.astype(np.float64)).max(axis=(1, 2), keepdims=True)
    step = np.maximum(largest / (MOST / 2), 2.0**-24)  # exponents of two: at worst half of the bytes are used
    assert (np.abs(once.astype(np.float64) - array.astype(np.float64)) <= step / 2 + largest * 1e-3).all()
    np.testing.assert_array_equal(wide(once, BYTES), once)


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_the_largest_values_stay_finite(dtype):
    array = np.full(SHAPE, np.finfo(dtype).max, dtype=dtype)
    once = wide(array, BYTES)
    assert np.isfinite(once).all()
    np.testing.assert_allclose(once, array, rtol=1 / 64)
    np.testing.assert_array_equal(wide(once, BYTES), once)


@given(array=finite(np.float32, 32), dtype=st.sampled_from(["float16", BYTES]))
@settings(max_examples=200, deadline=None)
def test_floats_stay_the_same_after_the_first_time(array, dtype):
    once = wide(array, dtype)
    assert once.dtype == np.float32
    assert np.isfinite(once).all()
    np.testing.assert_array_equal(wide(once, dtype), once)


def test_each_channel_has_an_exponent_of_its_own():
    array = np.zeros((3, 2, 2), dtype=np.float16)
    array[0], array[1] = 100.0, 0.001
    data, exponents = narrowed(array, BYTES)
    assert data.dtype == exponents.dtype == np.int8
    assert (exponents[0], int(data[0, 0, 0])) == (0, 100)
    assert float(wide(array, BYTES)[1, 0, 0]) == pytest.approx(0.001, rel=0.01)
    assert not wide(array, BYTES)[2].any()


def test_exponents_that_make_values_too_large_are_refused():
    data = np.full(SHAPE, MOST, dtype=np.int8)
    assert widened(data, np.full(3, 8, dtype=np.int8), "float16").max() == 127 * 256
    with pytest.raises(NarrowError, match="too large for float16"):
        widened(data, np.full(3, 10, dtype=np.int8), "float16")
    with pytest.raises(NarrowError, match="too large for float32"):
        widened(data, np.full(3, 127, dtype=np.int8), "float32")


def test_what_is_no_float_or_as_narrow_stays():
    grid, half = np.ones((2, 3), dtype=np.uint8), np.full((1, 3), 0.3, dtype=np.float16)
    message = Message(pose_matrix(0, 0, 0, 0), {"grid": grid, "half": half})
    same = rounded(message, "float16")
    assert same.tensors["grid"] is grid
    assert same.tensors["half"] is half
    assert rounded(message, BYTES).tensors["grid"] is grid


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_stays_to_be_refused(value):
    array = np.ones((2, 3), dtype=np.float16)
    array[1, 2] = value
    message = Message(pose_matrix(0, 0, 0, 0), {"map": array})
    assert rounded(message, BYTES).tensors["map"] is array
    fields = wire.unpack(wire.pack_message(0, "car-2", message, packing=wire.Packing(BYTES)))["tensors"]["map"]
    assert fields["dtype"] == "float16"


def test_the_shipped_detector_sees_the_same_vehicles():
    detector = load()
    views = IntersectionScene(1601).frame(3).views
    messages = {name: detector.encode(view.points, view.pose) for name, view in views.items()}
    narrow = {name: rounded(message, BYTES) for name, message in messages.items()}
    found = []
    for sent in (messages, narrow):
        own, *others = sent.values()
        prepared = detector.prepare(own, dict(zip("abcde", others, strict=True)))
        found.append(prepared.detect("abcde"))
    sure = [boxes[boxes[:, 5] >= 0.5] for boxes in found]
    assert len(sure[0]) == len(sure[1]) > 5
    apart = np.hypot(*np.moveaxis(sure[0][:, None, :2] - sure[1][None, :, :2], -1, 0)).min(axis=1)
    assert apart.max() < 0.1
