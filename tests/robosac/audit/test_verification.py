import json

import pytest
from typer.testing import CliRunner

from robosac.audit import Fault, digest, seal, verify
from robosac.cli import app
from tests.robosac.audit.conftest import head, proof, seal_all


def faults(lines, head=None):
    return [(finding.line, finding.fault) for finding in verify(lines, head)]


def test_a_sound_log_has_no_findings(lines):
    assert verify(lines, head(lines)) == []
    assert verify(line.removesuffix(b"\n") for line in lines) == []


@pytest.mark.parametrize("flip", [0x01, 0x20, 0x80])
def test_a_flipped_bit_is_found_wherever_it_is(lines, flip):
    last = head(lines)
    whole = b"".join(lines)
    for position in range(0, len(whole) - 1, 7):
        changed = bytearray(whole)
        changed[position] ^= flip
        findings = verify(bytes(changed).splitlines(keepends=True), last)
        assert findings, position
        assert len(findings) <= 5, findings
        line = whole[:position].count(b"\n") + 1
        assert line <= findings[0].line <= line + 1
    for position in range(len(whole) - len(lines[-1])):
        if whole[position : position + 1] == b"\n":
            assert faults([whole[:position] + b" " + whole[position + 1 :]])


def test_only_the_head_tells_of_a_change_in_the_last_record(lines):
    changed = [*lines[:-1], lines[-1].replace(b'"closed"', b'"cloSed"')]
    assert verify(changed) == []
    assert faults(changed, head(lines)) == [(8, Fault.WRONG_HEAD)]


@pytest.mark.parametrize("gone", range(1, 7))
def test_a_removed_line_is_found_once(lines, gone):
    left = [line for i, line in enumerate(lines) if i != gone]
    assert faults(left, head(lines)) == [(gone + 1, Fault.WRONG_SEQ), (gone + 1, Fault.BROKEN_LINK)]


def test_a_log_without_its_beginning_is_told(lines):
    assert faults(lines[2:]) == [(1, Fault.WRONG_SEQ), (1, Fault.MISPLACED)]


@pytest.mark.parametrize("first", range(7))
def test_swapped_lines_are_found_without_a_flood(lines, first):
    swapped = list(lines)
    swapped[first : first + 2] = swapped[first + 1], swapped[first]
    found = faults(swapped)
    assert found[0][0] == first + 1
    assert {line for line, _ in found} <= {first + 1, first + 2, first + 3}
    assert {fault for _, fault in found} <= {Fault.WRONG_SEQ, Fault.BROKEN_LINK, Fault.MISPLACED}


@pytest.mark.parametrize("left", range(1, 8))
def test_a_truncated_tail_is_found_by_the_head(lines, left):
    assert faults(lines[:left]) == []
    assert faults(lines[:left], head(lines)) == [(left, Fault.WRONG_HEAD)]


def test_an_inserted_line_is_found(events, lines):
    forged = seal(events[3], "5e5510", 5, digest(lines[3].decode().strip())).encode() + b"\n"
    assert faults([*lines[:4], forged, *lines[4:]]) == [(6, Fault.WRONG_SEQ), (6, Fault.BROKEN_LINK)]
    assert faults([*lines[:4], b"\n", *lines[4:]]) == [(5, Fault.NOT_JSON), (6, Fault.WRONG_SEQ)]
    assert faults([*lines[:4], lines[3], *lines[4:]]) == [(5, Fault.WRONG_SEQ), (5, Fault.BROKEN_LINK)]


def test_lines_after_the_head_are_not_vouched_for(events, lines):
    old = head(lines[:3])
    (finding,) = verify(lines, old)
    assert finding.fault is Fault.WRONG_HEAD
    assert "line 3" in finding.detail


@pytest.mark.parametrize(
    ("line", "fault"),
    [
        (b"{", Fault.NOT_JSON),
        (b"\xff", Fault.NOT_JSON),
        (b"[]", Fault.NOT_JSON),
        (b"[" * 100_000, Fault.NOT_JSON),
        (b'{"a":NaN}', Fault.NOT_JSON),
        (b'{"a":1e999}', Fault.NOT_CANONICAL),
        (b'{"a":9007199254740993}', Fault.NOT_CANONICAL),
        (b'{"a":"\\ud800"}', Fault.NOT_CANONICAL),
        (b'{"b":1,"a":1}', Fault.NOT_CANONICAL),
        (b'{"a":1,"a":1}', Fault.NOT_CANONICAL),
        (b'{"a":1.0}', Fault.NOT_CANONICAL),
    ],
)
def test_a_line_that_is_no_canonical_json_is_told(lines, line, fault):
    assert faults([*lines[:3], line + b"\n", *lines[4:]]) == [(4, fault)]


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (b"", "the line is empty"),
        (b'\xef\xbb\xbf{"a":1}', "it begins with a byte order mark"),
        (b"\x1f\x8b\x08\x00", "it begins with the mark of gzip"),
        (b'{"a":"b', "Unterminated string starting at: character 6"),
        (b'{"a":1}\r', "it ends with a carriage return"),
    ],
)
def test_what_other_programs_made_of_a_line_is_told(line, words):
    (finding, *_) = verify([line + b"\n"])
    assert words in finding.detail


