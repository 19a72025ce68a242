"""Where sessions and their audit logs are kept."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

AuditRecord = Mapping[str, Any]


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
    latency_budget_ms, gather_ms : float
    token_digests : mapping of SHA-256 of a token to vehicle id
    created_at : str
        RFC 3339, UTC.
    last_frame : int or None
        The highest frame that was answered.
    frames_answered : int
    state : mapping
        What the defence remembers.
    audit_seq : int
        Number of the latest audit record; the first is 1.
    """

    session_id: str
    ego_id: str
    teammates: tuple[str, ...]
    detector: str
    defense: Mapping[str, Any]
    latency_budget_ms: float
    gather_ms: float
    token_digests: Mapping[str, str]
    created_at: str
    last_frame: int | None = None
    frames_answered: int = 0
    state: Mapping[str, Any] = field(default_factory=dict)
    audit_seq: int = 0


class Store(Protocol):
    """Sessions and audit logs. Every method is atomic."""

    async def create(self, record: SessionRecord, event: AuditRecord) -> None:
        """Keep a new session and the first record of its log."""
        ...

    async def get(self, session_id: str) -> SessionRecord | None:
        """The session, or None."""
        ...

    async def decide(self, session_id: str, frame: int, state: Mapping[str, Any], event: AuditRecord) -> None:
        """Keep a decision: the frame is answered, the defence's state is the new one, and the log says so."""
        ...

    async def change_team(
        self,
        session_id: str,
        teammates: tuple[str, ...],
        token_digests: Mapping[str, str],
        state: Mapping[str, Any],
        event: AuditRecord,
    ) -> None:
        """Keep a new team with its tokens, the defence's state for it, and the log's record of it."""
        ...

    async def log(self, session_id: str, event: AuditRecord) -> None:
        """Append to a session's log."""
        ...

    async def audit(self, session_id: str, after: int) -> list[AuditRecord]:
        """Records with a number above ``after``, in order."""
        ...

    async def delete(self, session_id: str) -> None:
        """Forget a session and its log."""
        ...

    async def count(self) -> int:
        """Sessions kept."""
        ...


class MemoryStore:
    """A store that lives and dies with the process."""

    def __init__(self) -> None:
        self._sessions: dict[str, SessionRecord] = {}
        self._logs: dict[str, list[AuditRecord]] = {}

    async def create(self, record: SessionRecord, event: AuditRecord) -> None:
        """Keep a new session and the first record of its log."""
        self._sessions[record.session_id] = record
        self._logs[record.session_id] = []
        self._append(record.session_id, event)

    async def get(self, session_id: str) -> SessionRecord | None:
        """The session, or None."""
        return self._sessions.get(session_id)

    async def decide(self, session_id: str, frame: int, state: Mapping[str, Any], event: AuditRecord) -> None:
        """Keep a decision; nothing happens if the session was ended meanwhile."""
        record = self._sessions.get(session_id)
        if record is not None:
            self._sessions[session_id] = replace(
                record, last_frame=frame, frames_answered=record.frames_answered + 1, state=state
            )
            self._append(session_id, event)

    async def change_team(
        self,
        session_id: str,
        teammates: tuple[str, ...],
        token_digests: Mapping[str, str],
        state: Mapping[str, Any],
        event: AuditRecord,
    ) -> None:
        """Keep a new team; nothing happens if the session was ended meanwhile."""
        record = self._sessions.get(session_id)
        if record is not None:
            self._sessions[session_id] = replace(record, teammates=teammates, token_digests=token_digests, state=state)
            self._append(session_id, event)

    async def log(self, session_id: str, event: AuditRecord) -> None:
        """Append to a session's log; nothing happens if the session was ended meanwhile."""
        if session_id in self._sessions:
            self._append(session_id, event)

    async def audit(self, session_id: str, after: int) -> list[AuditRecord]:
        """Records with a number above ``after``, in order."""
        return self._logs.get(session_id, [])[max(after, 0) :]

    async def delete(self, session_id: str) -> None:
        """Forget a session and its log."""
        self._sessions.pop(session_id, None)
        self._logs.pop(session_id, None)

    async def count(self) -> int:
        """Sessions kept."""
        return len(self._sessions)

    def _append(self, session_id: str, event: AuditRecord) -> None:
        log = self._logs[session_id]
        log.append({"seq": len(log) + 1, **event})
        self._sessions[session_id] = replace(self._sessions[session_id], audit_seq=len(log))
