"""Bodies of messages and frames: packing, bounded unpacking, and what of them is checked."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Collection, Mapping, Sequence, Sized
from dataclasses import dataclass, field
from typing import Any

import msgpack
import numpy as np

from robosac.boxes import FloatArray, pose_fault
from robosac.detectors.base import DetectorInfo, Message, Role
from robosac.signatures import SIGNATURE_BYTES
from robosac.wire.fields import Fields, WireError, named, shown, type_of
from robosac.wire.tensors import Packing, little_endian, read_tensor, tensor_fields

MAX_FRAME = 2**53 - 1
"""Largest frame number: what every JSON reader can hold exactly."""
ID_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9._:-]{0,63}$"
"""Of a vehicle's id."""
MAX_ARRAY = 64
MAX_MAP = 1024
MAX_STRING = 2**16
MAX_ENTRIES = 2**16
"""Entries of all arrays and maps of a body: small containers by the million would cost far more than their bytes."""
_LEAST_SHARE = 256
"""Entries that a part of a body may have in any case where parts are unpacked one by one."""


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
    unreadable: Mapping[str, WireError] = field(default_factory=dict)
    """By teammate, what is wrong with a part that breaks msgpack or the limits; it is not among the others."""


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
    return pack(
        {"frame": _number(frame), "vehicle_id": vehicle_id, **_message_fields(message, packing, signature, truth)}
    )


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
        {
            "frame": _number(frame),
            "ego": _message_fields(ego, packing, ego_signature, truth),
            "teammates": fields,
            **known,
        }
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
        parts += [name.encode(), array.dtype.name.encode(), shape.encode(), little_endian(array)]
    for part in parts:
        total.update(len(part).to_bytes(8, "big"))
        total.update(part)
    return total.hexdigest()


def read_signature(payload: Any, path: str = "") -> bytes | None:
    """The signature that came with a message, if one did."""
    fields = Fields(payload, path)
    return None if fields.value.get("signature") is None else fields.take_bytes("signature", SIGNATURE_BYTES)


def pack(value: Any) -> bytes:
    """Any value of plain types, such as a frame result."""
    packed: bytes = msgpack.packb(value, use_bin_type=True)
    return packed


