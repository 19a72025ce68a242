"""Messages and frames as msgpack: the one codec, for service and clients alike.

A tensor travels as ``{dtype, shape, data}`` with its bytes little-endian in C order; a pose as 16 numbers, row-major.
What is read is never trusted: sizes and entries are bounded while a body is unpacked, and types, shapes, lengths and
finiteness are checked against what the detector declares. Each refusal is a `WireError` with a stable code and the
field it is about.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import msgpack
import numpy as np

from robosac.boxes import FloatArray
from robosac.detectors.base import DetectorInfo, Message, Role, TensorSpec
from robosac.signatures import SIGNATURE_BYTES

MAX_FRAME = 2**53 - 1
"""Largest frame number: what every JSON reader can hold exactly."""
MAX_ARRAY = 64
MAX_MAP = 1024
MAX_STRING = 2**16
MAX_ENTRIES = 2**16
"""Entries of all arrays and maps of a body together: small containers by the million would cost far more than their
bytes.
"""
SHOWN = 40
"""Characters of a sender's own words that an error repeats."""
RIGID_TOLERANCE = 1e-3
MIN_UPRIGHT = 0.5
"""Cosine of the largest tilt of a sensor; views from above mean nothing beyond it."""
MAX_TRANSLATION_M = 1e8
"""Farther than any earth-fixed frame needs; beyond it single precision would lose the warp."""


class WireError(ValueError):
    """A body that cannot be accepted.

    Attributes
    ----------
    code : str
        Stable and machine-readable: ``malformed-msgpack``, ``missing-field``, ``wrong-type``, ``wrong-dtype``,
        ``wrong-shape``, ``wrong-length``, ``non-finite``, ``bad-pose``, ``out-of-range``, ``unknown-tensor``.
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
    teammates: Mapping[Any, Any]


def pack_message(frame: int, vehicle_id: str, message: Message, signature: bytes | None = None) -> bytes:
    """The body of a vehicle's own message, with its signature where it has one (`robosac.signatures`)."""
    return pack({"frame": frame, "vehicle_id": vehicle_id, **_message_fields(message, signature)})


def pack_frame(
    frame: int,
    ego: Message,
    teammates: Mapping[str, Message],
    ego_signature: bytes | None = None,
    signatures: Mapping[str, bytes] | None = None,
) -> bytes:
    """The body of a whole frame, with the signatures of those teammates that sign."""
    signed = signatures or {}
    fields = {name: _message_fields(message, signed.get(name)) for name, message in teammates.items()}
    return pack({"frame": frame, "ego": _message_fields(ego, ego_signature), "teammates": fields})


def content_digest(frame: int, vehicle_id: str, message: Message) -> str:
    """SHA-256 (hexadecimal) of what a message says: who, which frame, pose, and every tensor.

    The same for a vehicle's own message and for its part of a whole frame. Hashed are, each behind its length as eight
    bytes, big-endian: the frame in decimal, the sender, the pose as 16 float64, then name, dtype, shape in decimal and
    data of every tensor by ascending name; numbers little-endian.
    """
    total = hashlib.sha256()
    parts: list[bytes] = [
        str(frame).encode(),
        vehicle_id.encode(),
        np.ascontiguousarray(message.pose, dtype="<f8").tobytes(),
    ]
    for name, array in sorted(message.tensors.items()):
        data = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<")).tobytes()
        parts += [name.encode(), array.dtype.name.encode(), ",".join(map(str, array.shape)).encode(), data]
    for part in parts:
        total.update(len(part).to_bytes(8, "big"))
        total.update(part)
    return total.hexdigest()


def read_signature(payload: Any, path: str = "") -> bytes | None:
    """The signature that came with a message, if one did."""
    value = _mapping(payload, path).get("signature")
    if value is None:
        return None
    where = _join(path, "signature")
    if not isinstance(value, bytes):
        raise WireError("wrong-type", where, f"must be binary, got {_type(value)}")
    if len(value) != SIGNATURE_BYTES:
        raise WireError("wrong-length", where, f"must be {SIGNATURE_BYTES} bytes, got {len(value)}")
    return value


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
        ``malformed-msgpack`` if the body is truncated, has bytes left over, nests too deeply, or holds what msgpack or
        the limits do not allow.
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
    fields = _mapping(unpack(body), "")
    return MessageEnvelope(_frame(fields), _string(_get(fields, "vehicle_id", ""), "vehicle_id"), fields)


def read_frame(body: bytes) -> FrameEnvelope:
    """The parts of a whole frame; each is left to `check_message`."""
    fields = _mapping(unpack(body), "")
    teammates = _mapping(_get(fields, "teammates", ""), "teammates")
    return FrameEnvelope(_frame(fields), _get(fields, "ego", ""), teammates)


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
    fields = _mapping(payload, path)
    pose = _pose(_get(fields, "pose", path), _join(path, "pose"))
    where = _join(path, "tensors")
    tensors = _mapping(_get(fields, "tensors", path), where)
    specs = info.tensors[role]
    unknown = [name for name in tensors if name not in specs][:4]
    if unknown:
        raise WireError(
            "unknown-tensor", where, f"unexpected {_quoted(unknown)}; detector {info.name} wants {_quoted(specs)}"
        )
    checked = {name: _tensor(_get(tensors, name, where), spec, _join(where, name)) for name, spec in specs.items()}
    return Message(pose, checked)


