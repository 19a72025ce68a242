"""Lines of an audit log as typed records."""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np
import rfc8785

from robosac.boxes import FloatArray
from robosac.consensus import Verdict
from robosac.defenses import Outcome, Source, State

Record = Mapping[str, Any]


class RecordError(ValueError):
    """A record without what its event has to say."""


def read(line: bytes) -> dict[str, Any]:
    """The record on a line, its line break taken off.

    Raises
    ------
    RecordError
        If it is not a JSON object.
    """
    try:
        record = json.loads(line.decode(), parse_constant=_no_number)
    except (ValueError, RecursionError) as error:
        raise RecordError(f"not JSON: {error}") from error
    if not isinstance(record, dict):
        raise RecordError("not JSON: no object")
    return record


def is_canonical(line: bytes, record: Record) -> bool:
    """Whether a line is the canonical form (RFC 8785) of its record."""
    try:
        canonical: bytes = rfc8785.dumps(dict(record))
    except (ValueError, RecursionError):
        return False
    return canonical == line


@dataclass(frozen=True)
class Proof:
    """Who said what: the digest of a message, and its sender's signature where it has one."""

    digest: str
    signature: bytes | None

    @classmethod
    def of(cls, value: Any, where: str) -> Proof:
        """Read one."""
        fields = _mapping(value, where)
        signature = fields.get("signature")
        try:
            raw = None if signature is None else base64.b64decode(signature, validate=True)
        except (binascii.Error, TypeError, ValueError) as error:
            raise RecordError(f"{where}.signature: not base64") from error
        return cls(_get(fields, "digest", str, where), raw)


@dataclass(frozen=True)
class SessionOpened:
    """With whom a session began, and under which settings."""

    ego_id: str
    detector: str
    weights_digest: str
    calibration_digest: str | None
    defense: Mapping[str, Any]
    public_keys: Mapping[str, str]
    state: State
    next_seed_commitment: str

    @classmethod
    def of(cls, record: Record) -> SessionOpened:
        """Read a record of this event."""
        return cls(
            ego_id=_get(record, "ego_id", str),
            detector=_get(record, "detector", str),
            weights_digest=_get(record, "weights_digest", str),
            calibration_digest=None
            if record.get("calibration_digest") is None
            else _get(record, "calibration_digest", str),
            defense=_get(record, "defense", dict),
            public_keys=_strings(record, "public_keys"),
            state=_state(record),
            next_seed_commitment=_get(record, "next_seed_commitment", str),
        )


@dataclass(frozen=True)
class TeamChanged:
    """The keys of the new team, and the defence's state for it."""

    public_keys: Mapping[str, str]
    state: State

    @classmethod
    def of(cls, record: Record) -> TeamChanged:
        """Read a record of this event."""
        return cls(_strings(record, "public_keys"), _state(record))


@dataclass(frozen=True)
class Equivocation:
    """Two different messages of one vehicle for one frame."""

    vehicle_id: str
    frame: int
    first: Proof
    second: Proof

    @classmethod
    def of(cls, record: Record) -> Equivocation:
        """Read a record of this event."""
        return cls(
            _get(record, "vehicle_id", str),
            _get(record, "frame", int),
            Proof.of(record.get("first"), "first"),
            Proof.of(record.get("second"), "second"),
        )


