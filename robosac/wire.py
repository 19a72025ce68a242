"""Messages and frames as msgpack: the one codec, for service and clients alike.

A tensor travels as ``{dtype, shape, data}`` with its bytes little-endian in C order, as int8 with ``exponents``, and
with ``compression`` as zstd (`robosac.detectors.narrow`); a pose as 16 numbers, row-major.
What is read is never trusted: sizes and entries are bounded while a body is unpacked, and types, shapes, lengths and
finiteness are checked against what the detector declares. Each refusal is a `WireError` with a stable code and the
field it is about.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import msgpack
import numpy as np

from robosac.boxes import FloatArray, pose_fault
from robosac.detectors import narrow
from robosac.detectors.base import DetectorInfo, Message, Role, TensorSpec
from robosac.signatures import SIGNATURE_BYTES

MAX_FRAME = 2**53 - 1
"""Largest frame number: what every JSON reader can hold exactly."""
MAX_ARRAY = 64
MAX_MAP = 1024
MAX_STRING = 2**16
MAX_ENTRIES = 2**16
"""Entries of all arrays and maps of a body: small containers by the million would cost far more than their bytes."""
ZSTD = "zstd"
SHOWN = 40
"""Characters of a sender's own words that an error repeats."""
_TYPES = {dict: "a map", list: "an array", str: "a string", bytes: "binary", type(None): "nil"}


class WireError(ValueError):
    """A body that cannot be accepted.

    Attributes
    ----------
    code : str
        Stable and machine-readable: ``malformed-msgpack``, ``missing-field``, ``wrong-type``, ``wrong-dtype``,
        ``wrong-shape``, ``wrong-length``, ``bad-compression``, ``non-finite``, ``bad-pose``, ``out-of-range``,
        ``unknown-tensor``.
    field : str
        Path of the offending part, such as ``tensors.features.data``; empty for the body itself.
    detail : str
        What was wrong, for a human.
    """

    def __init__(self, code: str, field: str, detail: str) -> None:
        super().__init__(f"{field or 'body'}: {detail}")
        self.code = code
        self.field = field
        self.detail = detail


@dataclass(frozen=True)
class Packing:
    """How tensors travel; see `robosac.detectors.narrow`."""

    dtype: str | None = None
    """A narrower type, for tensors that lose nothing by it (`robosac.detectors.narrow.rounded`)."""
    compress: bool = False


@dataclass(frozen=True)
class MessageEnvelope:
    """A vehicle's own message, its sender known and its content not yet checked."""

    frame: int
    vehicle_id: str
    payload: Mapping[Any, Any]


@dataclass(frozen=True)
class FrameEnvelope:
    """A whole frame, the contents of its messages not yet checked."""

    frame: int
    ego: Any
    teammates: Mapping[str, Any]
    states: Mapping[str, bytes] = field(default_factory=dict)
    """As `pack_frame` takes them."""


def pack_message(
    frame: int,
    vehicle_id: str,
    message: Message,
    signature: bytes | None = None,
    truth: Mapping[str, Any] | None = None,
    packing: Packing | None = None,
) -> bytes:
    """The body of a vehicle's own message, with its signature where it has one (`robosac.signatures`).

    An ego may add what is true (`robosac.recording.truth.Truth.as_fields`). By default tensors go as they are.
    """
    return pack({"frame": frame, "vehicle_id": vehicle_id, **_message_fields(message, packing, signature, truth)})


def pack_frame(
    frame: int,
    ego: Message,
    teammates: Mapping[str, Message],
    ego_signature: bytes | None = None,
    signatures: Mapping[str, bytes] | None = None,
    states: Mapping[str, bytes] | None = None,
    truth: Mapping[str, Any] | None = None,
    packing: Packing | None = None,
) -> bytes:
    """The body of a whole frame, with the signatures of those teammates that sign; truth and packing as `pack_message`.

    Of a frame that is kept, ``states`` may hold what the session remembered ``before`` and ``after`` it, as text
    (`robosac.audit.packing.packed_state`).
    """
    signed = signatures or {}
    fields = {name: _message_fields(message, packing, signed.get(name)) for name, message in teammates.items()}
    known = {"states": dict(states)} if states else {}
    return pack(
        {"frame": frame, "ego": _message_fields(ego, packing, ego_signature, truth), "teammates": fields, **known}
    )


def content_digest(frame: int, vehicle_id: str, message: Message) -> str:
    """SHA-256 (hexadecimal) of what a message says: who, which frame, pose, and every tensor.

    The same for a vehicle's own message and for its part of a whole frame. Hashed are, each behind its length as eight
    bytes, big-endian: the frame in decimal, the sender, the pose as 16 float64, then name, dtype, shape in decimal and
    data of every tensor by ascending name; numbers little-endian.
    """
    total = hashlib.sha256()
    parts = [str(frame).encode(), vehicle_id.encode(), message.pose.astype("<f8").tobytes()]
    for name, array in sorted(message.tensors.items()):
        shape = ",".join(map(str, array.shape))
        parts += [name.encode(), array.dtype.name.encode(), shape.encode(), _little_endian(array)]
    for part in parts:
        total.update(len(part).to_bytes(8, "big"))
        total.update(part)
    return total.hexdigest()


