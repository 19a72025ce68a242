"""What a check of an audit log may find."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Fault(StrEnum):
    """What is wrong."""

    NOT_JSON = "not-json"
    NOT_CANONICAL = "not-canonical"
    MALFORMED = "malformed"
    """Something that the event has to say is missing, or of the wrong kind."""
    MISPLACED = "misplaced"
    """A session that is opened twice or not at all, or goes on after its end."""
    WRONG_SESSION = "wrong-session"
    WRONG_SEQ = "wrong-seq"
    BROKEN_LINK = "broken-link"
    """``previous`` is not the digest of the line before."""
    WRONG_HEAD = "wrong-head"
    WRONG_SEED = "wrong-seed"
    """A seed that is not the one that was committed to."""
    FRAME_ORDER = "frame-order"
    CONTRADICTION = "contradiction"
    BAD_SIGNATURE = "bad-signature"
    NO_EVIDENCE = "no-evidence"
    """An equivocation of which a message is not signed for this frame, though its vehicle signs."""
    BROKEN_PROMISE = "broken-promise"
    """The log is not the one of which the gateway signed the end."""


@dataclass(frozen=True)
class Finding:
    """Something wrong in a log."""

    line: int
    """From 1 on; 0 for an empty log."""
    seq: int | None
    """As the record gives it, where it does."""
    fault: Fault
    detail: str
    """For a human."""

    def __str__(self) -> str:
        where = f"line {self.line}" if self.seq is None else f"line {self.line} (seq {self.seq})"
        return f"{where}: {self.fault}: {self.detail}"
