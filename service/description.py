"""What the API's own description (OpenAPI) says beyond types: groups of calls, tensor bodies, and an example of each.

A test holds every example against its type, and walks all routes.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel

from robosac.answers import FrameAnswer
from service.arriving.bodies import JSON, MSGPACK, described
from service.problems import documented
from service.schemas import (
    ChangedTeam,
    DetectorList,
    EnrolmentRequest,
    GatewayKeyList,
    Receipt,
    RenewedToken,
    SessionCreated,
    SessionRequest,
    SessionState,
    WatchableList,
)

Answers = dict[int | str, dict[str, Any]]
"""Of a route, by status."""
JSONL = "application/jsonl"
TAGS = [
    {"name": "sessions", "description": "An ego opens a session with its teammates, changes the team, and ends it."},
    {"name": "frames", "description": "Feature maps in, fused boxes out. Tensors travel as msgpack."},
    {"name": "audit", "description": "What was decided, to be checked by somebody else."},
    {"name": "gateway", "description": "What the gateway serves and signs with."},
    {"name": "live", "description": "What the gateway decides, for people who watch; the page at `/` shows it."},
    {"name": "operations", "description": "For whoever runs the gateway: no key or token is needed."},
]
_SESSION, _TIME, _HASH = "Fv0Zk7mXQ2yq1Jr3", "2026-11-21T09:30:00.000Z", "3b0c44298fc1c149afbf4c8996fb9242" * 2
_TOKEN = "eyJhbGciOiJIUzI1NiJ9.eyJzdWIiOiJjYXItMSJ9.c2lnbmF0dXJl"
_KEY = "MCowBQYDK2VwAyEA0Z1Jc4mXQ2yq1Jr3T4u5v6w7x8y="
_DEFENSE = {"kind": "sample_consensus", "attacker_ratio": 0.34, "sampling_budget": 7, "collaborators": 2}
_TIMING = {"latency_budget_ms": 200.0, "gather_ms": 100.0, "frame_period_ms": 200.0}
_RECEIPT = {"session": _SESSION, "seq": 2, "head": _HASH, "key_id": "5f2b8c", "signature": "c2lnbmF0dXJl"}
_FEATURES = {"features": {"dtype": "float16", "shape": [64, 32, 32]}}
_DETECTOR = {
    "name": "intersection-mean",
    "tensors": {"ego": _FEATURES, "teammate": _FEATURES},
    "area_m": [-32.0, -32.0, 32.0, 32.0],
    "cell_m": 2.0,
    "weights_digest": _HASH,
    "precision": "float32",
    "consensus_score": 0.3,
    "calibration": {"kinds": ["pgd", "erase", "open"], "pose_errors_m": [0.0, 0.2], "digest": _HASH},
}
EXAMPLES: Mapping[type[BaseModel], dict[str, Any]] = {
    SessionRequest: {
        "ego_id": "car-1",
        "teammates": ["car-2", "car-3", "rsu"],
        "defense": _DEFENSE,
        "latency_budget_ms": 200,
    },
    EnrolmentRequest: {"teammates": ["car-4"]},
    DetectorList: {"detectors": [_DETECTOR]},
    GatewayKeyList: {"keys": [{"key_id": "5f2b8c", "public_key": _KEY, "signs": True}]},
    SessionCreated: {
        "session_id": _SESSION,
        "ego_token": _TOKEN,
        "teammate_tokens": {"car-2": _TOKEN, "car-3": _TOKEN, "rsu": _TOKEN},
        "tokens_expire_at": _TIME,
        "detector": _DETECTOR,
        "defense": _DEFENSE,
        **_TIMING,
        "receipt": _RECEIPT,
    },
    SessionState: {
        "session_id": _SESSION,
        "ego_id": "car-1",
        "teammates": ["car-2", "car-3", "rsu"],
        "detector": "intersection-mean",
        "defense": _DEFENSE,
        **_TIMING,
        "created_at": _TIME,
        "last_frame": 0,
        "frames_answered": 1,
        "state": {"trusted": []},
        "suspicion": None,
        "audit_seq": 2,
        "audit_head": _HASH,
        "receipt": _RECEIPT,
        "next_seed_commitment": _HASH,
    },
    ChangedTeam: {
        "teammates": ["car-2", "car-3", "car-4", "rsu"],
        "teammate_tokens": {"car-4": _TOKEN},
        "tokens_expire_at": _TIME,
    },
    RenewedToken: {"token": _TOKEN, "expires_at": _TIME},
    WatchableList: {
        "sessions": [
            {
                "session_id": _SESSION,
                "ego_id": "car-1",
                "teammates": ["car-2", "car-3", "rsu"],
                "detector": "intersection-mean",
                "defense": "group_testing",
                "created_at": _TIME,
                "latency_budget_ms": 200.0,
                "least_score": 0.25,
                "frames": 8,
                "frame": 7,
                "answered_at": 1795343957.332,
                "named": ["car-2"],
                "viewers": 1,
            }
        ]
    },
    Receipt: {"frame": 0, "vehicle_id": "car-2", "status": "accepted", "receipt": _RECEIPT},
    FrameAnswer: {
        "frame": 0,
        "boxes": [[12.1, -3.4, 4.5, 1.9, 0.02, 0.97]],
        "source": "consensus",
        "accepted": ["car-3", "rsu"],
        "rejected": [{"vehicle_id": "car-2", "reason": "dissensus"}],
        "hypotheses": [
            {"teammates": ["car-2", "rsu"], "jaccard_index": 0.08, "verdict": "dissensus"},
            {"teammates": ["car-3", "rsu"], "jaccard_index": 0.81, "verdict": "consensus"},
        ],
        "sampling_steps": 2,
        "attacker_ratio": 0.34,
        "deadline_met": True,
        "degraded_by": None,
        "timings_ms": {"receive": 3.1, "prepare": 4.0, "total": 31.5},
        "receipt": _RECEIPT,
    },
}
"""An example of each body and answer, by its type."""
AUDIT_LINE = (
    '{"event":"token_renewed","expires_at":"2026-11-22T09:30:00.000Z","previous":"' + _HASH + '","seq":3,'
    '"session_id":"' + _SESSION + '","time":"' + _TIME + '","vehicle_id":"rsu"}\n'
)

_POSE = {
    "type": "array",
    "items": {"type": "number"},
    "minItems": 16,
    "maxItems": 16,
    "description": "world_from_sensor, 4 x 4, row-major, metres",
}
_TENSORS = {
    "type": "object",
    "description": "By name, as the detector wants them (`GET /v1/detectors`).",
    "additionalProperties": {
        "type": "object",
        "required": ["dtype", "shape", "data"],
        "properties": {
            "dtype": {"type": "string"},
            "shape": {"type": "array", "items": {"type": "integer"}},
            "data": {"type": "string", "format": "binary", "description": "Bytes, little-endian, C order."},
        },
    },
}
_PART = {
    "pose": _POSE,
    "tensors": _TENSORS,
    "signature": {"type": "string", "format": "binary", "description": "Ed25519, of vehicles that sign."},
}
_SENT = {"type": "object", "required": ["pose", "tensors"], "properties": _PART}
_NUMBER = {"type": "integer", "minimum": 0}
_MESSAGE: dict[str, Any] = {
    "type": "object",
    "description": "A vehicle's own message, as msgpack.",
    "required": ["frame", "vehicle_id", "pose", "tensors"],
    "properties": {"frame": _NUMBER, "vehicle_id": {"type": "string"}, **_PART},
}
_FRAME: dict[str, Any] = {
    "type": "object",
    "description": "A whole frame, as msgpack.",
    "required": ["frame", "ego", "teammates"],
    "properties": {
        "frame": _NUMBER,
        "ego": _SENT,
        "teammates": {"type": "object", "description": "By id.", "additionalProperties": _SENT},
    },
}


def body(model: type[BaseModel]) -> dict[str, Any]:
    """A JSON body with its example."""
    told = described(model)
    told["requestBody"]["content"][JSON]["example"] = EXAMPLES[model]
    return told


def _answer(model: type[BaseModel], description: str) -> dict[str, Any]:
    return {"model": model, "description": description, "content": {JSON: {"example": EXAMPLES[model]}}}


def _negotiated(model: type[BaseModel], description: str) -> dict[str, Any]:
    """An answer that is JSON, or msgpack of the same."""
    told = _answer(model, f"{description} JSON or msgpack, by `Accept`.")
    told["content"][MSGPACK] = {"schema": {"$ref": f"#/components/schemas/{model.__name__}"}}
    return told


def _in_msgpack(schema: dict[str, Any]) -> dict[str, Any]:
    return {"content": {MSGPACK: {"schema": schema}}}


def _as_text(media_type: str, example: str, description: str) -> Answers:
    content = {media_type: {"schema": {"type": "string"}, "example": example}}
    return {200: {"description": description, "content": content}}


def status(word: str, description: str) -> Answers:
    """An answer that is one word."""
    return {200: {"description": description, "content": {JSON: {"example": {"status": word}}}}}


MESSAGE_BODY = {"requestBody": {"required": True, **_in_msgpack(_MESSAGE)}}
FRAME_BODY = {"requestBody": {"required": True, **_in_msgpack(_FRAME)}}
_OF_EGO, _OF_JSON = documented(401, 403, 404), documented(400, 408, 413, 415)
_PROVEN = documented(401, 403, 404, 429)
_AUDIT_HEAD = {"Audit-Head": {"description": "SHA-256 of the log's last record.", "schema": {"type": "string"}}}
DETECTORS: Answers = {200: _answer(DetectorList, "All detectors.")}
KEYS: Answers = {200: _answer(GatewayKeyList, "All keys.")}
OPENED: Answers = {**_OF_JSON, **documented(401), 201: _answer(SessionCreated, "The session and its tokens.")}
STATE: Answers = {**_OF_EGO, 200: _answer(SessionState, "The session now.")}
ENDED: Answers = {**_PROVEN, 204: {"description": "It has ended.", "headers": _AUDIT_HEAD}}
RENEWED: Answers = {**documented(401, 404, 429), 201: _answer(RenewedToken, "The fresh token.")}
JOINED: Answers = {**_PROVEN, **_OF_JSON, **documented(409), 201: _answer(ChangedTeam, "The team now.")}
LEFT: Answers = {**_PROVEN, 204: {"description": "It has left."}}
AUDIT: Answers = {**_OF_EGO, **_as_text(JSONL, AUDIT_LINE, "A record a line.")}
DECIDED: Answers = {
    **_OF_EGO,
    **_OF_JSON,
    **documented(409, 507),
    200: _negotiated(FrameAnswer, "The answer to the frame."),
}
TAKEN: Answers = {**DECIDED, 202: _negotiated(Receipt, "A teammate's message is kept for its frame.")}
KEPT: Answers = {**_OF_EGO, 200: {"description": "The messages as a whole frame.", **_in_msgpack(_FRAME)}}
WATCHABLE: Answers = {**documented(401), 200: _answer(WatchableList, "The sessions.")}
WATCHED: Answers = {
    **documented(401, 404, 422, 503),
    **_as_text("text/event-stream", "event: end\ndata: {}\n\n", "Server-sent events, until the gateway stops."),
}
METRICS: Answers = _as_text("text/plain", 'robosac_frames_total{source="consensus"} 4.0\n', "In Prometheus' format.")