@dataclass(frozen=True)
class FrameAnswered:
    """A decision.

    Attributes
    ----------
    frame : int
    source : Source
    accepted : tuple of str
    rejected : mapping of vehicle id to str
        Reasons.
    hypotheses : tuple of Outcome
        In the order tested.
    sampling_steps : int
    boxes : (n, 6) float64 ndarray
        x, y, length, width, yaw, score; ego frame.
    ego_pose : (4, 4) float64 ndarray
        world_from_sensor.
    seed : str
        Hexadecimal.
    messages : mapping of vehicle id to Proof
        The ego's among them.
    out_of_time : bool
    fault : str or None
    state : mapping
        The defence's, afterwards.
    previous_frame : int or None
        Of the previous answer that the decision was given.
    next_seed_commitment : str
    """

    frame: int
    source: Source
    accepted: tuple[str, ...]
    rejected: Mapping[str, str]
    hypotheses: tuple[Outcome, ...]
    sampling_steps: int
    boxes: FloatArray
    ego_pose: FloatArray
    seed: str
    messages: Mapping[str, Proof]
    out_of_time: bool
    fault: str | None
    state: State
    previous_frame: int | None
    next_seed_commitment: str

    @classmethod
    def of(cls, record: Record) -> FrameAnswered:
        """Read a record of this event."""
        rejected = [_mapping(entry, "rejected") for entry in _get(record, "rejected", list)]
        messages = _get(record, "messages", dict)
        seed = _get(record, "seed", str)
        try:
            int(seed, 16)
            bytes.fromhex(seed)
            source = Source(_get(record, "source", str))
        except ValueError as error:
            raise RecordError(f"seed or source: {error}") from error
        return cls(
            frame=_get(record, "frame", int),
            source=source,
            accepted=_names(record, "accepted"),
            rejected={_get(e, "vehicle_id", str, "rejected"): _get(e, "reason", str, "rejected") for e in rejected},
            hypotheses=tuple(_outcome(entry) for entry in _get(record, "hypotheses", list)),
            sampling_steps=_get(record, "sampling_steps", int),
            boxes=_array(record, "boxes", (-1, 6)),
            ego_pose=_array(record, "ego_pose", (4, 4)),
            seed=seed,
            messages={name: Proof.of(proof, f"messages.{name}") for name, proof in messages.items()},
            out_of_time=_get(record, "out_of_time", bool),
            fault=None if record.get("fault") is None else _get(record, "fault", str),
            state=_state(record),
            previous_frame=None if record.get("previous_frame") is None else _get(record, "previous_frame", int),
            next_seed_commitment=_get(record, "next_seed_commitment", str),
        )


def _outcome(value: Any) -> Outcome:
    fields = _mapping(value, "hypotheses")
    index = fields.get("jaccard_index")
    if isinstance(index, bool) or not isinstance(index, int | float):
        raise RecordError("hypotheses.jaccard_index: must be a number")
    try:
        verdict = Verdict(_get(fields, "verdict", str, "hypotheses"))
    except ValueError as error:
        raise RecordError(f"hypotheses.verdict: {error}") from error
    return Outcome(_names(fields, "teammates", "hypotheses"), float(index), verdict)


def _get(fields: Mapping[str, Any], name: str, kind: type[Any], where: str = "") -> Any:
    path = f"{where}.{name}" if where else name
    if name not in fields:
        raise RecordError(f"{path}: is missing")
    if type(fields[name]) is not kind:
        raise RecordError(f"{path}: must be {kind.__name__}, not {type(fields[name]).__name__}")
    return fields[name]


def _mapping(value: Any, where: str) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        raise RecordError(f"{where}: must be an object")
    return value


def _names(fields: Mapping[str, Any], name: str, where: str = "") -> tuple[str, ...]:
    values = _get(fields, name, list, where)
    if not all(isinstance(value, str) for value in values):
        path = f"{where}.{name}" if where else name
        raise RecordError(f"{path}: must hold names")
    return tuple(values)


def _strings(fields: Mapping[str, Any], name: str) -> Mapping[str, str]:
    values: Mapping[str, str] = _get(fields, name, dict)
    if not all(isinstance(value, str) for value in values.values()):
        raise RecordError(f"{name}: must hold strings")
    return values


def _state(record: Record) -> State:
    state: State = _get(record, "state", dict)
    if "trusted" in state:
        _names(state, "trusted", "state")
    return state


def _array(fields: Mapping[str, Any], name: str, shape: tuple[int, ...]) -> FloatArray:
    try:
        return np.array(_get(fields, name, list), dtype=np.float64).reshape(shape)
    except (TypeError, ValueError) as error:
        raise RecordError(f"{name}: not numbers of shape {shape}") from error


def _no_number(text: str) -> NoReturn:
    raise ValueError(f"{text} is no number")
