"""Where sessions and their audit logs are kept."""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

from robosac.audit import GENESIS, digest, seal

AuditEvent = Mapping[str, Any]


class SessionOver(Exception):
    """The session has ended, or was never there."""


class FrameDecided(Exception):
    """A frame of this number or a higher one is decided already, perhaps by another process."""


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


class Store(Protocol):
    """Sessions and audit logs. Every method is atomic, and what it did is kept once it returns.

    Events are sealed here (`robosac.audit.seal`), where their order is decided. Methods that add to a session raise
    `SessionOver` if it has ended or is not there.
    """

    async def create(self, record: SessionRecord, event: AuditEvent) -> None:
        """Keep a new session and the first record of its log."""
        ...

    async def get(self, session_id: str) -> SessionRecord | None:
        """The session, ended or not, or None."""
        ...

    async def decide(
        self,
        session_id: str,
        frame: int,
        state: Mapping[str, Any],
        next_seed: str,
        event: AuditEvent,
        messages: bytes | None = None,
    ) -> None:
        """Keep a decision: the frame is answered, the defence's state and the seed are the new ones, the log says so.

        Parameters
        ----------
        session_id : str
        frame : int
        state : mapping
        next_seed : str
        event : mapping
        messages : bytes, optional
            The frame's messages (`robosac.wire.pack_frame`), where they are kept.

        Raises
        ------
        FrameDecided
            If a frame of this number or a higher one is decided.
        """
        ...

    async def change_team(
        self,
        session_id: str,
        teammates: tuple[str, ...],
        token_ids: Mapping[str, str],
        public_keys: Mapping[str, str],
        state: Mapping[str, Any],
        event: AuditEvent,
    ) -> None:
        """Keep a new team with its tokens and keys, the defence's state for it, and the log's record of it."""
        ...

    async def renew_token(self, session_id: str, vehicle_id: str, token_id: str, event: AuditEvent) -> None:
        """Let another token of a vehicle count instead of the one before."""
        ...

    async def log(self, session_id: str, event: AuditEvent) -> None:
        """Append to a session's log."""
        ...

    async def audit(self, session_id: str, after: int) -> list[str]:
        """Lines with a number above ``after``, in order."""
        ...

    async def messages(self, session_id: str, frame: int) -> bytes | None:
        """The messages kept of a decided frame."""
        ...

    async def forget_messages(self, session_id: str, before: int) -> None:
        """Forget the messages kept of the frames below ``before``."""
        ...

    async def end(self, session_id: str, ended_at: str, event: AuditEvent) -> None:
        """End a session; its log stays until it is purged."""
        ...

    async def unused_since(self, moment: float) -> list[str]:
        """Open sessions to which nothing was added since then (Unix time)."""
        ...

    async def purge(self, moment: float) -> None:
        """Forget the sessions that ended before then (Unix time), with their logs and messages."""
        ...

    async def count(self) -> int:
        """Open sessions."""
        ...

    async def secret(self, name: str, make: Callable[[], str]) -> str:
        """A secret that outlives the process: what ``make`` gave when it was first asked for."""
        ...

    async def close(self) -> None:
        """Let go of files and connections."""
        ...


class MemoryStore:
    """A store that lives and dies with the process."""

    def __init__(self) -> None:
        self._sessions: dict[str, SessionRecord] = {}
        self._logs: dict[str, list[str]] = {}
        self._messages: dict[tuple[str, int], bytes] = {}
        self._touched: dict[str, float] = {}
        self._secrets: dict[str, str] = {}

    async def create(self, record: SessionRecord, event: AuditEvent) -> None:
        """Keep a new session."""
        self._sessions[record.session_id] = record
        self._logs[record.session_id] = []
        self._append(record.session_id, event)

    async def get(self, session_id: str) -> SessionRecord | None:
        """The session, or None."""
        return self._sessions.get(session_id)

    async def decide(
        self,
        session_id: str,
        frame: int,
        state: Mapping[str, Any],
        next_seed: str,
        event: AuditEvent,
        messages: bytes | None = None,
    ) -> None:
        """Keep a decision."""
        record = self._open(session_id)
        if record.last_frame is not None and frame <= record.last_frame:
            raise FrameDecided(record.last_frame)
        answered = record.frames_answered + 1
        self._append(session_id, event, last_frame=frame, frames_answered=answered, state=state, seed=next_seed)
        if messages is not None:
            self._messages[session_id, frame] = messages

    async def change_team(
        self,
        session_id: str,
        teammates: tuple[str, ...],
        token_ids: Mapping[str, str],
        public_keys: Mapping[str, str],
        state: Mapping[str, Any],
        event: AuditEvent,
    ) -> None:
        """Keep a new team."""
        self._append(session_id, event, teammates=teammates, token_ids=token_ids, public_keys=public_keys, state=state)

    async def renew_token(self, session_id: str, vehicle_id: str, token_id: str, event: AuditEvent) -> None:
        """Let another token count."""
        token_ids = {**self._open(session_id).token_ids, vehicle_id: token_id}
        self._append(session_id, event, token_ids=token_ids)

    async def log(self, session_id: str, event: AuditEvent) -> None:
        """Append to a session's log."""
        self._append(session_id, event)

    async def audit(self, session_id: str, after: int) -> list[str]:
        """Lines with a number above ``after``."""
        return self._logs.get(session_id, [])[max(after, 0) :]

    async def messages(self, session_id: str, frame: int) -> bytes | None:
        """The messages kept of a frame."""
        return self._messages.get((session_id, frame))

    async def forget_messages(self, session_id: str, before: int) -> None:
        """Forget the messages kept of the frames below ``before``."""
        for key in [key for key in self._messages if key[0] == session_id and key[1] < before]:
            del self._messages[key]

    async def end(self, session_id: str, ended_at: str, event: AuditEvent) -> None:
        """End a session."""
        self._append(session_id, event, ended_at=ended_at)

    async def unused_since(self, moment: float) -> list[str]:
        """Open sessions to which nothing was added since then."""
        return [s for s, r in self._sessions.items() if r.ended_at is None and self._touched[s] < moment]

    async def purge(self, moment: float) -> None:
        """Forget the sessions that ended before then."""
        for session_id, record in list(self._sessions.items()):
            if record.ended_at is not None and self._touched[session_id] < moment:
                await self.forget_messages(session_id, 2**63)
                del self._sessions[session_id], self._logs[session_id], self._touched[session_id]

    async def count(self) -> int:
        """Open sessions."""
        return sum(record.ended_at is None for record in self._sessions.values())

    async def secret(self, name: str, make: Callable[[], str]) -> str:
        """A secret."""
        return self._secrets.setdefault(name, make())

    async def close(self) -> None:
        """Nothing is held."""

    def _open(self, session_id: str) -> SessionRecord:
        record = self._sessions.get(session_id)
        if record is None or record.ended_at is not None:
            raise SessionOver(session_id)
        return record

    def _append(self, session_id: str, event: AuditEvent, **changes: Any) -> None:
        record = self._open(session_id)
        line = seal(event, session_id, record.audit_seq + 1, record.audit_head)
        self._logs[session_id].append(line)
        self._sessions[session_id] = replace(record, audit_seq=record.audit_seq + 1, audit_head=digest(line), **changes)
        self._touched[session_id] = time.time()


def new_seed() -> str:
    """A seed that nobody can foresee: 256 bits, hexadecimal."""
    return secrets.token_hex(32)
