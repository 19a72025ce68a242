"""Records of an audit log in the form that all readers know, whatever format they are written in."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, TypeVar

from robosac.answers import Support
from robosac.audit import packing
from robosac.boxes import FloatArray
from robosac.defenses.sampling import MAX_BUDGET

T = TypeVar("T")

FORMAT = 2
"""Of the records that this version writes; those without a ``format`` are of 1."""
UPRIGHT = [0.0, 0.0, 0.0, 1.0]
"""The last row of a pose, which is not written."""
MILLIONTHS = 1e6
STAGES = ("receive", "gather", "queue", "screening", "prepare", "testimony", "ego_only", "hypotheses", "consensus",
          "total")  # fmt: skip
"""In this order their times stand in a record; one that was not measured is null."""
USUAL: Mapping[str, Any] = {
    "deadline_met": True, "degraded_by": None, "fault": None, "out_of_time": False, "unlogged_refusals": {},
    "suspicion": None, "support": None, "contradicted": None,
}  # fmt: skip
"""What is not written where it is so."""


def expanded(record: Mapping[str, Any], but: Collection[str] = ()) -> dict[str, Any]:
    """A record in the form that format 1 had, of either format.

    A `frame_answered` that is not full has no ``state``, but its ``state_digest`` and ``trusted``.

    Parameters
    ----------
    record : mapping
    but : collection of str
        Fields that stay as they are.

    Raises
    ------
    ValueError
        If a part of it cannot be unpacked, or holds more than a gateway's record can.
    """
    written = record.get("format", 1)
    if type(written) is not int or written not in (1, FORMAT):
        raise ValueError(f"format: {written!r:.64} is none that this version knows")
    if written == 1:
        return dict(record)
    read = dict(record)
    names = sorted(read["messages"]) if isinstance(read.get("messages"), dict) else []
    _blaming("messages", packing.check_count, len(names), packing.MOST_VEHICLES)
    if read.get("event") == "frame_answered":
        _fill_in(read)
    for name, unpack in _READERS.items():
        if name in read and name not in but:
            read[name] = _blaming(name, unpack, read[name], names)
    if read.get("event") == "frame_answered" and "rejected" in read:
        _blaming("rejected", _fill_in_suspicion, read["rejected"], read["suspicion"] or {})
    if "timings_us" in read:
        read["timings_ms"] = read.pop("timings_us")
    if "state" in read and packing.state_digest(read["state"]) != read.get("state_digest"):
        raise ValueError("state: is not the one of state_digest")
    return read


def unpacked(record: Mapping[str, Any]) -> tuple[FloatArray, tuple[Support, ...] | None]:
    """The boxes of a `frame_answered` of this format, and on whose word they stand: as they are, not as JSON values.

    Raises
    ------
    ValueError
        As `expanded`.
    """
    boxes, text = _blaming("boxes", packing.unpack_boxes, record["boxes"]), record.get("support")
    if text is None:
        return boxes, None
    return boxes, tuple(_blaming("support", packing.unpack_supports, text, sorted(record["messages"])))


def _blaming(name: str, unpack: Callable[..., T], *packed: Any) -> T:
    try:
        return unpack(*packed)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error
    except (TypeError, LookupError, AttributeError, OverflowError, RecursionError) as error:
        raise ValueError(f"{name}: is not in the form that records have ({error})") from error


def _fill_in(read: dict[str, Any]) -> None:
    """Put in what is not written where it is usual."""
    for name, value in USUAL.items():
        read.setdefault(name, value)
    if isinstance(read.get("frame"), int):
        read.setdefault("previous_frame", read["frame"] - 1)
    if isinstance(read.get("hypotheses"), list):
        read.setdefault("sampling_steps", len(read["hypotheses"]))
    if "accepted" in read:
        read.setdefault("trusted", read["accepted"])


def _fill_in_suspicion(rejected: Sequence[dict[str, Any]], suspicion: Mapping[str, float]) -> None:
    for entry in rejected:
        if entry.get("suspicion") is True:
            entry["suspicion"] = suspicion.get(entry["vehicle_id"])


def _read_state(text: Any, _: Sequence[str]) -> dict[str, Any]:
    state = json.loads(packing.inflated(text))
    if not isinstance(state, dict):
        raise ValueError("must be a mapping")
    return state


def _read_messages(messages: Any, _: Sequence[str]) -> dict[str, Any]:
    proofs = {}
    for name, said in messages.items():
        digest, *signature = [said] if isinstance(said, str) else said
        proofs[name] = {"digest": packing.long_digest(digest), **({"signature": signature[0]} if signature else {})}
    return proofs


def _read_hypotheses(hypotheses: Any, names: Sequence[str]) -> list[dict[str, Any]]:
    packing.check_count(len(hypotheses), MAX_BUDGET)
    read, named = [], 0
    for packed, index, verdict in hypotheses:
        teammates = packing.unpack_names(packed, names)
        read.append({"teammates": teammates, "jaccard_index": index, "verdict": verdict})
        named += len(teammates)
        packing.check_count(named, packing.MOST_NAMES)
    return read


def _read_supports(supports: Any, names: Sequence[str]) -> Any:
    if not isinstance(supports, str):
        return supports
    return [
        {"status": each.status.value, "witnesses": list(each.witnesses), "deniers": list(each.deniers)}
        for each in packing.unpack_supports(supports, names)
    ]


def _read_contradicted(packed: Any, names: Sequence[str]) -> Any:
    if not packed:
        return packed
    boxes, supports = packing.unpack_boxes(packed["boxes"]), _read_supports(packed["support"], names)
    return [{**support, "box": box} for support, box in zip(supports, boxes.tolist(), strict=True)]


def _read_suspicion(of: Any, names: Sequence[str]) -> dict[str, float] | None:
    if of is None:
        return None
    named = of if isinstance(of, dict) else dict(zip(names, of, strict=True))
    return {name: parts / MILLIONTHS for name, parts in named.items() if parts is not None}


def _read_rejected(entries: Any, names: Sequence[str]) -> list[Any]:
    read: list[Any] = []
    for entry in entries:
        packing.check_count(len(read), packing.MOST_VEHICLES)
        if "vehicles" not in entry:
            read.append(dict(entry))
            continue
        rest = {name: value for name, value in entry.items() if name != "vehicles"}
        read += [{"vehicle_id": vehicle, **rest} for vehicle in packing.unpack_names(entry["vehicles"], names)]
    return read


def _read_timings(spent: Any, _: Sequence[str]) -> dict[str, float]:
    named = spent if isinstance(spent, dict) else dict(zip(STAGES, spent, strict=True))
    return {stage: us / 1e3 for stage, us in named.items() if us is not None}


_READERS: Mapping[str, Callable[[Any, Sequence[str]], Any]] = {
    "state": _read_state,
    "state_digest": lambda text, _: packing.long_digest(text),
    "messages": _read_messages,
    "accepted": packing.unpack_names,
    "trusted": packing.unpack_names,
    "hypotheses": _read_hypotheses,
    "boxes": lambda text, _: packing.unpack_boxes(text).tolist(),
    "support": _read_supports,
    "contradicted": _read_contradicted,
    "timings_us": _read_timings,
    "suspicion": _read_suspicion,
    "rejected": _read_rejected,
    "ego_pose": lambda pose, _: [*pose, *(UPRIGHT if len(pose) == 12 else ())],
}
