"""Reading dicts of arrays out of pickled ``.npy`` files without running what a pickle can make Python run.

A pickle is a program. Here it may build containers, numbers, strings and numpy arrays, and nothing else: the few names
of numpy that an array's pickle calls are replaced by inert classes of this module, and every other name is refused.
Arrays are made from their bytes afterwards, once type, shape and length are seen to agree.
"""

from __future__ import annotations

import io
import math
import pickle
import pickletools
import re
from pathlib import Path
from typing import Any

import numpy as np

MAX_FILE_BYTES = 2**26
MAX_OPCODES = 2**18
_PLAIN_DTYPE = re.compile(r"[?biuf]\d{0,2}")
_NUMPY = re.compile(r"numpy(\._?core\.multiarray)?")


class UnsafePickle(ValueError):
    """A file that is not a plain array, or a dict of them."""


class PlainArray:
    """What stands for an array while its pickle is read; `read` makes the array."""

    def __init__(self, *_: object) -> None:  # of an empty array, which the state then replaces
        self._state: Any = None

    def __setstate__(self, state: Any) -> None:
        self._state = state

    def read(self) -> Any:
        """The array, or the one object of an array of objects without dimensions.

        Raises
        ------
        UnsafePickle
            If type, shape and content do not agree.
        """
        if not (isinstance(self._state, tuple) and len(self._state) == 5):
            raise UnsafePickle("an array without content")
        _, shape, dtype, fortran, content = self._state
        if not (isinstance(shape, tuple) and all(type(n) is int and n >= 0 for n in shape)):
            raise UnsafePickle("an array's shape must be a tuple of integers")
        if not isinstance(dtype, PlainDtype):
            raise UnsafePickle("an array without a dtype")
        if dtype.name.startswith("O"):
            if shape == () and isinstance(content, list) and len(content) == 1:
                return content[0]
            raise UnsafePickle("an array of objects")
        plain = dtype.read()
        if not isinstance(content, bytes) or len(content) != math.prod(shape) * plain.itemsize:
            raise UnsafePickle("an array whose bytes do not fill its shape")
        return np.frombuffer(content, dtype=plain).reshape(shape, order="F" if fortran else "C")


class PlainDtype:
    """What stands for a dtype while a pickle is read."""

    def __init__(self, name: object = "", *_: object) -> None:
        self.name = str(name)
        self._order = "="

    def __setstate__(self, state: Any) -> None:
        if not isinstance(state, tuple) or len(state) < 2 or state[1] not in ("<", ">", "=", "|"):
            raise UnsafePickle("a dtype without byte order")
        self._order = state[1]

    def read(self) -> np.dtype[Any]:
        """The dtype: bool, integer or float."""
        if not _PLAIN_DTYPE.fullmatch(self.name):
            raise UnsafePickle(f"an array of {self.name[:20]!r}")
        try:
            return np.dtype(self._order + self.name)
        except TypeError as error:
            raise UnsafePickle(f"an array of {self.name!r}") from error


class PlainScalar(PlainArray):
    """What stands for a number of numpy's; `read` makes an array without dimensions of it."""

    def __init__(self, dtype: object = None, content: object = None) -> None:
        super().__init__()
        self._state = (1, (), dtype, False, content)


_STAND_INS = {"_reconstruct": PlainArray, "ndarray": PlainArray, "dtype": PlainDtype, "scalar": PlainScalar}


class _Reader(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if _NUMPY.fullmatch(module) and name in _STAND_INS:
            return _STAND_INS[name]
        raise UnsafePickle(f"asks for {module[:40]}.{name[:40]}")


def load_npy(path: Path) -> Any:
    """The content of an ``.npy`` file: an array, or the object pickled in it.

    In a dict, arrays are left as `PlainArray`, to be made by those who want them.

    Parameters
    ----------
    path : Path
        A file of at most 64 MiB.

    Raises
    ------
    UnsafePickle
        If the file is no ``.npy`` file, is too large, or its pickle asks for anything but arrays and plain containers.
    OSError
        If it cannot be read.
    """
    with path.open("rb") as file:
        data = file.read(MAX_FILE_BYTES + 1)
    if len(data) > MAX_FILE_BYTES:
        raise UnsafePickle(f"larger than {MAX_FILE_BYTES} bytes")
    try:
        return _content(data)
    except Exception as error:  # a broken pickle raises nearly anything
        raise UnsafePickle(f"not a plain array or dict of arrays: {str(error) or type(error).__name__}") from error


def _content(data: bytes) -> Any:
    stream = io.BytesIO(data)
    major, _ = np.lib.format.read_magic(stream)
    header = np.lib.format.read_array_header_1_0 if major == 1 else np.lib.format.read_array_header_2_0
    shape, fortran, dtype = header(stream)
    if not dtype.hasobject:
        if len(data) - stream.tell() != math.prod(shape) * dtype.itemsize:
            raise UnsafePickle("an array whose bytes do not fill its shape")
        return np.frombuffer(data, dtype, offset=stream.tell()).reshape(shape, order="F" if fortran else "C")
    if shape != ():
        raise UnsafePickle("an array of objects")
    pickled = data[stream.tell() :]
    _check_opcodes(pickled)
    array = _Reader(io.BytesIO(pickled)).load()
    if not isinstance(array, PlainArray):
        raise UnsafePickle("no array")
    return array.read()


def _check_opcodes(pickled: bytes) -> None:
    """Refuse a pickle that has too many steps, or numbers its memo so high that the reader would reserve memory."""
    for count, (opcode, argument, _) in enumerate(pickletools.genops(pickled)):
        if count > MAX_OPCODES:
            raise UnsafePickle(f"more than {MAX_OPCODES} steps")
        if opcode.name.endswith("PUT") and int(argument or 0) > MAX_OPCODES:
            raise UnsafePickle("a memo numbered too high")
