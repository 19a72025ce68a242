"""What can be proved wrong about an audit log from the log alone."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from robosac.audit.chain import GENESIS, commitment
from robosac.audit.contradictions import contradictions
from robosac.audit.events import (
    Equivocation,
    FrameAnswered,
    Proof,
    RecordError,
    SessionEnded,
    SessionOpened,
    TeamChanged,
    event_on,
    is_canonical,
    read,
)
from robosac.consensus import DEFAULT_THRESHOLD
from robosac.defenses import trusted_in
from robosac.signatures import is_valid, read_public_key


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


def verify(lines: Iterable[bytes], head: str | None = None) -> list[Finding]:
    """Check an audit log.

    A line is read only once, and no more is kept than what the next has to agree with. Each fault is reported once: a
    record is compared with earlier ones only if an unbroken chain leads back to them.

    Parameters
    ----------
    lines : iterable of bytes
        With or without their line breaks, such as a file opened for binary reading.
    head : str, optional
        What the digest of the last line must be. Without it, nobody can tell whether the end is missing, or whether the
        last record was changed.

    Returns
    -------
    list of Finding
        In the order of the lines; empty if nothing is wrong.
    """
    run = _Verification(head)
    for line in lines:
        run.take(line.removesuffix(b"\n"))
    run.finish()
    return run.findings


@dataclass
class _History:
    """What the next record must agree with; None or absent if it is not known."""

    ego_id: str | None = None
    threshold: float | None = None
    commitment: str | None = None
    frame: int | None = None
    trusted: tuple[str, ...] | None = None
    keys: dict[str, str] = field(default_factory=dict)
    doubtful: set[str] = field(default_factory=set)

    def doubt(self) -> None:
        """Forget all that a missing or changed record may have changed."""
        self.commitment = self.frame = self.trusted = None
        self.doubtful = set(self.keys)


class _Verification:
    def __init__(self, head: str | None) -> None:
        self.findings: list[Finding] = []
        self._head = head
        self._head_seen_at: int | None = None
        self._line = 0
        self._seq: int | None = None
        self._expected_seq = 1
        self._digest: str | None = GENESIS
        self._damaged = False
        self._session: str | None = None
        self._ended = False
        self._history = _History()

    def take(self, line: bytes) -> None:
        self._line += 1
        self._seq = None
        before = None if self._damaged else self._digest
        self._digest = hashlib.sha256(line).hexdigest()
        if self._digest == self._head:
            self._head_seen_at = self._line
        record = self._read(line)
        self._damaged = record is None
        if record is None:
            self._expected_seq += 1
            self._history.doubt()
            return
        if not self._is_linked(record, before):
            if self._line == 2:  # the line that was changed is the opening, on which all else rests
                self._history = _History()
            self._history.doubt()
        try:
            self._check(record, line)
        except RecordError as error:
            self._find(Fault.MALFORMED, str(error))
            self._history.doubt()

    def finish(self) -> None:
        if self._line == 0:
            self._find(Fault.MISPLACED, "the log is empty")
        if self._head is not None and self._digest != self._head:
            seen = self._head_seen_at
            what = (
                "the last line is not the head: it was changed, or lines after it are missing"
                if seen is None
                else f"the head is that of line {seen}; nothing vouches for the lines after it"
            )
            self._find(Fault.WRONG_HEAD, what)

    def _find(self, fault: Fault, detail: str) -> None:
        self.findings.append(Finding(self._line, self._seq, fault, detail))

    def _read(self, line: bytes) -> dict[str, Any] | None:
        try:
            record = read(line)
        except RecordError as error:
            self._find(Fault.NOT_JSON, str(error))
            return None
        self._seq = record["seq"] if type(record.get("seq")) is int else None
        if not is_canonical(line, record):
            self._find(Fault.NOT_CANONICAL, "not the canonical form (RFC 8785) of what it says")
            return None
        return record

    def _is_linked(self, record: Mapping[str, Any], before: str | None) -> bool:
        """Whether a record follows the one before; ``before`` is that one's digest, if it can be relied on."""
        found = len(self.findings)
        if self._seq is None:
            self._find(Fault.WRONG_SEQ, f"no number where {self._expected_seq} should be")
        elif self._seq != self._expected_seq:
            self._find(Fault.WRONG_SEQ, f"{self._seq} where {self._expected_seq} should be")
            before = None if self._line == 1 else before
        self._expected_seq = (self._expected_seq if self._seq is None else self._seq) + 1
        if before is not None and record.get("previous") != before:
            self._find(Fault.BROKEN_LINK, "'previous' is not the digest of the line before: that line was changed, "
                       "or it is another")  # fmt: skip
        session = record.get("session_id")
        if not isinstance(session, str):
            self._find(Fault.WRONG_SESSION, "of no session")
        elif self._session not in (None, session):
            self._find(Fault.WRONG_SESSION, f"of session {session:.64} among those of {self._session:.64}")
        self._session = session if isinstance(session, str) else self._session
        return len(self.findings) == found

    def _check(self, record: Mapping[str, Any], line: bytes) -> None:
        if (record.get("event") == "session_opened") != (self._line == 1):
            self._find(Fault.MISPLACED, "the session is opened again" if self._line > 1 else "no session is opened")
        if self._ended:
            self._find(Fault.MISPLACED, "the session has ended before")
            self._ended = False
        match event_on(line):
            case SessionOpened() as opened:
                self._open(opened)
            case TeamChanged() as change:
                self._enrol(change.public_keys)
                self._history.trusted = trusted_in(change.state)
            case FrameAnswered() as answer:
                self._check_answer(answer)
            case Equivocation() as lie:
                if lie.first.digest == lie.second.digest:
                    self._find(Fault.CONTRADICTION, "an equivocation of one message with itself")
                if lie.first.signature is not None:
                    self._check_signature(lie.vehicle_id, lie.first)
                self._check_signature(lie.vehicle_id, lie.second)
            case SessionEnded():
                self._ended = True

    def _open(self, opened: SessionOpened) -> None:
        threshold = opened.defense.get("consensus_threshold", DEFAULT_THRESHOLD)
        self._history = _History(
            ego_id=opened.ego_id,
            threshold=threshold if isinstance(threshold, int | float) else None,
            commitment=opened.next_seed_commitment,
            trusted=trusted_in(opened.state),
        )
        self._enrol(opened.public_keys)

    def _enrol(self, keys: Mapping[str, str]) -> None:
        self._history.keys, self._history.doubtful = {}, set()
        for name, key in keys.items():
            try:
                read_public_key(key)
            except ValueError as error:
                self._find(Fault.MALFORMED, f"public_keys.{name}: {error}")
            else:
                self._history.keys[name] = key

    def _check_answer(self, answer: FrameAnswered) -> None:
        known = self._history
        if known.commitment is not None and commitment(answer.seed) != known.commitment:
            self._find(Fault.WRONG_SEED, f"frame {answer.frame} was not drawn from the seed committed to before")
        if known.frame is not None and answer.frame <= known.frame:
            self._find(Fault.FRAME_ORDER, f"frame {answer.frame} after frame {known.frame}")
        for detail in contradictions(answer, ego_id=known.ego_id, threshold=known.threshold, trusted=known.trusted):
            self._find(Fault.CONTRADICTION, f"frame {answer.frame}: {detail}")
        for name, proof in answer.messages.items():
            self._check_signature(name, proof)
        known.commitment = answer.next_seed_commitment
        known.frame = answer.frame
        known.trusted = trusted_in(answer.state)

    def _check_signature(self, vehicle: str, proof: Proof) -> None:
        key = self._history.keys.get(vehicle)
        if key is None:
            return
        if proof.signature is None:
            detail = f"the message of {vehicle} is not signed, though it has registered a key"
        elif not is_valid(read_public_key(key), self._session or "", proof.digest, proof.signature):
            detail = f"the signature is not that of {vehicle} over its message"
        else:
            return
        self._find(Fault.BAD_SIGNATURE, detail)
        if vehicle in self._history.doubtful:
            del self._history.keys[vehicle]
