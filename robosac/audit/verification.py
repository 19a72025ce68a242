"""What can be proved wrong about an audit log from the log alone."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from robosac.audit.chain import GENESIS, commitment
from robosac.audit.contradictions import contradictions
from robosac.audit.events import (
    Equivocation,
    FrameAnswered,
    Proof,
    SessionEnded,
    SessionOpened,
    TeamChanged,
    event_of,
)
from robosac.audit.findings import Fault, Finding
from robosac.audit.lines import RecordError, is_canonical, read
from robosac.audit.receipts import Receipts
from robosac.consensus import DEFAULT_THRESHOLD
from robosac.defenses import trusted_in
from robosac.signatures import is_valid, read_public_key


def verify(lines: Iterable[bytes], head: str | None = None, receipts: Receipts | None = None) -> list[Finding]:
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
    receipts : Receipts, optional
        Ends of the log that the gateway signed before; each must still be in it.

    Returns
    -------
    list of Finding
        In the order of the lines; empty if nothing is wrong.

    Raises
    ------
    TypeError
        If a line is text: it would have to be encoded first, and only bytes have a digest.
    """
    run = _Verification(head, receipts)
    for line in lines:
        if not isinstance(line, bytes):
            raise TypeError(f"lines must be an iterable of bytes, one a line; got {type(line).__name__}")
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
    team: tuple[str, ...] | None = None
    keys: dict[str, str] = field(default_factory=dict)
    doubtful: set[str] = field(default_factory=set)
    latest: FrameAnswered | None = None

    @property
    def is_whole(self) -> bool:
        """Whether an unbroken chain leads back to the latest answer, or to the opening where there is none."""
        return self.commitment is not None

    def doubt(self) -> None:
        """Forget all that a missing or changed record may have changed."""
        self.commitment = self.frame = self.trusted = self.team = self.latest = None
        self.doubtful = set(self.keys)