def read_signature(payload: Any, path: str = "") -> bytes | None:
    """The signature that came with a message, if one did."""
    fields = _Fields(payload, path)
    return None if fields.value.get("signature") is None else fields.take_bytes("signature", SIGNATURE_BYTES)


def pack(value: Any) -> bytes:
    """Any value of plain types, such as a frame result."""
    packed: bytes = msgpack.packb(value, use_bin_type=True)
    return packed


def unpack(body: bytes, *, trusted: bool = False) -> Any:
    """A body of plain types, within limits.

    Parameters
    ----------
    body : bytes
    trusted : bool
        Whether it comes from the gateway itself, whose results may be long; then only its length bounds it.

    Raises
    ------
    WireError
        ``malformed-msgpack``: it is cut off, has bytes left over, or holds what msgpack or the limits do not allow.
    """
    limit = len(body)
    entries = 0

    def count(container: Any) -> Any:
        nonlocal entries
        entries += 1 + len(container)
        if entries > MAX_ENTRIES and not trusted:
            raise ValueError(f"more than {MAX_ENTRIES} entries in all")
        return container

    try:
        return msgpack.unpackb(
            body,
            raw=False,
            strict_map_key=False,
            max_bin_len=limit,
            max_str_len=limit if trusted else min(limit, MAX_STRING),
            max_array_len=limit if trusted else min(limit, MAX_ARRAY),
            max_map_len=limit if trusted else min(limit, MAX_MAP),
            max_ext_len=limit,
            list_hook=count,
            object_hook=count,
        )
    except Exception as error:  # msgpack raises many unrelated types, ValueError and its own among them
        reason = str(error) or type(error).__name__
        raise WireError("malformed-msgpack", "", f"not a msgpack value within the limits: {reason}") from error


def read_message(body: bytes) -> MessageEnvelope:
    """Who sent a message and for which frame; the rest is left to `check_message`."""
    fields = _Fields(unpack(body))
    return MessageEnvelope(_frame(fields), fields.take("vehicle_id", str), fields.value)


def read_frame(body: bytes) -> FrameEnvelope:
    """The parts of a whole frame; each is left to `check_message`."""
    fields = _Fields(unpack(body))
    teammates = _named(fields.take("teammates", dict), "teammates")
    states = fields.value.get("states")
    kept = states if isinstance(states, dict) and all(isinstance(text, bytes) for text in states.values()) else {}
    return FrameEnvelope(_frame(fields), fields.take("ego"), teammates, kept)


def check_message(payload: Any, info: DetectorInfo, role: Role, path: str = "") -> Message:
    """Check pose and tensors of a message against what the detector declares.

    Parameters
    ----------
    payload : object
        What should be a mapping with ``pose`` and ``tensors``.
    info : DetectorInfo
    role : {"ego", "teammate"}
    path : str
        Where the payload stands in the body, for errors.

    Raises
    ------
    WireError
        For the first thing that is wrong.
    """
    fields = _Fields(payload, path)
    pose = _pose(fields.take("pose"), fields.at("pose"))
    tensors = _Fields(fields.take("tensors"), fields.at("tensors"))
    specs = info.tensors[role]
    unknown = [name for name in tensors.value if name not in specs][:4]
    if unknown:
        found, wanted = (", ".join(map(_shown, names)) for names in (unknown, specs))
        raise WireError("unknown-tensor", tensors.path, f"unexpected {found}; detector {info.name} wants {wanted}")
    return Message(pose, {name: _tensor(_Fields(tensors.take(name), tensors.at(name)), specs[name]) for name in specs})


