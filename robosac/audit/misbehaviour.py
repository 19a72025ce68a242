"""What a log says against one vehicle, in the terms of ETSI TS 103 759 (misbehaviour reporting).

A mapping onto the field names of the report's TemplateAsr, as JSON: not a conforming PDU, since the standard has no
report about shared feature maps. docs/audit.md has the table, and what of it is an assumption.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Any

from robosac.answers import Reason, Verdict
from robosac.audit.chain import GENESIS, digest
from robosac.audit.events import (
    Equivocation,
    FrameAnswered,
    Proof,
    SessionOpened,
    TeamChanged,
    event_of,
)
from robosac.audit.lines import read
from robosac.defenses import Reference

VERSION = 2
"""Of the report's format, in V2.1.1."""
AID_APP_AGNOSTIC = 270549119
"""Application identifier of reports that belong to no application of their own."""
SAME_STATION, OWN_PERCEPTION, OTHER_STATIONS = 2, 4, 5
"""Classes of detectors: against what an observation is a contradiction."""
_EPOCH = datetime(2004, 1, 1, tzinfo=UTC)
_LEAP_SECONDS = 5
"""Since the epoch of Time64; none was added since 2017."""


class NothingToReport(ValueError):
    """A log that says nothing against a vehicle."""


class NeverThere(NothingToReport):
    """A log of a session in which the vehicle never was."""


def report(lines: Iterable[bytes], vehicle: str, now: datetime) -> dict[str, Any]:
    """A misbehaviour report on one vehicle.

    Reported are the frames in which it was rejected for a dissensus, and its equivocations. A dissensus speaks against
    all members of a hypothesis together; the report names them, and every other hypothesis of the frame.

    Parameters
    ----------
    lines : iterable of bytes
        Of a log that `robosac.audit.verify` finds nothing wrong with.
    vehicle : str
    now : datetime
        When the report is made, with a time zone.

    Returns
    -------
    dict
        JSON values.

    Raises
    ------
    NothingToReport
        Or `NeverThere`, which is one.
    RecordError
        If a record is not what its event has to be.
    """
    case = _Case(vehicle)
    for line in lines:
        case.take(line.removesuffix(b"\n"))
    if vehicle not in case.team:
        raise NeverThere(f"{vehicle} was never in the session; these were: {', '.join(case.team)}")
    if not case.observations:
        raise NothingToReport(f"the log holds neither a dissensus nor an equivocation of {vehicle}")
    return {
        "version": VERSION,
        "generationTime": _time64(now),
        "observationLocation": case.location,
        "report": {
            "aid": AID_APP_AGNOSTIC,
            "content": {
                "observations": [
                    {"tgtId": target, "observations": found} for target, found in case.observations.items()
                ],
                "v2xPduEvidence": case.pdus,
                "nonV2xPduEvidence": [
                    *case.decisions,
                    {
                        "id": "auditLog",
                        "evidence": {
                            "sessionId": case.session_id,
                            "egoId": case.session.ego_id if case.session else None,
                            "head": case.head,
                            "lastSeq": case.last_seq,
                            "seq": case.seqs,
                        },
                    },
                ],
            },
        },
    }


