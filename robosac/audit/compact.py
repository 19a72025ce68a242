"""Records as they stand on a line since format 2, and as they are read: `robosac.audit.expanding` reads them.

A record repeats nothing that the log has said already. Of what the defence remembers it holds the digest; only every so
often, and wherever the log may have a gap, a record is *full* and holds the state itself. Vehicles are bits of a number
beside the list of those who sent a message; boxes are whole numbers of `robosac.boxes.BOX_UNITS`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from robosac.answers import FrameAnswer, RejectedTeammate, Support
from robosac.audit import packing
from robosac.audit.events import Event, FrameAnswered, Proof, SessionOpened, TeamChanged
from robosac.audit.expanding import FORMAT, MILLIONTHS, STAGES, UPRIGHT, USUAL
from robosac.boxes import from_units, in_units
from robosac.defenses import trusted_in

FULL_EVERY = 200
"""Frames from one record with the whole state to the next."""


@dataclass
class Writer:
    """Makes a session's records, one after another; remembers what the log has said already.

    Parameters
    ----------
    full_every : int
        Frames from one full record to the next; 1 for all.
    """

    full_every: int = FULL_EVERY
    frame: int | None = None
    """The latest that was recorded."""
    since_full: int = 0
    evidence: dict[str, Sequence[Any]] = field(default_factory=dict)

    def record(self, event: FrameAnswered, follows: int | None) -> tuple[dict[str, Any], str, Writer]:
        """The record of a decision; the text of the state after it (`packing.packed_state`), which is long to make; and
        the writer of the next, to be taken once this one is kept.

        Parameters
        ----------
        event : FrameAnswered
        follows : int or None
            The latest frame in the log. If it is not the one that this writer recorded, the record is full.
        """
        full = self.frame is None or self.frame != follows or self.since_full + 1 >= self.full_every
        told = {} if full else self.evidence
        listed = {name: evidence for name, why in event.rejected.items() if (evidence := _listed(why))}
        following = Writer(self.full_every, event.frame, 0 if full else self.since_full + 1, listed)
        packed = _packed(event)
        return _compact_answer(event, packed, full, told), packed[1].decode(), following


def _listed(why: RejectedTeammate) -> Sequence[Any]:
    evidence = (why.model_extra or {}).get("evidence")
    return evidence if isinstance(evidence, list | tuple) else ()


def compact(event: Event, *, full: bool = True, told: Mapping[str, Sequence[Any]] | None = None) -> dict[str, Any]:
    """An event as JSON values for a line.

    Parameters
    ----------
    event : Event
    full : bool
        Whether a frame's record holds the whole state.
    told : mapping of vehicle to sequence, optional
        Evidence that the record before listed.
    """
    if isinstance(event, FrameAnswered):
        return _compact_answer(event, _packed(event), full, told or {})
    if isinstance(event, SessionOpened | TeamChanged):
        digest, text = packing.packed_state(event.state)
        rest = event.model_dump(mode="json", exclude={"state"})
        return {**rest, "format": FORMAT, "state_digest": packing.short_digest(digest), "state": packing.deflated(text)}
    return {**event.as_json(), "format": FORMAT}


def logged(answer: FrameAnswer) -> dict[str, Any]:
    """An answer, JSON values, as the log has it: rounded, and without evidence, of which a record has what is new."""
    fields = answer.as_json()
    fields.pop("receipt", None)
    fields["rejected"].sort(key=lambda why: str(why["vehicle_id"]))
    for numbers in (fields, *fields["rejected"]):
        numbers.pop("evidence", None)
    boxes = [answer.boxes, *(np.array([one.box]) for one in answer.contradicted or ())]
    rounded, *left_out = [from_units(in_units(each)).tolist() for each in boxes]
    fields["boxes"] = rounded
    for one, box in zip(fields["contradicted"] or (), left_out, strict=True):
        one["box"] = box[0]
    for name in ("suspicion", "attacker_ratio"):
        if fields[name] is not None:
            fields[name] = _rounded(fields[name])
    return fields


def _rounded(value: Any) -> Any:
    return {name: round(p, 6) for name, p in value.items()} if isinstance(value, Mapping) else round(value, 6)


def _packed(answer: FrameAnswered) -> tuple[str, bytes]:
    """Digest and text of the state after a decision."""
    if answer.state is None:
        raise ValueError("a decision is put on record with the state after it")
    return packing.packed_state(answer.state)


def _compact_answer(
    answer: FrameAnswered, packed: tuple[str, bytes], full: bool, told: Mapping[str, Sequence[Any]]
) -> dict[str, Any]:
    names = sorted(answer.messages)
    by_hand = {"state", "boxes", "support", "contradicted", "messages", "hypotheses", "timings_ms", "suspicion",
               "ego_pose", "accepted", "rejected", "trusted", "state_digest"}  # fmt: skip
    record = answer.model_dump(mode="json", exclude=by_hand)
    digest, text = packed
    record.update(
        format=FORMAT,
        state_digest=packing.short_digest(digest),
        messages={name: _short_proof(proof) for name, proof in answer.messages.items()},
        accepted=packing.pack_names(answer.accepted, names),
        rejected=_short_rejections(answer, told, names),
        hypotheses=[
            [packing.pack_names(tested.teammates, names), tested.jaccard_index, tested.verdict.value]
            for tested in answer.hypotheses
        ],
        timings_us=_short_timings(answer.timings_ms),
        ego_pose=answer.ego_pose.reshape(-1).tolist()[: 12 if answer.ego_pose[3].tolist() == UPRIGHT else 16],
        boxes=packing.pack_boxes(answer.boxes),
        support=_short_supports(answer.support, names),
        contradicted=_short_contradicted(answer, names),
    )
    if answer.attacker_ratio is not None:
        record["attacker_ratio"] = _rounded(answer.attacker_ratio)
    if answer.suspicion is not None:
        parts = {name: round(p * MILLIONTHS) for name, p in answer.suspicion.items()}
        record["suspicion"] = [parts.get(name) for name in names] if set(parts) <= set(names) else parts
    if set(trusted := trusted_in(answer.state or {})) != set(answer.accepted):
        record["trusted"] = packing.pack_names(sorted(trusted), names)
    if full:
        record["state"] = packing.deflated(text)
    return _without_usual(record)


def _without_usual(record: dict[str, Any]) -> dict[str, Any]:
    kept = {name: value for name, value in record.items() if name not in USUAL or value != USUAL[name]}
    if kept["previous_frame"] == kept["frame"] - 1:
        del kept["previous_frame"]
    if kept["sampling_steps"] == len(kept["hypotheses"]):
        del kept["sampling_steps"]
    return kept


def _short_contradicted(answer: FrameAnswered, names: Sequence[str]) -> Any:
    if not answer.contradicted:
        return None if answer.contradicted is None else []
    boxes = np.array([one.box for one in answer.contradicted])
    return {"boxes": packing.pack_boxes(boxes), "support": _short_supports(answer.contradicted, names)}


def _short_timings(spent: Mapping[str, float]) -> Any:
    whole = {stage: round(ms * 1e3) for stage, ms in spent.items()}
    return [whole.get(stage) for stage in STAGES] if set(whole) <= set(STAGES) else whole


def _short_proof(proof: Proof) -> Any:
    digest = packing.short_digest(proof.digest)
    return digest if proof.signature is None else [digest, proof.as_json()["signature"]]


def _short_rejections(
    answer: FrameAnswered, told: Mapping[str, Sequence[Any]], names: Sequence[str]
) -> list[dict[str, Any]]:
    """One entry for all of whom there is nothing to say but the same reason."""
    alone: list[dict[str, Any]] = []
    alike: dict[tuple[str, bool], list[str]] = {}
    known = _rounded(answer.suspicion or {})
    for name, why in sorted(answer.rejected.items()):
        entry = _short_rejection(why, told.get(name, ()))
        if entry.get("suspicion", name) == known.get(name):
            entry["suspicion"] = True  # as it is said above
        if set(entry) <= {"vehicle_id", "reason", "suspicion"} and entry.get("suspicion", True) is True:
            alike.setdefault((entry["reason"], "suspicion" in entry), []).append(name)
        else:
            alone.append(entry)
    shared = [
        {"reason": reason, **({"suspicion": True} if suspected else {}), "vehicles": packing.pack_names(of, names)}
        for (reason, suspected), of in alike.items()
    ]
    return [*alone, *shared]


def _short_rejection(why: RejectedTeammate, told: Sequence[Any]) -> dict[str, Any]:
    fields = why.as_json()
    if told and _listed(why):
        new = [item for item in fields.pop("evidence") if item not in told]
        fields.update({"evidence": new} if new else {})
    return fields


def _short_supports(supports: Sequence[Support] | None, names: Sequence[str]) -> Any:
    """Packed if only those who sent a message have a say; else at length, so that it can be seen."""
    if supports is None:
        return None
    known = set(names)
    if all(known.issuperset(each.witnesses) and known.issuperset(each.deniers) for each in supports):
        return packing.pack_supports(supports, names)
    return [{"status": e.status.value, "witnesses": list(e.witnesses), "deniers": list(e.deniers)} for e in supports]