def _message_fields(
    message: Message, packing: Packing | None, signature: bytes | None, truth: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    tensors = {name: _tensor_fields(array, packing or Packing()) for name, array in message.tensors.items()}
    fields = {"pose": [float(value) for value in message.pose.reshape(-1)], "tensors": tensors}
    more = {"signature": signature, "truth": truth}
    return fields | {name: value for name, value in more.items() if value is not None}


def _tensor_fields(array: np.ndarray[Any, np.dtype[Any]], packing: Packing) -> dict[str, Any]:
    more: dict[str, Any] = {}
    sent = array
    if packing.dtype is not None and narrow.is_wider(array, packing.dtype):
        bits, exponents = narrow.narrowed(array, packing.dtype)
        if np.array_equal(narrow.widened(bits, exponents, array.dtype.name), array):
            sent, more = bits, {} if exponents is None else {"exponents": exponents.tobytes()}
    data = _little_endian(sent)
    if packing.compress:
        data, more = narrow.compressed(data), {**more, "compression": ZSTD}
    return {"dtype": sent.dtype.name, "shape": list(sent.shape), "data": data, **more}


def _little_endian(array: np.ndarray[Any, np.dtype[Any]]) -> bytes:
    return np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<")).tobytes()


def _tensor(fields: _Fields, spec: TensorSpec) -> np.ndarray[Any, np.dtype[Any]]:
    name = fields.take("dtype", str)
    if name not in (spec.dtype, *spec.narrower):
        wanted = " or ".join(map(repr, (spec.dtype, *spec.narrower)))
        raise WireError("wrong-dtype", fields.at("dtype"), f"must be {wanted}, got {_shown(name)}")
    shape = fields.take("shape")
    if not isinstance(shape, list) or not all(type(n) is int for n in shape):
        raise WireError("wrong-type", fields.at("shape"), "must be an array of integers")
    if tuple(shape) != spec.shape:
        raise WireError("wrong-shape", fields.at("shape"), f"must be {list(spec.shape)}, got {_shown(shape)[1:-1]}")
    dtype = np.dtype(name).newbyteorder("<")
    data = _data(fields, math.prod(spec.shape) * dtype.itemsize)
    array = np.frombuffer(data, dtype=dtype).reshape(spec.shape)
    if dtype.kind == "f" and not _all_finite(array):
        raise WireError("non-finite", fields.at("data"), "holds NaN or infinity")
    return array if name == spec.dtype else _widened(fields, array, spec)


def _data(fields: _Fields, length: int) -> bytes:
    """The bytes of a tensor, expanded if they are compressed."""
    if "compression" not in fields.value:
        return fields.take_bytes("data", length)
    name = fields.take("compression", str)
    if name != ZSTD:
        raise WireError("bad-compression", fields.at("compression"), f"must be {ZSTD!r}, got {_shown(name)}")
    try:
        return narrow.expanded(fields.take("data", bytes), length)
    except narrow.NarrowError as error:
        raise WireError("bad-compression", fields.at("data"), str(error)) from error


def _widened(
    fields: _Fields, array: np.ndarray[Any, np.dtype[Any]], spec: TensorSpec
) -> np.ndarray[Any, np.dtype[Any]]:
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


def _pose(value: Any, path: str) -> FloatArray:
    if not isinstance(value, list) or len(value) != 16:
        got = f"{len(value)} of them" if isinstance(value, list) else _type(value)
        raise WireError("bad-pose", path, f"must be an array of 16 numbers, got {got}")
    if not all(type(v) in (int, float) for v in value):
        raise WireError("bad-pose", path, "must be an array of 16 numbers")
    pose = np.array(value, dtype=np.float64).reshape(4, 4)  # msgpack has no integers that are too large for it
    if not np.isfinite(pose).all():
        raise WireError("non-finite", path, "holds NaN or infinity")
    fault = pose_fault(pose)
    if fault:
        raise WireError("bad-pose", path, fault)
    return pose


def _frame(fields: _Fields) -> int:
    frame: int = fields.take("frame", int)
    if not 0 <= frame <= MAX_FRAME:
        raise WireError("out-of-range", "frame", f"must be between 0 and {MAX_FRAME}")
    return frame


class _Fields:
    """A map in a body, and its path there."""

    def __init__(self, value: Any, path: str = "") -> None:
        self.value: Mapping[Any, Any] = _of_type(value, dict, path)
        self.path = path

    def at(self, name: str) -> str:
        return f"{self.path}.{name}" if self.path else name

    def take(self, name: str, kind: type | None = None) -> Any:
        """A field that has to be there, of a type if one is given."""
        if name not in self.value:
            raise WireError("missing-field", self.at(name), "is missing")
        return self.value[name] if kind is None else _of_type(self.value[name], kind, self.at(name))

    def take_bytes(self, name: str, length: int) -> bytes:
        data: bytes = self.take(name, bytes)
        if len(data) != length:
            raise WireError("wrong-length", self.at(name), f"must be {length} bytes, got {len(data)}")
        return data


def _named(parts: Mapping[Any, Any], path: str) -> Mapping[str, Any]:
    """Parts of which each has a name: a number is none, else ``"5"`` and ``5`` would be two parts of one vehicle."""
    for name in parts:
        if not isinstance(name, str):
            raise WireError("wrong-type", path, f"a name must be a string, got {_type(name)} {_shown(name)}")
    return parts


def _of_type(value: Any, kind: type, path: str) -> Any:
    if type(value) is not kind:  # a bool is no integer
        wanted = "an integer" if kind is int else _TYPES[kind]
        raise WireError("wrong-type", path, f"must be {wanted}, got {_type(value)}")
    return value


def _type(value: Any) -> str:
    return _TYPES.get(type(value), type(value).__name__)


def _shown(name: Any) -> str:
    text = repr(str(name))
    return text if len(text) <= SHOWN else text[:SHOWN] + "..."
