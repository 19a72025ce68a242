import collections
import os
import pickle
import struct

import numpy as np
import pytest

from robosac.scenes.plain_pickle import MAX_FILE_BYTES, MAX_OPCODES, UnsafePickle, load_npy


def header(dtype="'|O'", shape="()"):
    text = f"{{'descr': {dtype}, 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()


@pytest.fixture
def saved(tmp_path):
    """Saves an object as published samples are, or bytes as they are, and says where."""

    def save(content):
        path = tmp_path / "0.npy"
        if isinstance(content, bytes):
            path.write_bytes(content)
        else:
            np.save(path, content)
        return path

    return save


@pytest.mark.parametrize(
    ("protocol", "module"),
    [(3, b"numpy.core.multiarray"), (3, b"numpy._core.multiarray"), (4, b"numpy._core.multiarray")],
)
def test_arrays_and_numbers_are_read_as_they_were(saved, protocol, module):
    content = {
        "ints": np.arange(6, dtype=np.int32).reshape(2, 3),
        "floats": np.array([[0.5, -1.25], [2.0, 3.0]], order="F"),
        "big": np.array([1, 2], dtype=">i2"),
        "flags": np.array([True, False]),
        "none": np.zeros((0, 4)),
        "number": np.int64(-3),
        "plain": 5,
    }
    wrapped = np.empty((), dtype=object)
    wrapped[()] = content
    pickled = pickle.dumps(wrapped, protocol=protocol).replace(b"numpy._core.multiarray", module)
    assert module in pickled
    read = load_npy(saved(header() + pickled))
    assert read.keys() == content.keys()
    assert read.pop("plain") == content.pop("plain")
    for name, expected in content.items():
        value = read[name].read()
        assert value.dtype == np.asarray(expected).dtype
        np.testing.assert_array_equal(value, expected)


def test_what_numpy_saves_today_is_read(saved):
    read = load_npy(saved({"a": np.arange(3)}))
    np.testing.assert_array_equal(read["a"].read(), np.arange(3))
    assert load_npy(saved(0)) == 0
    np.testing.assert_array_equal(load_npy(saved(np.eye(3))), np.eye(3))


class Hostile:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


def test_a_pickle_that_would_run_something_is_refused(saved, tmp_path):
    path = saved({"voxels": Hostile(tmp_path / "made")})
    with pytest.raises(UnsafePickle, match=r"asks for posix\.mkdir"):
        load_npy(path)
    assert not (tmp_path / "made").exists()
    np.load(path, allow_pickle=True)  # the file does what it says
    assert (tmp_path / "made").exists()


def array_of(shape, dtype, content, fortran=False):
    """A pickle of one array with any state, true or not."""

    class Liar:
        def __reduce__(self):
            return np.empty(0).__reduce__()[0], (np.ndarray, (0,), b"b"), (1, shape, np.dtype(dtype), fortran, content)

    wrapped = np.empty((), dtype=object)
    wrapped[()] = {"a": Liar()}
    return header() + pickle.dumps(wrapped, protocol=4)


@pytest.mark.parametrize(
    ("lie", "complaint"),
    [
        (array_of((10**12,), "f8", b"12345678"), "do not fill"),
        (array_of((2, -1), "f8", b""), "tuple of integers"),
        (array_of((1,), "O", [0]), "array of objects"),
        (array_of((1,), "M8[s]", b"12345678"), "'M8'"),
        (array_of((1,), "S8", b"12345678"), "'S8'"),
        (array_of((1,), "f8", "12345678"), "do not fill"),
    ],
)
def test_an_array_that_is_not_what_it_says_is_refused(lie, complaint, saved):
    content = load_npy(saved(lie))
    with pytest.raises(UnsafePickle, match=complaint):
        content["a"].read()


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (b"", "not a plain array"),
        (b"junk" * 40, "magic"),
        (header() + b"\x80\x04", "exhausted"),
        (header() + pickle.dumps({"a": 1}), "no array"),
        (header() + pickle.dumps(collections.OrderedDict()), "asks for collections.OrderedDict"),
        (header(shape="(2,)") + pickle.dumps([1, 2]), "array of objects"),
        (header("'<f8'", "(1000000000000,)") + bytes(8), "do not fill"),
        (header() + b"\x80\x04K\x01r\xff\xff\xff\x7f.", "memo"),
        (header() + b"\x80\x04" + b"K\x010" * MAX_OPCODES + b"N.", "steps"),
        (header() + b"\x80\x04cnumpy\nload\n.", r"asks for numpy\.load"),
        (header() + b"\x80\x04cother\nndarray\n.", r"asks for other\.ndarray"),
        (bytes(MAX_FILE_BYTES + 1), "larger than"),
    ],
)
def test_anything_else_is_refused(content, complaint, saved):
    with pytest.raises(UnsafePickle, match=complaint):
        load_npy(saved(content))
