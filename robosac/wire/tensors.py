"""A tensor as fields of a body, and back: its type, shape and bytes, and how they were made fewer for the way."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from robosac.detectors import narrow
from robosac.detectors.base import TensorSpec
from robosac.wire.fields import Fields, WireError, shown

ZSTD = "zstd"


@dataclass(frozen=True)
class Packing:
    """How tensors travel; see `robosac.detectors.narrow`."""

    dtype: str | None = None
    """A narrower type, for tensors that lose nothing by it (`robosac.detectors.narrow.rounded`)."""
    compress: bool = False


def tensor_fields(array: np.ndarray[Any, np.dtype[Any]], packing: Packing) -> dict[str, Any]:
    """A tensor as it is sent."""
    more: dict[str, Any] = {}
    sent = array
    if packing.dtype is not None and narrow.may_narrow(array, packing.dtype):
        bits, exponents = narrow.narrowed(array, packing.dtype)
        # by bytes, as signatures are of these: -0 is not 0
        if narrow.widened(bits, exponents, array.dtype.name).tobytes() == array.tobytes():
            sent, more = bits, {} if exponents is None else {"exponents": exponents.tobytes()}
    data = little_endian(sent)
    if packing.compress:
        data, more = narrow.compressed(data), {**more, "compression": ZSTD}
    return {"dtype": sent.dtype.name, "shape": list(sent.shape), "data": data, **more}


def little_endian(array: np.ndarray[Any, np.dtype[Any]]) -> bytes:
    """The bytes of an array in C order."""
    return np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<")).tobytes()


def read_tensor(fields: Fields, spec: TensorSpec) -> np.ndarray[Any, np.dtype[Any]]:
    """A tensor that was sent, checked against what the detector declares, and in the type that it declares.

    Raises
    ------
    WireError
        For the first thing that is wrong.
    """
    name = fields.take("dtype", str)
    if name not in (spec.dtype, *spec.narrower):
        wanted = " or ".join(map(repr, (spec.dtype, *spec.narrower)))
        raise WireError("wrong-dtype", fields.at("dtype"), f"must be {wanted}, got {shown(name)}")
    shape = fields.take("shape")
    if not isinstance(shape, list) or not all(type(n) is int for n in shape):
        raise WireError("wrong-type", fields.at("shape"), "must be an array of integers")
    if tuple(shape) != spec.shape:
        raise WireError("wrong-shape", fields.at("shape"), f"must be {list(spec.shape)}, got {shown(shape)[1:-1]}")
    dtype = np.dtype(name).newbyteorder("<")
    data = _data(fields, math.prod(spec.shape) * dtype.itemsize)
    array = np.frombuffer(data, dtype=dtype).reshape(spec.shape)
    if dtype.kind == "f" and not _all_finite(array):
        raise WireError("non-finite", fields.at("data"), "holds NaN or infinity")
    return array if name == spec.dtype else _widened(fields, array, spec)


def _data(fields: Fields, length: int) -> bytes:
    """The bytes of a tensor, expanded if they are compressed."""
    if "compression" not in fields.value:
        return fields.take_bytes("data", length)
    name = fields.take("compression", str)
    if name != ZSTD:
        raise WireError("bad-compression", fields.at("compression"), f"must be {ZSTD!r}, got {shown(name)}")
    try:
        return narrow.expanded(fields.take("data", bytes), length)
    except narrow.NarrowError as error:
        raise WireError("bad-compression", fields.at("data"), str(error)) from error


def _widened(fields: Fields, array: np.ndarray[Any, np.dtype[Any]], spec: TensorSpec) -> np.ndarray[Any, np.dtype[Any]]:
    exponents = None
    if array.dtype == np.int8:
        exponents = np.frombuffer(fields.take_bytes("exponents", spec.shape[0]), dtype=np.int8)
    try:
        return narrow.widened(array, exponents, spec.dtype)
    except narrow.NarrowError as error:
        raise WireError("out-of-range", fields.at("exponents"), str(error)) from error


def _all_finite(array: np.ndarray[Any, np.dtype[Any]]) -> bool:
    if array.dtype == np.dtype("<f2"):  # numpy widens half floats one by one; their exponent bits tell as well
        return bool(np.all((array.view("<u2") & 0x7C00) != 0x7C00))
    return bool(np.isfinite(array).all())