def test_an_empty_log_is_told():
    assert faults([]) == [(0, Fault.MISPLACED)]


def test_records_of_another_session_are_told(events, lines):
    other = seal_all(events, "other")
    assert (4, Fault.WRONG_SESSION) in faults([*lines[:3], *other[3:]])
    assert len(faults([*lines[:3], *other[3:]])) == 2 + len([1 for line in other[3:] if b"signature" in line])


def change(events, index, **fields):
    changed = list(events)
    changed[index] = {**events[index], **fields}
    return seal_all(changed)


def test_a_seed_that_was_not_committed_to_is_told(events):
    assert faults(change(events, 2, seed="ab" * 32)) == [(3, Fault.WRONG_SEED)]
    assert faults(change(events, 0, next_seed_commitment="0" * 64)) == [(2, Fault.WRONG_SEED)]
    assert faults(change(events, 2, next_seed_commitment="0" * 64)) == [(7, Fault.WRONG_SEED)]


def test_a_seed_of_which_nobody_could_draw_in_time_is_no_seed(events):
    assert (3, Fault.MALFORMED) in faults(change(events, 2, seed="ab" * 1000))


def test_frames_must_increase(events):
    unseen = (5, Fault.NO_EVIDENCE)  # the first message of the equivocation in frame 1
    assert faults(change(events, 2, frame=0)) == [(3, Fault.FRAME_ORDER), (3, Fault.BAD_SIGNATURE), unseen]
    assert faults(change(events, 6, frame=1)) == [(7, Fault.FRAME_ORDER), (7, Fault.BAD_SIGNATURE)]


HYPOTHESIS = {"teammates": ["rsu", "car-3"], "jaccard_index": 0.75, "verdict": "consensus"}


@pytest.mark.parametrize(
    ("index", "fields", "complaint"),
    [
        (1, {"hypotheses": [{**HYPOTHESIS, "teammates": ["rsu"]}] * 2}, "no hypothesis of car-3, rsu is in consensus"),
        (1, {"accepted": ["rsu"]}, "no hypothesis of rsu is in consensus"),
        (1, {"accepted": []}, "accepts nobody"),
        (
            1,
            {"hypotheses": [HYPOTHESIS, {**HYPOTHESIS, "jaccard_index": 0.29}]},
            "hypothesis 1 is in consensus at 0.29",
        ),
        (1, {"hypotheses": [HYPOTHESIS, {**HYPOTHESIS, "verdict": "dissensus"}]}, "hypothesis 1 is in dissensus"),
        (1, {"sampling_steps": 3}, "3 sampling steps, but 2 hypotheses"),
        (1, {"state": {"trusted": ["rsu", "car-2", "car-3"]}}, "car-2 on the trust list without a consensus"),
        (2, {"accepted": ["rsu", "car-2"]}, "car-2 accepted as trusted, but not on the trust list before"),
        (2, {"source": "ego_only"}, "an ego-only answer with car-3, rsu"),
        (6, {"rejected": [{"vehicle_id": "rsu", "reason": "late"}]}, "rsu both accepted and rejected"),
        (
            2,
            {"rejected": [{"vehicle_id": "car-2", "reason": "dissensus"}]},
            "car-2 rejected for a dissensus, but in no",
        ),
        (
            2,
            {"rejected": [{"vehicle_id": "car-2", "reason": "dissensus", "p_value": 0.001}]},
            "car-2 rejected for a dissensus, but in no",
        ),
        (5, {"public_keys": {}}, "another key, or none any more, of rsu who stayed"),
        (6, {"rejected": []}, "car-2 neither accepted nor rejected"),
        (1, {"late": [0]}, "frame 0 is said to be late before it was decided"),
        (6, {"late": [0, 7]}, "frame 7 is said to be late before it was decided"),
        (7, {"late": [9]}, "frame 9 is said to be late before it was decided"),
        (6, {"rejected": []}, "car-4 enrolled, but neither accepted nor rejected"),
    ],
)
def test_decisions_that_contradict_themselves_are_told(events, index, fields, complaint):
    findings = verify(change(events, index, **fields))
    assert {(f.line, f.fault) for f in findings if complaint in f.detail} == {(index + 1, Fault.CONTRADICTION)}
    assert {finding.fault for finding in findings} == {Fault.CONTRADICTION}


def test_fusing_without_a_message_is_told(events):
    messages = {name: p for name, p in events[1]["messages"].items() if name not in ("car-3", "car-1")}
    details = " ".join(finding.detail for finding in verify(change(events, 1, messages=messages)))
    assert "car-3 fused without a message" in details
    assert "no message of the ego, car-1" in details


def test_fusing_somebody_who_is_not_enrolled_is_told(events):
    found = [(finding.line, finding.detail) for finding in verify(change(events, 0, teammates=["car-2", "rsu"]))]
    assert found == [
        (2, "frame 0: car-3 fused without being enrolled"),
        (3, "frame 1: car-3 fused without being enrolled"),
    ]


