"""Maps in fewer bits for their way: narrower floats, or bytes with an exponent for each channel; and compressed bytes.

Nothing after reading knows of it: what is read has the type that the detector declares. Exponents are of two, so a map
that was rounded once can be narrowed and widened again without another loss: sender and receiver hold the same numbers.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import zstandard

from robosac.detectors.base import Message

BYTES = "int8"
"""The type of maps of bytes."""
MOST = 127
"""Largest magnitude of a byte."""
LEVEL = 1
"""Of compression: higher ones take longer, and save little more."""
Array = np.ndarray[Any, np.dtype[Any]]


class NarrowError(ValueError):
    """What was narrowed cannot be widened."""


def narrowed(array: Array, dtype: str) -> tuple[Array, Array | None]:
    """A map in a narrower type.

    Parameters
    ----------
    array : (C, ...) ndarray of floats
    dtype : str
        ``int8``, or of narrower floats.

    Returns
    -------
    data : (C, ...) ndarray
    exponents : (C,) int8 ndarray or None
        For ``int8``: value = data * 2 ** exponent of the channel, the least exponents with which all values fit.
    """
    if dtype != BYTES:
        most = float(np.finfo(dtype).max)
        return np.clip(array, -most, most).astype(dtype), None
    values = array.reshape(len(array), -1).astype(np.float64)
    largest = np.abs(values).max(axis=1, initial=0.0)
    least = np.log2(np.finfo(array.dtype).smallest_subnormal)
    exponents = np.ceil(np.log2(np.maximum(largest, 2.0**least) / MOST)).clip(max(least, -MOST - 1), MOST)
    most = np.minimum(MOST, np.floor(float(np.finfo(array.dtype).max) / 2.0**exponents))[:, None]
    data = np.clip(np.round(values / 2.0 ** exponents[:, None]), -most, most).astype(np.int8)
    return data.reshape(array.shape), exponents.astype(np.int8)


def widened(data: Array, exponents: Array | None, dtype: str) -> Array:
    """A map in the type that the detector declares.

    Parameters
    ----------
    data, exponents
        As `narrowed` returns them.
    dtype : str
        Of floats.

    Raises
    ------
    NarrowError
        If a value is too large for it.
    """
    wide = data.astype(np.float32 if exponents is not None else dtype)
    if exponents is not None:
        with np.errstate(over="ignore"):  # what overflows is refused
            wide = np.ldexp(wide, exponents.astype(np.int32).reshape(-1, *[1] * (data.ndim - 1)))
        if np.abs(wide).max(initial=0.0) > float(np.finfo(dtype).max):
            raise NarrowError(f"holds values that are too large for {dtype}")
    return wide.astype(dtype)


def compressed(data: bytes) -> bytes:
    """Data as one frame of zstd that tells its length."""
    return zstandard.ZstdCompressor(level=LEVEL).compress(data)


def expanded(data: bytes, length: int) -> bytes:
    """What `compressed` made of so many bytes.

    Raises
    ------
    NarrowError
        If it is not one frame of zstd, or tells another length; no more than the length is ever held.
    """
    try:
        told = zstandard.frame_content_size(data)
        if told != length:
            says = "does not tell its length" if told < 0 else f"tells {told} bytes"
            raise NarrowError(f"{says}, not {length}")
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=length, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise NarrowError(f"is not one frame of zstd: {error}") from error


def rounded(message: Message, dtype: str) -> Message:
    """A message as it is read by whoever gets its maps in a narrower type; a vehicle has to sign this one.

    Tensors that are no floats, or are as narrow, stay as they are; and those with NaN or infinity, which a gateway
    refuses.
    """
    tensors = {
        name: widened(*narrowed(array, dtype), array.dtype.name) if may_narrow(array, dtype) else array
        for name, array in message.tensors.items()
    }
    return Message(message.pose, tensors)


def may_narrow(array: Array, dtype: str) -> bool:
    """Whether an array holds floats of more bits than a type, all of them finite."""
    wider = array.dtype.kind == "f" and array.dtype.itemsize > np.dtype(dtype).itemsize
    return wider and bool(np.isfinite(array).all())
