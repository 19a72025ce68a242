"""Records of the audit log: what was decided and refused, about whom, and on what evidence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from typing import Any

from robosac.audit import commitment
from robosac.boxes import FloatArray
from robosac.calibration import calibration_digest
from robosac.defenses import Reason, State
from robosac.detectors import DetectorInfo
from robosac.fusion import FusionResult
from service.store import AuditEvent, SessionRecord


def now() -> str:
    """The time as RFC 3339, UTC."""
    return datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def session_opened(record: SessionRecord, info: DetectorInfo) -> AuditEvent:
    """A session begins: with whom, which detector, which settings."""
    return {
        "event": "session_opened",
        "time": record.created_at,
        "version": version("robosac"),
        "ego_id": record.ego_id,
        "teammates": list(record.teammates),
        "detector": record.detector,
        "weights_digest": info.weights_digest,
        "calibration_digest": calibration_digest(info),
        "defense": dict(record.defense),
        "latency_budget_ms": record.latency_budget_ms,
        "gather_ms": record.gather_ms,
        "frame_period_ms": record.frame_period_ms,
        "public_keys": dict(record.public_keys),
        "state": dict(record.state),
        "next_seed_commitment": commitment(record.seed),
    }


def session_ended(why: str) -> AuditEvent:
    """A session was closed, or expired."""
    return {"event": "session_ended", "time": now(), "why": why}


def team_changed(before: Sequence[str], after: Sequence[str], keys: Mapping[str, str], state: State) -> AuditEvent:
    """Teammates joined or left."""
    return {
        "event": "team_changed",
        "time": now(),
        "joined": [name for name in after if name not in before],
        "left": [name for name in before if name not in after],
        "teammates": list(after),
        "public_keys": dict(keys),
        "state": dict(state),
    }


def frame_answered(
    answer: Mapping[str, Any],
    result: FusionResult,
    *,
    seed: str,
    ego_pose: FloatArray,
    messages: Mapping[str, Mapping[str, str]],
    previous_frame: int | None,
    unlogged: Mapping[str, int],
) -> AuditEvent:
    """A frame is decided: the answer, and all that it takes to recompute it.

    Parameters
    ----------
    answer : mapping
        The frame result.
    result : FusionResult
    seed : str
        Of the frame's draws, hexadecimal, committed to in an earlier record.
    ego_pose : (4, 4) ndarray
    messages : mapping of vehicle id to mapping
        ``digest`` of each message in the frame (`robosac.wire.content_digest`), and its ``signature`` where it has one.
    previous_frame : int or None
        Frame of the previous answer that the fusion was given.
    unlogged : mapping of vehicle id to int
        Refusals since the last frame that were too many to be recorded one by one; under ``?`` those of callers
        without a token that counts.
    """
    return {
        "event": "frame_answered",
        "time": now(),
        **answer,
        "seed": seed,
        "ego_pose": [float(value) for value in ego_pose.reshape(-1)],
        "messages": {name: dict(proof) for name, proof in messages.items()},
        "previous_frame": previous_frame,
        "out_of_time": result.out_of_time,
        "fault": result.fault,
        "state": dict(result.state),
        "unlogged_refusals": dict(unlogged),
    }


def equivocation(vehicle_id: str, frame: int, first: Mapping[str, str], second: Mapping[str, str]) -> AuditEvent:
    """A vehicle said two different things about one frame: digest and, where there is one, signature of each.

    What the ego said first is signed in its frame's record.
    """
    return {
        "event": "equivocation",
        "time": now(),
        "vehicle_id": vehicle_id,
        "frame": frame,
        "first": dict(first),
        "second": dict(second),
    }


def token_renewed(vehicle_id: str, expires_at: str) -> AuditEvent:
    """A vehicle took a fresh token; the one before is worth nothing any more."""
    return {"event": "token_renewed", "time": now(), "vehicle_id": vehicle_id, "expires_at": expires_at}


def access_refused(vehicle_id: str | None, detail: str) -> AuditEvent:
    """Somebody came without a token that counts; ``vehicle_id`` is whose token it was, None if it is none of ours."""
    return {
        "event": "access_refused",
        "time": now(),
        "vehicle_id": vehicle_id,
        "reason": Reason.UNAUTHENTICATED.value,
        "detail": detail,
    }


def message_refused(
    vehicle_id: str, reason: Reason, detail: str, *, frame: int | None = None, field: str | None = None
) -> AuditEvent:
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
