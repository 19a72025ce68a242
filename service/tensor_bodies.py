"""Bodies of tensors for the API's own description: what they have to hold, and an example of each.

Both are made of what the detectors declare and of the codec's limits. msgpack has JSON's types and binary, so JSON
Schema describes it; lengths of binary are counted in bytes.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, get_args

import numpy as np

from robosac import wire
from robosac.detectors import DetectorInfo, Role, TensorSpec, narrow
from robosac.recording.truth import MOST_BOXES
from robosac.signatures import SIGNATURE_BYTES
from service.arriving.frames import SLACK_BYTES

Schema = dict[str, Any]
RENDERED = (
    "Written as JSON: `{base64, times}` stands for binary, the bytes of `base64` so many times. Maps of zeros are "
    "accepted; they show no vehicle."
)
EGO, TEAMMATES = "car-1", ("car-2", "car-3")
_LIMITS = (
    f"An array has at most {wire.MAX_ARRAY:,} items, a map {wire.MAX_MAP:,}, all of them together "
    f"{wire.MAX_ENTRIES:,}; a string has at most {wire.MAX_STRING:,} bytes."
)
_ROLES: tuple[Role, ...] = get_args(Role)
_FRAME = {"type": "integer", "minimum": 0, "maximum": wire.MAX_FRAME, "description": "Increases from frame to frame."}
_ID = {"type": "string", "pattern": wire.ID_PATTERN}
_POSE = {
    "type": "array",
    "items": {"type": "number"},
    "minItems": 16,
    "maxItems": 16,
    "description": "world_from_sensor, 4 x 4, row-major, metres. Finite; a rotation and a translation, z up.",
}

_TRUTH = {
    "type": "object",
    "description": "Of an ego, for recordings alone: what is true.",
    "required": ["boxes"],
    "properties": {
        "boxes": {
            "type": "object",
            "description": "x, y, length, width, yaw of each; ego frame, metres and radians.",
            "required": ["dtype", "shape", "data"],
            "properties": {
                "dtype": {"type": "string", "const": "float64"},
                "shape": {"type": "array", "prefixItems": [{"type": "integer", "maximum": MOST_BOXES}, {"const": 5}]},
                "data": {"type": "string", "format": "binary", "description": "Little-endian, C order, finite."},
            },
        },
        "attackers": {"type": "array", "items": _ID, "maxItems": wire.MAX_ARRAY},
    },
}


def message_body(infos: Sequence[DetectorInfo]) -> Schema:
    """What a vehicle's own message may be, for these detectors; for none of any names and sizes."""
    most = max((_bytes(info, role) for info in infos for role in _ROLES), default=0) + SLACK_BYTES
    size = f" At most {most:,} bytes." if infos else ""
    schema = {
        "type": "object",
        "description": f"A vehicle's own message, as msgpack.{size} {_LIMITS}",
        "required": ["frame", "vehicle_id", "pose", "tensors"],
        "properties": {"frame": _FRAME, "vehicle_id": _ID, **_part(infos, *_ROLES)["properties"]},
    }
    return _with_examples(schema, {info.name: _message_example(info) for info in infos})


def frame_body(infos: Sequence[DetectorInfo]) -> Schema:
    """What a whole frame may be, likewise."""
    sizes = [f"{_bytes(i, 'ego') + SLACK_BYTES:,} bytes and {_bytes(i, 'teammate') + SLACK_BYTES:,} more for each "
             f"teammate of a session with {i.name}" for i in infos]  # fmt: skip
    size = f" At most {'; '.join(sizes)}." if sizes else ""
    schema = {
        "type": "object",
        "description": f"A whole frame, as msgpack.{size} {_LIMITS}",
        "required": ["frame", "ego", "teammates"],
        "properties": {
            "frame": _FRAME,
            "ego": _part(infos, "ego"),
            "teammates": {
                "type": "object",
                "description": "By id.",
                "propertyNames": _ID,
                "maxProperties": wire.MAX_MAP,
                "additionalProperties": _part(infos, "teammate"),
            },
        },
    }
    return _with_examples(schema, {info.name: _frame_example(info) for info in infos})


def kept_frame(infos: Sequence[DetectorInfo]) -> Schema:
    """A whole frame as the gateway kept it."""
    schema = frame_body(infos)["schema"]
    state = {**_binary(), "description": "What the session remembered, JSON."}
    states = {"type": "object", "properties": {"before": state, "after": state}}
    return {"schema": {**schema, "properties": {**schema["properties"], "states": states}}}


def _with_examples(schema: Schema, examples: Mapping[str, Any]) -> Schema:
    told = {
        name: {"summary": f"For {name}", "description": RENDERED, "value": value} for name, value in examples.items()
    }
    return {"schema": schema, "examples": told} if told else {"schema": schema}


