"""Records of format 2: what is written shortly reads back, and junk in any part is told as such."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robosac.answers import Support
from robosac.audit import FULL_EVERY, Writer, compact, expanded, packing, seal
from robosac.audit.compact import logged
from robosac.audit.events import FrameAnswered, event_on
from robosac.audit.lines import RecordError
from robosac.boxes import from_units, in_units

NAMES = ["car-1", "car-2", "car-3", "rsu"]
JUNK = [None, True, -1, 2.5, "", "?", "AAAA", "eJw=", [], [1], [["a"]], {}, {"rsu": 5}, {"rsu": [1, 2, 3]}, "f" * 99,
        10**400, [10**400] * 10, {"rsu": 10**400}]  # fmt: skip


def an_answer(events, frame=1, **changes) -> FrameAnswered:
    read = event_on(json.dumps(events[1]).encode())
    why = read.rejected["car-2"].model_copy(update=changes.pop("why", {}))
    return read.model_copy(update={"frame": frame, "rejected": {"car-2": why}, **changes})


def on_a_line(record) -> bytes:
    return seal(record, "s", 1, "0" * 64).encode()


def test_an_answer_reads_back_as_it_was_but_for_rounding(events):
    support = tuple(Support(status=s, witnesses=w, deniers=d) for s, w, d in [
        ("confirmed", ("car-1", "rsu"), ()), ("disputed", ("car-3",), ("car-1", "car-2"))])  # fmt: skip
    boxes = np.array([[1.504, -20.006, 4.5, 1.9, -3.1416, 0.91234], [-31.5, 8.25, 4.0, 2.0, 0.25, 0.5]])
    answer = an_answer(events, support=support, boxes=boxes, suspicion={"car-2": 0.25, "rsu": 1 / 3, "car-3": 0.0})
    read = event_on(on_a_line(compact(answer)))
    assert {**logged(read), "state_digest": 0, "trusted": 0} == {**logged(answer), "state_digest": 0, "trusted": 0}
    assert np.abs(read.boxes - boxes).max() <= 0.0051
    assert (read.support, read.state, read.messages) == (answer.support, answer.state, answer.messages)
    assert read.suspicion["rsu"] == 0.333333


def test_only_some_records_hold_the_state_and_all_its_digest(events):
    writer, full, follows = Writer(3), [], None
    for frame in range(7):
        record, _, writer = writer.record(an_answer(events, frame), follows)
        follows = frame
        full.append("state" in record)
        read = event_on(on_a_line(record))
        assert read.state_digest == packing.state_digest(an_answer(events).state)
        assert set(read.trusts) == {"rsu", "car-3"}
    assert full == [True, False, False, True, False, False, True]
    record, *_ = writer.record(an_answer(events, 9), 8)  # another process recorded frame 8
    assert "state" in record
    assert FULL_EVERY > 1


def test_evidence_is_told_once_until_a_full_record_tells_all(events):
    items = [{"frame": n, "test": "pair"} for n in range(3)]
    writer, told = Writer(3), []
    for frame, seen in enumerate([items[:1], items[:2], items[1:], items]):
        answer = an_answer(events, frame, why={"evidence": seen})
        record, _, writer = writer.record(answer, frame - 1 if frame else None)
        told.append(expanded(record)["rejected"][0].get("evidence", []))
    assert told == [items[:1], items[1:2], items[2:], items]


@pytest.mark.parametrize("value", JUNK, ids=lambda value: str(value)[:24])
def test_junk_in_any_part_is_told_as_such(events, value):
    record = json.loads(on_a_line(compact(an_answer(events))))
    changes = [
        {name: value} for name in [*record, "suspicion", "support", "contradicted", "trusted"] if name != "event"
    ]
    changes += [{"rejected": value}, {"rejected": [value]}, {"contradicted": {"boxes": value, "support": value}}]
    changes += [{"rejected": [{"vehicles": value, "reason": "late"}]}, {"rejected": [{"suspicion": True}]}]
    changes += [{"rejected": [{"vehicle_id": value, "reason": "late", "suspicion": True}]}, {"support": ["x", value]}]
    told = 0
    for change in changes:
        try:
            event_on(json.dumps({**record, **change}).encode())
        except RecordError:  # and nothing else
            told += 1
    assert told > len(changes) / 2


@pytest.mark.parametrize(("name", "value"), [("timings_us", ["a"] * 10), ("messages", 5), ("hypotheses", 5)])
def test_junk_is_told_as_no_form_of_a_record(events, name, value):
    record = compact(an_answer(events))
    with pytest.raises(ValueError, match=f"{name}: is not in the form that records have"):
        expanded({**record, name: value})


def test_a_state_that_is_not_of_its_digest_is_told(events):
    record = compact(an_answer(events))
    other = packing.deflated(b'{"trusted":[]}')
    with pytest.raises(RecordError, match="state: is not the one of state_digest"):
        event_on(json.dumps({**record, "state": other}).encode())


def test_what_unpacks_to_too_much_is_refused():
    with pytest.raises(ValueError, match="too long"):
        packing.inflated(packing.deflated(bytes(packing.MOST_BYTES + 1)))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("messages", {f"car-{n}": packing.short_digest("00" * 32) for n in range(1026)}),
        ("hypotheses", [["0", 0.5, "no_evidence"]] * 10_001),
        ("hypotheses", [["1" + "f" * 256, 0.5, "consensus"]] * 1024),
        ("rejected", [{"reason": "late", "vehicles": "f" * 256}] * 3),
        ("boxes", packing.deflated(bytes(24 * 8193))),
        ("support", packing.deflated(bytes(259 * 8193))),
        ("support", packing.deflated(bytes(520) + 2 * (b"\xff" * 128 * 520 + b"\1" * 520))),
        ("contradicted", {"boxes": packing.deflated(bytes(24 * 8193)), "support": None}),
    ],
)
def test_more_than_a_frame_can_have_is_told_before_it_is_unpacked(events, name, value):
    team = {f"car-{n:04}": packing.short_digest("00" * 32) for n in range(1025)}
    record = {**compact(an_answer(events)), "messages": team, name: value}
    with pytest.raises(RecordError, match=rf"^{name}: holds \d+; there are at most \d+$"):
        event_on(json.dumps(record).encode())


def test_the_largest_team_reads_back():
    names = [f"car-{n:04}" for n in range(packing.MOST_VEHICLES)]
    for chosen in (names, names[::3], names[-1:], []):
        assert packing.unpack_names(packing.pack_names(chosen, names), names) == chosen


@given(st.lists(st.lists(st.floats(-1e6, 1e6), min_size=6, max_size=6), max_size=40))
def test_boxes_come_back_in_their_units(rows):
    boxes = np.array(rows, dtype=np.float64).reshape(-1, 6)
    assert (packing.unpack_boxes(packing.pack_boxes(boxes)) == from_units(in_units(boxes))).all()


@given(st.lists(st.sampled_from([*NAMES, "stranger"]), unique=True))
def test_names_come_back(chosen):
    assert packing.unpack_names(packing.pack_names(chosen, NAMES), NAMES) == chosen


@given(st.binary(min_size=32, max_size=32))
def test_digests_come_back(raw):
    assert packing.long_digest(packing.short_digest(raw.hex())) == raw.hex()