class _Verification:
    def __init__(self, head: str | None, receipts: Receipts | None) -> None:
        self.findings: list[Finding] = []
        self._head = head
        self._receipts = receipts
        self._promised: dict[int, str] | None = None
        self._head_seen_at: int | None = None
        self._line = 0
        self._seq: int | None = None
        self._expected_seq = 1
        self._digest: str | None = GENESIS
        self._damaged = False
        self._session: str | None = None
        self._format: Any = None
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
        self._check_promise(record)
        if record is None:
            self._expected_seq += 1
            self._history.doubt()
            return
        if not self._is_linked(record, before):
            if self._line == 2:  # the line that was changed is the opening, on which all else rests
                self._history = _History()
            self._history.doubt()
        try:
            self._check(record)
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
        if self._receipts is None:
            return
        for detail in self._receipts.contradictions(self._session):
            self._find(Fault.BROKEN_PROMISE, detail)
        if missing := sorted(self._promised or ()):
            more = f", and {len(missing) - 1} more after it" if len(missing) > 1 else ""
            self._find(Fault.BROKEN_PROMISE, f"the gateway signed a record {missing[0]}{more}; it is not in the log")
        if not self._receipts.of(self._session):
            self._find(Fault.BROKEN_PROMISE, "no receipt is of this session")

    def _check_promise(self, record: Mapping[str, Any] | None) -> None:
        """Compare a line with what the gateway signed of it."""
        if self._receipts is None or record is None:
            return
        if self._promised is None:
            session = record.get("session_id")
            self._promised = dict(self._receipts.of(session if isinstance(session, str) else None))
        promised = None if self._seq is None else self._promised.pop(self._seq, None)
        if promised not in (None, self._digest):
            self._find(Fault.BROKEN_PROMISE, f"the gateway signed {promised} as the digest of record {self._seq}")

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
            changed = "it ends with a carriage return, as where a program has changed the ends of lines"
            what = changed if line.endswith(b"\r") else "not the canonical form (RFC 8785) of what it says"
            self._find(Fault.NOT_CANONICAL, what)
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

    def _check(self, record: Mapping[str, Any]) -> None:
        if (record.get("event") == "session_opened") != (self._line == 1):
            self._find(Fault.MISPLACED, "the session is opened again" if self._line > 1 else "no session is opened")
        if self._ended:
            self._find(Fault.MISPLACED, "the session has ended before")
            self._ended = False
        match event_of(record):
            case SessionOpened() as opened:
                self._open(opened)
            case TeamChanged() as change:
                self._change_team(change)
            case FrameAnswered() as answer:
                self._check_answer(answer)
            case Equivocation() as lie:
                self._check_equivocation(lie)
            case SessionEnded() as ended:
                self._check_late(ended)
                self._ended = True
        written = record.get("format", 1)
        if self._format not in (None, written):
            self._find(Fault.MALFORMED, f"of format {written!r:.64} after one of format {self._format!r:.64}")
        self._format = written

    def _open(self, opened: SessionOpened) -> None:
        threshold = opened.defense.get("consensus_threshold", DEFAULT_THRESHOLD)
        if isinstance(threshold, bool) or not isinstance(threshold, int | float):
            self._find(Fault.MALFORMED, "defense.consensus_threshold: must be a number")
            threshold = None
        self._history = _History(
            ego_id=opened.ego_id,
            threshold=threshold,
            commitment=opened.next_seed_commitment,
            trusted=trusted_in(opened.state),
            team=opened.teammates,
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

    def _change_team(self, change: TeamChanged) -> None:
        before, team = self._history.keys, self._history.team
        self._enrol(change.public_keys)
        stayed = [] if team is None else [self._history.ego_id or "", *(set(team) & set(change.teammates))]
        if others := sorted(name for name in stayed if before.get(name) != self._history.keys.get(name)):
            self._find(Fault.CONTRADICTION, f"another key, or none any more, of {', '.join(others)} who stayed")
        self._history.trusted, self._history.team = trusted_in(change.state), change.teammates

    def _check_late(self, event: FrameAnswered | SessionEnded) -> None:
        before = self._history.frame
        for frame in event.late:
            if before is None or frame > before:
                self._find(Fault.CONTRADICTION, f"frame {frame} is said to be late before it was decided")

    def _check_answer(self, answer: FrameAnswered) -> None:
        known = self._history
        if known.commitment is not None and commitment(answer.seed) != known.commitment:
            self._find(Fault.WRONG_SEED, f"frame {answer.frame} was not drawn from the seed committed to before")
        if known.frame is not None and answer.frame <= known.frame:
            self._find(Fault.FRAME_ORDER, f"frame {answer.frame} after frame {known.frame}")
        told = contradictions(
            answer, ego_id=known.ego_id, threshold=known.threshold, trusted=known.trusted, team=known.team
        )
        for detail in told:
            self._find(Fault.CONTRADICTION, f"frame {answer.frame}: {detail}")
        for name, proof in answer.messages.items():
            self._check_signature(name, answer.frame, proof)
        self._check_late(answer)
        known.latest = answer
        known.commitment = answer.next_seed_commitment
        known.frame = answer.frame
        known.trusted = answer.trusts

    def _check_equivocation(self, lie: Equivocation) -> None:
        """Of somebody who signs, both messages must be signed for the frame, here or, the first, in its record."""
        if lie.first.digest == lie.second.digest:
            self._find(Fault.CONTRADICTION, "an equivocation of one message with itself")
        known = self._history
        if lie.vehicle_id not in known.keys:
            return
        first, latest = lie.first, known.latest
        if first.signature is None and latest is not None and latest.frame == lie.frame:
            seen = latest.messages.get(lie.vehicle_id, first)
            first = seen if seen.digest == first.digest else first
        if first.signature is None and known.is_whole:
            self._find(Fault.NO_EVIDENCE, f"the first message of {lie.vehicle_id} is neither signed nor in the log")
        elif first.signature is None or self._check_signature(lie.vehicle_id, lie.frame, first):
            self._check_signature(lie.vehicle_id, lie.frame, lie.second)

    def _check_signature(self, vehicle: str, frame: int, proof: Proof) -> bool:
        """Tell of a message that a vehicle should have signed and did not; whether there is nothing to tell."""
        key = self._history.keys.get(vehicle)
        if key is None:
            return True
        if proof.signature is None:
            detail = f"the message of {vehicle} is not signed, though it has registered a key"
        elif not is_valid(read_public_key(key), self._session or "", vehicle, frame, proof.digest, proof.signature):
            detail = f"the signature is not that of {vehicle} over its message for frame {frame}"
        else:
            return True
        self._find(Fault.BAD_SIGNATURE, detail)
        if vehicle in self._history.doubtful:
            del self._history.keys[vehicle]
        return False