@dataclass
class _Case:
    """What was read so far."""

    vehicle: str
    session: SessionOpened | None = None
    session_id: str = ""
    team: dict[str, None] = field(default_factory=dict)
    """All who ever were in the session, the ego first."""
    last_seq: int = 0
    head: str = GENESIS
    key: str | None = None
    location: dict[str, Any] | None = None
    proofs: dict[str, Proof] = field(default_factory=dict)
    observations: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    pdus: list[dict[str, Any]] = field(default_factory=list)
    decisions: list[dict[str, Any]] = field(default_factory=list)
    seqs: list[int] = field(default_factory=list)

    def take(self, line: bytes) -> None:
        record = read(line)
        self.head = digest(line.decode())
        self.last_seq, self.session_id = int(record["seq"]), str(record["session_id"])
        match event_of(record):
            case SessionOpened() as opened:
                self.session = opened
                self.team |= dict.fromkeys([opened.ego_id, *opened.teammates])
                self.key = opened.public_keys.get(self.vehicle)
            case TeamChanged() as change:
                self.team |= dict.fromkeys(change.teammates)
                self.key = change.public_keys.get(self.vehicle)
            case FrameAnswered() as answer:
                self._take_answer(answer)
            case Equivocation() as lie:
                self._take_equivocation(lie)

    def _take_answer(self, answer: FrameAnswered) -> None:
        proof = answer.messages.get(self.vehicle)
        if proof is None:
            return
        self.proofs[proof.digest] = proof
        if self.vehicle not in answer.rejected or answer.rejected[self.vehicle].reason is not Reason.DISSENSUS:
            return
        against = [
            i for i, o in enumerate(answer.hypotheses) if self.vehicle in o.teammates and o.verdict is Verdict.DISSENSUS
        ]
        self._observe(
            "perception",
            "dissensus",
            OTHER_STATIONS if self._followed_previous(answer) else OWN_PERCEPTION,
            {
                "frame": answer.frame,
                "hypotheses": against,
                "lowestJaccardIndex": min((answer.hypotheses[i].jaccard_index for i in against), default=None),
                "consensusThreshold": self.session.defense.get("consensus_threshold") if self.session else None,
            },
            answer.frame,
            [proof],
        )
        self.decisions.append(
            {
                "id": "decision",
                "evidence": {
                    "seq": self.last_seq,
                    "time": answer.time,
                    "frame": answer.frame,
                    "source": answer.source.value,
                    "accepted": list(answer.accepted),
                    "rejected": {name: why.reason.value for name, why in answer.rejected.items()},
                    "hypotheses": [
                        {"teammates": list(o.teammates), "jaccardIndex": o.jaccard_index, "verdict": o.verdict.value}
                        for o in answer.hypotheses
                    ],
                    "messages": {name: _shown(other) for name, other in answer.messages.items()},
                },
            }
        )
        self.location = {"frame": answer.frame, "worldFromSensor": answer.ego_pose.reshape(-1).tolist()}

    def _take_equivocation(self, lie: Equivocation) -> None:
        if self.key is None or lie.vehicle_id != self.vehicle:  # without a key a signature is no proof
            return
        first = lie.first if lie.first.signature else self.proofs.get(lie.first.digest, lie.first)
        if first.signature and lie.second.signature:
            obs = {"frame": lie.frame, "time": lie.time}
            self._observe("message", "equivocation", SAME_STATION, obs, lie.frame, [first, lie.second])

    def _observe(
        self, target: str, kind: str, detector_class: int, obs: dict[str, Any], frame: int, proofs: list[Proof]
    ) -> None:
        """Keep an observation; the n-th is about the n-th stream of messages."""
        seen = {"obsId": kind, "class": detector_class, "v2xPduEvidenceIndex": len(self.pdus), "obs": obs}
        self.observations.setdefault(target, []).append(seen)
        self.pdus.append(
            {
                "type": "robosac-message",
                "v2xPdus": [{"frame": frame, **_shown(proof)} for proof in proofs],
                "certificate": None if self.key is None else {"vehicleId": self.vehicle, "ed25519PublicKey": self.key},
                "subjectPduIndex": len(proofs) - 1,
            }
        )
        self.seqs.append(self.last_seq)

    def _followed_previous(self, answer: FrameAnswered) -> bool:
        """Whether the hypotheses were compared with what stations had said before, not with the ego's perception."""
        reference = self.session.defense.get("reference") if self.session else None
        return reference == Reference.PREVIOUS and answer.previous_frame == answer.frame - 1


def _shown(proof: Proof) -> dict[str, str | None]:
    signature = None if proof.signature is None else base64.b64encode(proof.signature).decode()
    return {"digest": proof.digest, "signature": signature}


def _time64(moment: datetime) -> int:
    """Microseconds since 2004, leap seconds among them (IEEE 1609.2)."""
    return (moment - _EPOCH + timedelta(seconds=_LEAP_SECONDS)) // timedelta(microseconds=1)
