"""What a log says against one vehicle, in the terms of ETSI TS 103 759 (misbehaviour reporting).

A mapping onto the field names of the report's TemplateAsr, as JSON: not a conforming PDU, since the standard has no
report about shared feature maps. docs/audit.md has the table, and what of it is an assumption.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Any

from pydantic import alias_generators

from robosac.answers import Distrust, Reason, RejectedTeammate, Verdict
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
SINGLE_MESSAGE, SAME_STATION, OWN_PERCEPTION, OTHER_STATIONS = 1, 2, 4, 5
"""Classes of detectors: against what an observation is a contradiction."""
_REFUSALS = {
    Reason.IMPLAUSIBLE: (SINGLE_MESSAGE, ("tensor", "largest", "rms", "most_largest", "most_rms")),
    Reason.REPEATED: (SAME_STATION, ("of_frame", "moved_m", "correlation")),
    Reason.COPIED: (OTHER_STATIONS, ("of", "of_frame")),
}
"""What the tests before any pass refuse a message for: the class, and the evidence that is reported. None of the others
accuses: honest software sends a message twice, too late, or in another layout.
"""
_NAMED = "suspicion", "evidence"
"""The evidence that is reported of who is named."""
_EPOCH = datetime(2004, 1, 1, tzinfo=UTC)
_LEAP_SECONDS = 5
"""Since the epoch of Time64; none was added since 2017."""


class NothingToReport(ValueError):
    """A log that says nothing against a vehicle."""


class NeverThere(NothingToReport):
    """A log of a session in which the vehicle never was."""


def report(lines: Iterable[bytes], vehicle: str, now: datetime) -> dict[str, Any]:
    """A misbehaviour report on one vehicle.

    Reported are the frames in which it was rejected for a dissensus, in which it was named as an attacker, or in which
    the tests before any pass refused its message; and its equivocations. A dissensus speaks against all members of a
    hypothesis together; the report names them, and every other hypothesis of the frame.

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
        raise NothingToReport(
            f"the log holds nothing to report of {vehicle}: no dissensus, no naming as an attacker, no message "
            "refused before any pass, no proven equivocation"
        )
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
    proofs: dict[int, Proof] = field(default_factory=dict)
    """What the vehicle sent, by frame."""
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
        self.proofs[answer.frame] = proof
        before, entry = len(self.pdus), answer.rejected.get(self.vehicle)
        if entry is not None:
            self._take_rejection(answer, entry, (answer.frame, proof))
        if len(self.pdus) > before:
            self.decisions.append({"id": "decision", "evidence": _decision(answer, self.last_seq)})
            self.location = {"frame": answer.frame, "worldFromSensor": answer.ego_pose.reshape(-1).tolist()}

    def _take_rejection(self, answer: FrameAnswered, entry: RejectedTeammate, sent: tuple[int, Proof]) -> None:
        evidence = entry.model_extra or {}
        if entry.reason is Reason.DISSENSUS:
            detector_class = OTHER_STATIONS if self._followed_previous(answer) else OWN_PERCEPTION
            self._observe("perception", "dissensus", detector_class, self._dissensus(answer), [sent])
        if entry.reason in _REFUSALS:
            detector_class, fields = _REFUSALS[entry.reason]
            obs = {"frame": answer.frame, **_told(evidence, fields)}
            earlier = self._repeated(evidence) if entry.reason is Reason.REPEATED else []
            self._observe("message", entry.reason.value, detector_class, obs, [*earlier, sent])
        if entry.distrust is Distrust.NAMED:
            obs = {"frame": answer.frame, **_told(evidence, _NAMED)}
            self._observe("perception", "named", OTHER_STATIONS, obs, [sent])

    def _dissensus(self, answer: FrameAnswered) -> dict[str, Any]:
        against = [
            i for i, o in enumerate(answer.hypotheses) if self.vehicle in o.teammates and o.verdict is Verdict.DISSENSUS
        ]
        return {
            "frame": answer.frame,
            "hypotheses": against,
            "lowestJaccardIndex": min((answer.hypotheses[i].jaccard_index for i in against), default=None),
            "consensusThreshold": self.session.defense.get("consensus_threshold") if self.session else None,
        }

    def _repeated(self, evidence: Mapping[str, Any]) -> list[tuple[int, Proof]]:
        """The message that a later one repeats, if the log has it."""
        frame = evidence.get("of_frame")
        return [(frame, self.proofs[frame])] if isinstance(frame, int) and frame in self.proofs else []

    def _take_equivocation(self, lie: Equivocation) -> None:
        if self.key is None or lie.vehicle_id != self.vehicle:  # without a key a signature is no proof
            return
        first = lie.first
        if not first.signature:
            first = next((each for each in self.proofs.values() if each.digest == first.digest), first)
        if first.signature and lie.second.signature:
            obs = {"frame": lie.frame, "time": lie.time}
            sent = [(lie.frame, each) for each in (first, lie.second)]
            self._observe("message", "equivocation", SAME_STATION, obs, sent)

    def _observe(
        self, target: str, kind: str, detector_class: int, obs: dict[str, Any], sent: list[tuple[int, Proof]]
    ) -> None:
        """Keep an observation on the last of some messages, each with its frame; the n-th is about the n-th stream."""
        seen = {"obsId": kind, "class": detector_class, "v2xPduEvidenceIndex": len(self.pdus), "obs": obs}
        self.observations.setdefault(target, []).append(seen)
        self.pdus.append(
            {
                "type": "robosac-message",
                "v2xPdus": [{"frame": frame, **_shown(proof)} for frame, proof in sent],
                "certificate": None if self.key is None else {"vehicleId": self.vehicle, "ed25519PublicKey": self.key},
                "subjectPduIndex": len(sent) - 1,
            }
        )
        self.seqs.append(self.last_seq)

    def _followed_previous(self, answer: FrameAnswered) -> bool:
        """Whether the hypotheses were compared with what stations had said before, not with the ego's perception."""
        reference = self.session.defense.get("reference") if self.session else None
        return reference == Reference.PREVIOUS and answer.previous_frame == answer.frame - 1


def _decision(answer: FrameAnswered, seq: int) -> dict[str, Any]:
    return {
        "seq": seq,
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
    }


def _told(evidence: Mapping[str, Any], fields: Sequence[str]) -> dict[str, Any]:
    """Fields of a record's evidence, named as the report's others are."""
    return {alias_generators.to_camel(name): evidence[name] for name in fields if name in evidence}


def _shown(proof: Proof) -> dict[str, str | None]:
    signature = None if proof.signature is None else base64.b64encode(proof.signature).decode()
    return {"digest": proof.digest, "signature": signature}


def _time64(moment: datetime) -> int:
    """Microseconds since 2004, leap seconds among them (IEEE 1609.2)."""
    return (moment - _EPOCH + timedelta(seconds=_LEAP_SECONDS)) // timedelta(microseconds=1)