def _part(infos: Sequence[DetectorInfo], *roles: Role) -> Schema:
    """What one vehicle sends."""
    truth = {"truth": _TRUTH} if "ego" in roles else {}
    return {
        "type": "object",
        "required": ["pose", "tensors"],
        "properties": {
            "pose": _POSE,
            "tensors": _tensors(infos, roles),
            "signature": {
                **_binary(SIGNATURE_BYTES),
                "description": "Ed25519, of vehicles that sign.",
            },
            **truth,
        },
    }


def _tensors(infos: Sequence[DetectorInfo], roles: Sequence[Role]) -> Schema:
    if not infos:
        return {
            "type": "object",
            "description": "By name, as the session's detector wants them (`GET /v1/detectors`).",
            "additionalProperties": _tensor(None),
        }
    choices = [choice for info in infos for choice in _choices(info, roles)]
    return {
        "type": "object",
        "description": "As the session's detector wants them, no others.",
        **(choices[0] if len(choices) == 1 else {"anyOf": choices}),
    }


def _choices(info: DetectorInfo, roles: Sequence[Role]) -> Iterator[Schema]:
    """The tensors of each role, once where it makes no difference."""
    alike = all(info.tensors[role] == info.tensors[roles[0]] for role in roles)
    for role in roles[:1] if alike else roles:
        specs = info.tensors[role]
        yield {
            "title": info.name if alike else f"{info.name}, {role}",
            "required": list(specs),
            "properties": {name: _tensor(spec) for name, spec in specs.items()},
            "additionalProperties": False,
        }


def _tensor(spec: TensorSpec | None) -> Schema:
    dtype: Schema = {"type": "string", "description": "As numpy calls it."}
    shape: Schema = {"type": "array", "items": {"type": "integer"}}
    data, plain = _binary(), {}
    said = "numbers, little-endian, C order."
    if spec is not None:
        dtypes = [spec.dtype, *spec.narrower]
        dtype |= {"enum": dtypes} if spec.narrower else {"const": spec.dtype}
        shape["const"] = list(spec.shape)
        sizes = [math.prod(spec.shape) * np.dtype(name).itemsize for name in dtypes]
        plain = {
            "if": {"not": {"required": ["compression"]}},
            "then": {"properties": {"data": _binary(min(sizes), max(sizes))}},
        }
        finite = " None is NaN or infinite." if np.dtype(spec.dtype).kind == "f" else ""
        said = f"{' or '.join(f'{size:,}' for size in sizes)} bytes: {said}{finite}"
    properties = {"dtype": dtype, "shape": shape, "data": {**data, "description": said[0].upper() + said[1:]}}
    if spec is not None and narrow.BYTES in spec.narrower:
        told = f"With {narrow.BYTES}: a byte for each channel; value = data x 2 to the power of it."
        properties["exponents"] = {**_binary(spec.shape[0]), "description": told}
    properties["compression"] = {"const": wire.ZSTD, "description": "Where `data` is one frame of it, with its length."}
    return {"type": "object", "required": ["dtype", "shape", "data"], "properties": properties, **plain}


def _binary(least: int | None = None, most: int | None = None) -> Schema:
    sized = {} if least is None else {"minLength": least, "maxLength": most or least}
    return {"type": "string", "format": "binary", "contentMediaType": "application/octet-stream", **sized}


def _bytes(info: DetectorInfo, role: Role) -> int:
    return sum(spec.nbytes for spec in info.tensors[role].values())


def _message_example(info: DetectorInfo) -> Schema:
    return {"frame": 0, "vehicle_id": TEAMMATES[0], **_example(info, "teammate", 1)}


def _frame_example(info: DetectorInfo) -> Schema:
    teammates = {name: _example(info, "teammate", number) for number, name in enumerate(TEAMMATES, start=1)}
    return {"frame": 0, "ego": _example(info, "ego", 0), "teammates": teammates}


def _example(info: DetectorInfo, role: Role, number: int) -> Schema:
    """A map of zeros from 8 m beside the vehicle before."""
    pose = np.eye(4)
    pose[:3, 3] = 8.0 * number, 0.0, 1.8
    tensors = {
        name: {"dtype": spec.dtype, "shape": list(spec.shape), "data": _zeros(spec)}
        for name, spec in info.tensors[role].items()
    }
    return {"pose": pose.ravel().tolist(), "tensors": tensors}


def _zeros(spec: TensorSpec) -> Schema:
    one = np.zeros(1, dtype=spec.dtype).tobytes()
    return {"base64": base64.b64encode(one).decode(), "times": spec.nbytes // len(one)}
