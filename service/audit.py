"""Records of the audit log: what was decided and refused, about whom, and on what evidence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

from robosac.defenses import Reason
from robosac.detectors import DetectorInfo
from robosac.fusion import FusionResult
from service.store import AuditRecord, SessionRecord


def now() -> str:
    """The time as RFC 3339, UTC."""
    return datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def session_opened(record: SessionRecord, info: DetectorInfo) -> AuditRecord:
    """A session begins: with whom, which detector, which settings."""
    return {
        "event": "session_opened",
        "time": record.created_at,
        "session_id": record.session_id,
        "ego_id": record.ego_id,
        "teammates": list(record.teammates),
        "detector": record.detector,
        "weights_digest": info.weights_digest,
        "defense": dict(record.defense),
        "latency_budget_ms": record.latency_budget_ms,
        "gather_ms": record.gather_ms,
    }


def team_changed(before: Sequence[str], after: Sequence[str]) -> AuditRecord:
    """Teammates joined or left."""
    return {
        "event": "team_changed",
        "time": now(),
        "joined": [name for name in after if name not in before],
        "left": [name for name in before if name not in after],
        "teammates": list(after),
    }


def frame_answered(
    answer: Mapping[str, Any], result: FusionResult, seed: int, unlogged: Mapping[str, int]
) -> AuditRecord:
    """A frame is decided: everything of the answer but the boxes themselves, and the seed that replays it.

    The seed is written as a string, since it exceeds what JSON readers hold exactly. ``unlogged`` counts the refused
    messages of each vehicle since the last frame that were too many to be recorded one by one.
    """
    kept = {name: value for name, value in answer.items() if name != "boxes"}
    return {
        "event": "frame_answered",
        "time": now(),
        **kept,
        "boxes": len(result.boxes),
        "seed": str(seed),
        "fault": result.fault,
        "unlogged_refusals": dict(unlogged),
    }


def message_refused(
    vehicle_id: str, reason: Reason, detail: str, *, frame: int | None = None, field: str | None = None
) -> AuditRecord:
    """A message was not accepted; ``vehicle_id`` is whose token sent it, whatever the message claims."""
    return {
        "event": "message_refused",
        "time": now(),
        "vehicle_id": vehicle_id,
        "frame": frame,
        "reason": reason.value,
        "detail": detail,
        "field": field,
    }