def _message_fields(message: Message, signature: bytes | None) -> dict[str, Any]:
    tensors = {}
    for name, array in message.tensors.items():
        little = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<"))
        tensors[name] = {"dtype": array.dtype.name, "shape": list(array.shape), "data": little.tobytes()}
    fields: dict[str, Any] = {"pose": [float(value) for value in message.pose.reshape(-1)], "tensors": tensors}
    return fields if signature is None else {**fields, "signature": signature}


def _tensor(value: Any, spec: TensorSpec, path: str) -> np.ndarray[Any, np.dtype[Any]]:
    fields = _mapping(value, path)
    name = _string(_get(fields, "dtype", path), _join(path, "dtype"))
    if name != spec.dtype:
        raise WireError("wrong-dtype", _join(path, "dtype"), f"must be {spec.dtype!r}, got {_shown(name)}")
    shape = _get(fields, "shape", path)
    if not isinstance(shape, list) or not all(type(n) is int for n in shape):
        raise WireError("wrong-type", _join(path, "shape"), "must be an array of integers")
    if tuple(shape) != spec.shape:
        raise WireError("wrong-shape", _join(path, "shape"), f"must be {list(spec.shape)}, got {_shown(shape)[1:-1]}")
    data = _get(fields, "data", path)
    if not isinstance(data, bytes):
        raise WireError("wrong-type", _join(path, "data"), f"must be binary, got {_type(data)}")
    dtype = np.dtype(spec.dtype).newbyteorder("<")
    expected = math.prod(spec.shape) * dtype.itemsize
    if len(data) != expected:
        raise WireError("wrong-length", _join(path, "data"), f"must be {expected} bytes, got {len(data)}")
    array = np.frombuffer(data, dtype=dtype).reshape(spec.shape)
    if dtype.kind == "f" and not _all_finite(array):
        raise WireError("non-finite", _join(path, "data"), "holds NaN or infinity")
    return array


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
    try:
        pose = np.array(value, dtype=np.float64).reshape(4, 4)
    except OverflowError as error:
        raise WireError("bad-pose", path, "a number is too large") from error
    if not np.isfinite(pose).all():
        raise WireError("non-finite", path, "holds NaN or infinity")
    rotation = pose[:3, :3]
    rigid = (np.abs(rotation) <= 1 + RIGID_TOLERANCE).all() and np.allclose(
        rotation @ rotation.T, np.eye(3), atol=RIGID_TOLERANCE
    )
    if not rigid or np.linalg.det(rotation) < 0 or not np.allclose(pose[3], (0, 0, 0, 1), atol=1e-9):
        raise WireError("bad-pose", path, "must be a rigid transform: a rotation, a translation, last row 0 0 0 1")
    if rotation[2, 2] < MIN_UPRIGHT:
        raise WireError("bad-pose", path, "must be upright: the sensor's z axis within 60 degrees of the world's")
    if np.abs(pose[:3, 3]).max() > MAX_TRANSLATION_M:
        raise WireError("bad-pose", path, f"must lie within {MAX_TRANSLATION_M:g} m of the world's origin")
    return pose


def _frame(fields: Mapping[Any, Any]) -> int:
    frame = _get(fields, "frame", "")
    if type(frame) is not int:
        raise WireError("wrong-type", "frame", f"must be an integer, got {_type(frame)}")
    if not 0 <= frame <= MAX_FRAME:
        raise WireError("out-of-range", "frame", f"must be between 0 and {MAX_FRAME}")
    return frame


def _get(fields: Mapping[Any, Any], name: str, path: str) -> Any:
    if name not in fields:
        raise WireError("missing-field", _join(path, name), "is missing")
    return fields[name]


def _mapping(value: Any, path: str) -> Mapping[Any, Any]:
    if not isinstance(value, dict):
        raise WireError("wrong-type", path, f"must be a map, got {_type(value)}")
    return value


def _string(value: Any, path: str) -> str:
    if not isinstance(value, str):
        raise WireError("wrong-type", path, f"must be a string, got {_type(value)}")
    return value


def _join(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name


def _quoted(names: Any) -> str:
    return ", ".join(_shown(name) for name in names)


def _shown(name: Any) -> str:
    text = repr(str(name))
    return text if len(text) <= SHOWN else text[:SHOWN] + "..."


def _type(value: Any) -> str:
    return {dict: "a map", list: "an array", str: "a string", bytes: "binary", type(None): "nil"}.get(
        type(value), type(value).__name__
    )
