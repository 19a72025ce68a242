"""Where sessions and their audit logs are kept."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

from robosac.audit import GENESIS

AuditEvent = Mapping[str, Any]


class SessionOver(Exception):
    """The session has ended, or was never there."""


class FrameDecided(Exception):
    """A frame of this number or a higher one is decided already, perhaps by another process."""


class SessionChanged(Exception):
    """The session is not as it was when the change to it was worked out; perhaps another process changed it."""


class StoreUnavailable(Exception):
    """The database failed; of a change it is unknown whether it is kept."""


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


class Store(Protocol):
    """Sessions and audit logs. Every method is atomic, and what it did is kept once it returns.

    Events are sealed here (`robosac.audit.seal`), where their order is decided. Methods that add to a session raise
    `SessionOver` if it has ended or is not there; any method may raise `StoreUnavailable`.
    """

    async def create(self, record: SessionRecord, event: AuditEvent) -> None:
        """Keep a new session and the first record of its log."""
        ...

    async def get(self, session_id: str) -> SessionRecord | None:
        """The session, ended or not, or None."""
        ...

    def seen(self, session_id: str) -> SessionRecord | None:
        """The session as this store saw it last, at no cost; another process may have changed it since.

        None if the store does not remember it.
        """
        ...

    async def decide(
        self,
        session_id: str,
        revision: int,
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
        revision : int
            Of the session that the decision was worked out from.
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
        SessionChanged
            If the session is of another revision.
        """
        ...

    async def change_team(
        self,
        session_id: str,
        revision: int,
        teammates: tuple[str, ...],
        token_ids: Mapping[str, str],
        public_keys: Mapping[str, str],
        state: Mapping[str, Any],
        event: AuditEvent,
    ) -> None:
        """Keep a new team with its tokens and keys, the defence's state for it, and the log's record of it.

        Raises
        ------
        SessionChanged
            If the session is of another revision.
        """
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
        """Forget the sessions that ended before then (Unix time), with their logs and messages; atomic for each."""
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


def new_seed() -> str:
    """A seed that nobody can foresee: 256 bits, hexadecimal."""
    return secrets.token_hex(32)