def unpack(body: bytes, *, trusted: bool = False, most_entries: int = MAX_ENTRIES) -> Any:
    """A body of plain types, within limits.

    Parameters
    ----------
    body : bytes
    trusted : bool
        Whether it comes from the gateway itself, whose results may be long; then only its length bounds it.
    most_entries : int
        Of all arrays and maps together.

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
        if entries > most_entries and not trusted:
            raise ValueError(f"more than {most_entries} entries in all")
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
            object_pairs_hook=lambda pairs: named_once(count(pairs)),
        )
    except msgpack.ExtraData as error:
        raise WireError("malformed-msgpack", "", "is no msgpack, or has bytes left over after its one value") from error
    except Exception as error:  # msgpack raises many unrelated types, ValueError and its own among them
        reason = str(error) or type(error).__name__
        raise WireError("malformed-msgpack", "", f"not a whole msgpack value within the limits: {reason}") from error


def named_once(pairs: Sequence[tuple[Any, Any]]) -> dict[Any, Any]:
    """A map of its members; a ValueError where a name comes again: other readers may take the other one."""
    members = dict(pairs)
    if len(members) < len(pairs):
        name, _ = Counter(name for name, _ in pairs).most_common(1)[0]
        raise ValueError(f"{shown(name)} comes more than once in a map")
    return members


def read_message(body: bytes) -> MessageEnvelope:
    """Who sent a message and for which frame; the rest is left to `check_message`."""
    fields = Fields(unpack(body))
    return MessageEnvelope(_frame(fields), fields.take("vehicle_id", str), fields.value)


def read_frame(body: bytes, team: Collection[str] | None = None) -> FrameEnvelope:
    """The parts of a whole frame; each is left to `check_message`. A teammate's part that breaks msgpack or the limits
    spoils no other.

    If a ``team`` is given, the parts of others count as unreadable where parts are unpacked one by one: a small body
    may have hundreds that are broken.
    """
    try:
        value: Any = unpack(body)
        unreadable: dict[str, WireError] = {}
    except WireError as error:
        value, unreadable = _unpack_apart(body, error, team)
    fields = Fields(value)
    teammates = named(fields.take("teammates", dict), "teammates")
    states = fields.value.get("states")
    kept = states if isinstance(states, dict) and all(isinstance(text, bytes) for text in states.values()) else {}
    return FrameEnvelope(_frame(fields), fields.take("ego"), teammates, kept, unreadable)


def _unpack_apart(
    body: bytes, fault: WireError, team: Collection[str] | None
) -> tuple[dict[Any, Any], dict[str, WireError]]:
    """A frame with those teammates' parts that can be unpacked by themselves, and what is wrong with the others.

    Raises
    ------
    WireError
        The ``fault`` of the frame as a whole, if it is not one of teammates' parts.
    """
    try:
        members = named_once(_members(body))
        parts = _members(members.pop("teammates"))
        times = Counter(name for name, _ in parts)
        share = _share(members)
        frame = {name: unpack(member, most_entries=share) for name, member in members.items()}
    except Exception as error:  # as of `unpack`
        raise fault from error
    read: dict[Any, Any] = {}
    unreadable: dict[str, WireError] = {}
    share = _share(parts)
    for name, part in parts:
        wrong = fault
        if times[name] > 1:
            wrong = WireError(fault.code, "", "comes more than once in the frame")
        elif team is None or name in team:
            try:
                read[name] = unpack(part, most_entries=share)
                continue
            except WireError as error:
                wrong = error
        if not isinstance(name, str):
            raise fault
        unreadable[name] = WireError(wrong.code, f"teammates.{name}", wrong.detail)
    return {**frame, "teammates": read}, unreadable


def _share(parts: Sized) -> int:
    """Entries that each of some parts may have where they are unpacked one by one."""
    return max(MAX_ENTRIES // max(len(parts), 1), _LEAST_SHARE)


def _members(body: bytes) -> list[tuple[Any, bytes]]:
    """The members of a map, still packed; what is wrong inside them is not looked at. A name is no array and no map."""
    # arrays and maps are bounded among the names alone: what is skipped is not built
    walker = msgpack.Unpacker(
        strict_map_key=False, max_buffer_size=len(body), max_str_len=MAX_STRING, max_array_len=0, max_map_len=0
    )
    walker.feed(body)
    size = walker.read_map_header()
    if size > MAX_MAP:
        raise ValueError(f"more than {MAX_MAP} members")
    members = []
    for _ in range(size):
        name, start = walker.unpack(), walker.tell()
        walker.skip()
        members.append((name, body[start : walker.tell()]))
    if walker.tell() != len(body):
        raise ValueError("bytes are left over")
    return members


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
    fields = Fields(payload, path)
    pose = _pose(fields.take("pose"), fields.at("pose"))
    tensors = Fields(fields.take("tensors"), fields.at("tensors"))
    specs = info.tensors[role]
    unknown = [name for name in tensors.value if name not in specs][:4]
    if unknown:
        found, wanted = (", ".join(map(shown, names)) for names in (unknown, specs))
        raise WireError("unknown-tensor", tensors.path, f"unexpected {found}; detector {info.name} wants {wanted}")
    return Message(
        pose, {name: read_tensor(Fields(tensors.take(name), tensors.at(name)), specs[name]) for name in specs}
    )


def _number(frame: Any) -> Any:
    """A frame's number, as msgpack has it: integers of numpy are such, too."""
    return int(frame) if isinstance(frame, np.integer) else frame


def _message_fields(
    message: Message, packing: Packing | None, signature: bytes | None, truth: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    for name, array in {"pose": message.pose, **message.tensors}.items():
        if not isinstance(array, np.ndarray):
            raise TypeError(f"{name} must be a numpy array, got {type(array).__name__}")
    tensors = {name: tensor_fields(array, packing or Packing()) for name, array in message.tensors.items()}
    fields = {"pose": [float(value) for value in message.pose.reshape(-1)], "tensors": tensors}
    more = {"signature": signature, "truth": truth}
    return fields | {name: value for name, value in more.items() if value is not None}


def _pose(value: Any, path: str) -> FloatArray:
    if not isinstance(value, list) or len(value) != 16:
        got = f"{len(value)} of them" if isinstance(value, list) else type_of(value)
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


def _frame(fields: Fields) -> int:
    frame: int = fields.take("frame", int)
    if not 0 <= frame <= MAX_FRAME:
        raise WireError("out-of-range", "frame", f"must be between 0 and {MAX_FRAME}")
    return frame
