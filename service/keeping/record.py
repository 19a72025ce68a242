"""What is kept of a session, next to its audit log."""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from robosac.audit import GENESIS


@dataclass(frozen=True)
class SessionRecord:
    """All of a session that outlives a frame; JSON values throughout.

    Attributes
    ----------
    session_id, ego_id : str
    teammates : tuple of str
    detector : str
    defense : mapping
        Settings as the API gives them.
    latency_budget_ms, gather_ms, frame_period_ms : float
    token_ids : mapping of vehicle id to str
        The id of the one token of each vehicle that counts.
    public_keys : mapping of vehicle id to str
        Of the vehicles that sign, base64 (`robosac.signatures`).
    created_at : str
        RFC 3339, UTC.
    seed : str
        Of the next frame's draws, hexadecimal. A secret until that frame is decided.
    last_frame : int or None
        The highest frame that was answered.
    frames_answered : int
    state : mapping
        What the defence remembers.
    ended_at : str or None
        RFC 3339, UTC; the log of an ended session can still be read.
    audit_seq : int
        Number of the latest audit record; the first is 1.
    audit_head : str
        `robosac.audit.digest` of the latest record.
    revision : int
        Changes to the session so far, other than to its log.
    """

    session_id: str
    ego_id: str
    teammates: tuple[str, ...]
    detector: str
    defense: Mapping[str, Any]
    latency_budget_ms: float
    gather_ms: float
    frame_period_ms: float
    token_ids: Mapping[str, str]
    created_at: str
    seed: str
    public_keys: Mapping[str, str] = field(default_factory=dict)
    last_frame: int | None = None
    frames_answered: int = 0
    state: Mapping[str, Any] = field(default_factory=dict)
    ended_at: str | None = None
    audit_seq: int = 0
    audit_head: str = GENESIS
    revision: int = 0


def new_seed() -> str:
    """A seed that nobody can foresee: 256 bits, hexadecimal."""
    return secrets.token_hex(32)