def test_whom_a_lost_record_may_have_enrolled_is_not_asked_about(events):
    without = events[5] | {"teammates": ["car-2", "rsu", "car-3", "car-4", "car-9"]}
    lines = seal_all([*events[:5], without, *events[6:]])
    assert [f.fault for f in verify([*lines[:5], *lines[6:]])] == [Fault.WRONG_SEQ, Fault.BROKEN_LINK]


def test_what_a_team_change_says_of_the_trusted_counts(events):
    signed = {name: proof(name, 6).as_json() for name in events[2]["messages"]}
    rejected = [*events[2]["rejected"], {"vehicle_id": "car-4", "reason": "missing"}]
    again = {"seed": events[6]["seed"], "frame": 6, "messages": signed, "rejected": rejected}
    forgotten = [*events[:6], {**events[2], **again}]
    assert [finding.detail.split(": ")[1] for finding in verify(seal_all(forgotten))] == [
        "car-3 accepted as trusted, but not on the trust list before",
        "car-3 on the trust list without a consensus",
    ]


def test_every_false_signature_is_told(events):
    for index in (1, 4, 6):
        text = json.dumps(events[index])
        digests = events[index]["messages"]["rsu"] if index != 4 else events[index]["second"]
        changed = list(events)
        changed[index] = json.loads(text.replace(digests["digest"], "0" * 64))
        assert faults(seal_all(changed)) == [(index + 1, Fault.BAD_SIGNATURE)]
    first = {**proof("rsu", 1).as_json(), "digest": "0" * 64}
    assert faults(change(events, 4, first=first)) == [(5, Fault.BAD_SIGNATURE)]
    assert faults(change(events, 4, first=proof("rsu", 1).as_json())) == []
    unsigned = {**events[1]["messages"], "rsu": {"digest": "0" * 64}}
    assert faults(change(events, 1, messages=unsigned)) == [(2, Fault.BAD_SIGNATURE)]


def test_signatures_hold_for_one_session_only(events):
    assert faults(seal_all(events, "other")) == [(n, Fault.BAD_SIGNATURE) for n in (2, 3, 5, 7)]


def test_independent_findings_are_all_told(events):
    changed = [dict(event) for event in events]
    changed[1]["sampling_steps"] = 9
    changed[2]["seed"] = "ab" * 32
    changed[4]["second"] = changed[4]["first"]
    changed[6]["frame"] = 1
    assert faults(seal_all(changed)) == [
        (2, Fault.CONTRADICTION),
        (3, Fault.WRONG_SEED),
        (5, Fault.CONTRADICTION),
        (5, Fault.BAD_SIGNATURE),
        (7, Fault.FRAME_ORDER),
        (7, Fault.BAD_SIGNATURE),
    ]


def test_the_sessions_beginning_and_end_must_be_where_they_belong(events):
    assert faults(seal_all([events[3]])) == [(1, Fault.MISPLACED)]
    assert faults(seal_all([events[0], events[0]])) == [(2, Fault.MISPLACED)]
    assert faults(seal_all([events[0], events[7], events[3], events[3]])) == [(3, Fault.MISPLACED)]


@pytest.mark.parametrize(
    ("index", "name", "value"),
    [
        (0, "ego_id", 3),
        (0, "time", "yesterday"),
        (1, "time", "2026-11-21T09:30:00.212"),
        (0, "public_keys", {"rsu": "AAAA"}),
        (0, "format", 3),
        (0, "format", True),
        (0, "defense", {"kind": "static_team", "consensus_threshold": "0.3"}),
        (0, "state", {"trusted": [1]}),
        (1, "seed", "xyz"),
        (1, "source", "dreams"),
        (1, "boxes", [[1, 2]]),
        (1, "hypotheses", [{}]),
        (1, "hypotheses", [{**HYPOTHESIS, "jaccard_index": None}]),
        (1, "messages", {"rsu": {"digest": "0", "signature": "?"}}),
        (1, "rejected", ["rsu"]),
        (1, "out_of_time", 0),
        (1, "unlogged_refusals", {"?": -1}),
        (5, "public_keys", None),
        (4, "second", None),
    ],
)
def test_records_that_lack_something_are_told(events, index, name, value):
    findings = verify(change(events, index, **{name: value}))
    assert (findings[0].line, findings[0].fault) == (index + 1, Fault.MALFORMED)
    assert name in findings[0].detail
    assert len(findings) <= 2


def test_a_finding_says_where_and_what(events):
    finding, *_ = verify(change(events, 2, frame=0))
    assert str(finding) == "line 3 (seq 3): frame-order: frame 0 after frame 0"


def test_the_command_stops_after_twenty_findings(tmp_path):
    log = tmp_path / "log.jsonl"
    log.write_bytes(b"x\n" * 30)
    result = CliRunner().invoke(app, ["audit", "verify", str(log)])
    *findings, more, total = result.output.splitlines()
    assert result.exit_code == 1
    assert len(findings) == 20
    assert (more, total) == ("... and 10 more", f"{log}: findings: 30")
