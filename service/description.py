"""What the API's own description (OpenAPI) says beyond types: groups of calls, tensor bodies, and an example of each.

A test holds every example against its type, and walks all routes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import BaseModel

from robosac.answers import FrameAnswer, LogReceipt
from robosac.detectors import DetectorInfo
from service import tensor_bodies
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
_SESSION, _TIME = "2b0ad4d408dfd8e567f71489d518bb9a", "2026-11-21T09:30:00.000Z"
_HASH = "3b0c44298fc1c149afbf4c8996fb9242" * 2
_TOKEN = "eyJhbGciOiJIUzI1NiJ9.eyJzdWIiOiJjYXItMSJ9.c2lnbmF0dXJl"
_KEY, _KEY_ID = "11qYAYKxCrfVS/7TyWQHOg7hcvPapiMlrwIaaPcHURo=", "21fe31dfa154a261"  # of RFC 8032, section 7.1
_DEFENSE = {"kind": "sample_consensus", "attacker_ratio": 0.3, "sampling_budget": 7, "collaborators": 2}
_TIMING = {"latency_budget_ms": 200.0, "gather_ms": 100.0, "frame_period_ms": 200.0}
_SIGNATURE = "YJSMFUWCgrtOsV2lte5DGoM5DKxaXB/xtRa6vfORvegNYZpndkdTfML+jAJU6PPdx2CBOGGyqho+xiX/eh2FDQ=="
_RECEIPT = {"session": _SESSION, "seq": 2, "head": _HASH, "key_id": _KEY_ID, "signature": _SIGNATURE}
_FEATURES = {"features": {"dtype": "float16", "shape": [64, 32, 32]}}
_DETECTOR = {
    "name": "intersection-mean",
    "tensors": {"ego": _FEATURES, "teammate": _FEATURES},
    "narrower": {"features": ["int8"]},
    "area_m": [-32.0, -32.0, 32.0, 32.0],
    "cell_m": 2.0,
    "weights_digest": _HASH,
    "precision": "float32",
    "device": "cpu",
    "consensus_score": 0.3,
    "calibration": {
        "kinds": ["pgd", "erase", "open"],
        "pose_errors_m": [0.0, 0.2],
        "digest": _HASH,
        "objects_judged": True,
    },
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
    GatewayKeyList: {"keys": [{"key_id": _KEY_ID, "public_key": _KEY, "signs": True}]},
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
        "receipt": _RECEIPT,
    },
    RenewedToken: {"token": _TOKEN, "expires_at": _TIME, "receipt": _RECEIPT},
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
        "attacker_ratio": 0.3,
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


_SESSION_HEADER = {
    "name": "X-Session-Id",
    "in": "header",
    "required": False,
    "description": "The session's id again. A cluster finds the session by it, and refuses the call without it (421).",
    "schema": {"type": "string"},
}


def completed(document: dict[str, Any], infos: Sequence[DetectorInfo]) -> dict[str, Any]:
    """An API's description with what FastAPI cannot know: the tensors of these detectors, and nulls in examples.

    Without detectors, bodies of tensors may hold any.
    """
    session, calls = "/v1/sessions/{sid}", document["paths"]
    sent = {"messages": tensor_bodies.message_body(infos), "frames": tensor_bodies.frame_body(infos)}
    for name, told in sent.items():
        calls[f"{session}/{name}"]["post"]["requestBody"]["content"][MSGPACK] = told
    for path in (path for path in calls if "{sid}" in path):
        for call in calls[path].values():
            call["parameters"] = [*call["parameters"], _SESSION_HEADER]
    kept = calls[f"{session}/frames/{{frame}}/messages"]["get"]["responses"]["200"]
    kept["content"][MSGPACK] = tensor_bodies.kept_frame(infos)
    examples = {f"#/components/schemas/{model.__name__}": example for model, example in EXAMPLES.items()}
    answers = [answer for path in calls.values() for call in path.values() for answer in call["responses"].values()]
    for content in (content for answer in answers for content in answer.get("content", {}).values()):
        of_model = examples.get(content["schema"].get("$ref", ""))
        if of_model is not None:
            content["example"] = of_model
    return document


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
    schema = {"$ref": f"#/components/schemas/{model.__name__}"}
    told["content"][MSGPACK] = {"schema": schema, "example": EXAMPLES[model]}
    return told


def _as_text(media_type: str, example: str, description: str) -> Answers:
    content = {media_type: {"schema": {"type": "string"}, "example": example}}
    return {200: {"description": description, "content": content}}


def status(word: str, description: str) -> Answers:
    """An answer that is one word."""
    return {200: {"description": description, "content": {JSON: {"example": {"status": word}}}}}


OF_TENSORS: dict[str, Any] = {"requestBody": {"required": True, "content": {}}}
"""`completed` says more."""
AT_THE_DOORS = documented(403, 414, 421, 431)
"""Whatever is asked: by whom, by which name of the gateway, and in a head of which size."""
_OF_EGO, _OF_JSON = documented(401, 403, 404), documented(400, 408, 413, 415)
_PROVEN = documented(401, 403, 404, 429)
_ON_RECORD = documented(507)
_PROMISED = {
    "Audit-Receipt": {
        "description": "The log's end at this moment, signed by the gateway: JSON.",
        "content": {JSON: {"schema": {"$ref": f"#/components/schemas/{LogReceipt.__name__}"}, "example": _RECEIPT}},
    }
}
_AUDIT_HEAD = {"Audit-Head": {"description": "SHA-256 of the log's last record.", "schema": {"type": "string"}}}
DETECTORS: Answers = {200: _answer(DetectorList, "All detectors.")}
KEYS: Answers = {200: _answer(GatewayKeyList, "All keys.")}
OPENED: Answers = {
    **_OF_JSON,
    **_ON_RECORD,
    **documented(401),
    201: _answer(SessionCreated, "The session and its tokens."),
}
STATE: Answers = {**_OF_EGO, 200: _answer(SessionState, "The session now.")}
ENDED: Answers = {**_PROVEN, 204: {"description": "It has ended.", "headers": _AUDIT_HEAD | _PROMISED}}
RENEWED: Answers = {**documented(401, 404, 429), **_ON_RECORD, 201: _answer(RenewedToken, "The fresh token.")}
JOINED: Answers = {**_PROVEN, **_OF_JSON, **_ON_RECORD, **documented(409), 201: _answer(ChangedTeam, "The team now.")}
LEFT: Answers = {**_PROVEN, **_ON_RECORD, **documented(409), 204: {"description": "It has left.", "headers": _PROMISED}}
AUDIT: Answers = {**_OF_EGO, **_as_text(JSONL, AUDIT_LINE, "A record a line.")}
DECIDED: Answers = {
    **_OF_EGO,
    **_OF_JSON,
    **_ON_RECORD,
    **documented(409),
    200: _negotiated(FrameAnswer, "The answer to the frame."),
}
TAKEN: Answers = {**DECIDED, 202: _negotiated(Receipt, "A teammate's message is kept for its frame.")}
_STANDING = '{"gateway": "unit-7-0f3a9c21", "answered": 41, "waiting": [42]}'
STANDING_BY: Answers = {
    **documented(401, 404),
    **_as_text("text/event-stream", f"event: standing\ndata: {_STANDING}\n\n", "Events until it is to ask again."),
}
KEPT: Answers = {**_OF_EGO, 200: {"description": "The messages as a whole frame.", "content": {MSGPACK: {}}}}
WATCHABLE: Answers = {**documented(401), 200: _answer(WatchableList, "The sessions.")}
WATCHED: Answers = {
    **documented(401, 404, 422, 503),
    **_as_text("text/event-stream", "event: end\ndata: {}\n\n", "Server-sent events, until the gateway stops."),
}
METRICS: Answers = _as_text("text/plain", 'robosac_frames_total{source="consensus"} 4.0\n', "In Prometheus' format.")
