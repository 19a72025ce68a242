"""What is kept of a session, next to its audit log."""

from __future__ import annotations

import re
import secrets
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from robosac.audit import GENESIS


@dataclass(frozen=True)
class SessionRecord:
    """All of a session that outlives a frame; JSON values throughout."""

    session_id: str
    ego_id: str
    teammates: tuple[str, ...]
    detector: str
    defense: Mapping[str, Any]
    """Settings as the API gives them."""
    latency_budget_ms: float
    gather_ms: float
    frame_period_ms: float
    token_ids: Mapping[str, str]
    """The id of the one token of each vehicle that counts."""
    created_at: str
    """RFC 3339, UTC."""
    seed: str
    """Seed of the next frame's draws, hexadecimal; a secret until that frame is decided."""
    public_keys: Mapping[str, str] = field(default_factory=dict)
    """Keys of the vehicles that sign, base64 (`robosac.signatures`)."""
    last_frame: int | None = None
    """The highest frame that was answered."""
    frames_answered: int = 0
    state: Mapping[str, Any] = field(default_factory=dict)
    """What the defence remembers."""
    weights_digest: str | None = None
    calibration_digest: str | None = None
    """Of the detector that it was opened with, or that the operator let it go on with; both None if not known."""
    ended_at: str | None = None
    """RFC 3339, UTC; the log of an ended session can still be read."""
    audit_seq: int = 0
    """Number of the latest audit record; the first is 1."""
    audit_head: str = GENESIS
    """`robosac.audit.digest` of the latest record."""
    key_id: str = ""
    """Which API key opened it (`service.sessions.identity.ApiKeys.check`); empty where none was asked for."""
    holder: str = ""
    """Name of the process that the ego asked last (`service.sessions.moving.Moving`); empty if that is not known."""
    kept_bytes: int = 0
    """Of its log, and once it has ended of its row and of the messages that are kept with it."""
    revision: int = 0
    """Changes to the session so far, other than to its log."""

    @property
    def digests(self) -> tuple[str | None, str | None]:
        """Of the weights and the calibration that it goes on with."""
        return self.weights_digest, self.calibration_digest

    @property
    def purging(self) -> bool:
        """Whether its log is being purged, and is not whole any more."""
        return not self.token_ids


SEED = re.compile("[0-9a-f]{64}")


def new_seed() -> str:
    """A seed that nobody can foresee: 256 bits, hexadecimal."""
    return secrets.token_hex(32)
