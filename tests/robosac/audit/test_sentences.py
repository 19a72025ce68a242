import json
import os
import signal
import subprocess
import sys
from typing import get_args

import pytest
from typer.testing import CliRunner

from robosac.answers import Distrust, Reason, RejectedTeammate
from robosac.audit import compact, sentence
from robosac.audit.events import Event, event_of
from robosac.audit.lines import RecordError
from robosac.audit.sentences import DISTRUSTS, REASONS, listed
from robosac.cli import app
from tests.robosac.audit.conftest import seal_all
from tests.robosac.audit.test_events import others


def told(event, **changes):
    return sentence(event_of({**event, **changes}))


def test_every_kind_of_event_has_a_sentence(events):
    written = [*events, *others(events)]
    assert {event["event"] for event in written} == {kind.model_fields["event"].default for kind in get_args(Event)}
    sentences = {event["event"]: told(event) for event in written}
    assert len(set(sentences.values())) == len(sentences)
    for said in sentences.values():
        assert said.endswith(".")
        assert "None" not in said
        assert "\n" not in said


def test_every_reason_has_words():
    assert REASONS.keys() == set(Reason)
    assert DISTRUSTS.keys() == set(Distrust)


def test_a_frame_is_told_with_who_was_left_out_and_why(events):
    answered = next(event for event in events if event["event"] == "frame_answered")
    said = told(answered, frame=7, accepted=["car-3", "car-4", "rsu"], rejected=[], hypotheses=[])
    assert said == "Frame 7 was answered with 1 box fused with car-3, car-4 and rsu, after 0 tests."
    rejected = [
        {"vehicle_id": "car-2", "reason": "distrusted", "distrust": "named"},
        {"vehicle_id": "car-5", "reason": "dissensus", "distrust": "named"},
        {"vehicle_id": "rsu", "reason": "missing"},
    ]
    box = {"status": "contradicted", "witnesses": ["car-2"], "deniers": [], "box": [0, 0, 4, 2, 0, 0.9]}
    more = {"contradicted": [box, box], "degraded_by": "deadline", "deadline_met": False, "unlogged_refusals": {"?": 2}}
    tested = [{"teammates": ["car-5"], "jaccard_index": 0.1, "verdict": "dissensus"}]
    worse = {"source": "ego_only", "accepted": [], "rejected": rejected, "hypotheses": tested, **more}
    assert told(answered, frame=8, boxes=[], **worse) == (
        "Frame 8 was answered with 0 boxes of what the ego sees alone, after 1 test; left out: car-2 (named as an "
        "attacker), car-5 (in dissensus, named as an attacker), rsu (no message came); 2 boxes contradicted and left "
        "out; cut short by the deadline; the answer was late; 2 further refusals without a record."
    )


def test_frames_that_were_late_after_all_are_told(events):
    answered, ended = (next(e for e in events if e["event"] == kind) for kind in ("frame_answered", "session_ended"))
    late = "; the answer to frame 3 had been late after all; the answer to frame 4 had been late after all."
    assert told(answered, late=[3, 4]).endswith(late)
    assert told(ended, late=[3, 4]).endswith(late)


def test_contradicted_boxes_that_a_session_keeps_in_are_told(events):
    answered = next(event for event in events if event["event"] == "frame_answered")
    boxes = [[0.0, 0.0, 4.0, 2.0, 0.0, 0.9]] * 2
    support = [{"status": status, "witnesses": [], "deniers": []} for status in ("contradicted", "confirmed")]
    assert "; 1 box contradicted and kept in" in told(answered, boxes=boxes, support=support, contradicted=[])


@pytest.mark.parametrize(
    ("kind", "changes", "said"),
    [
        ("team_changed", {"joined": ["a", "b"], "left": ["c"], "teammates": ["a", "b"]}, "a and b joined and c left; "),
        ("team_changed", {"joined": [], "left": ["c"], "teammates": []}, "c left; the team is now nobody."),
        ("detector_changed", {"accepted": True}, "the session goes on with them."),
        ("detector_changed", {"accepted": False}, "the session stands still"),
        ("access_refused", {"vehicle_id": "rsu"}, "rsu came without a token that counts"),
        ("access_refused", {"vehicle_id": None}, "Somebody came without a token that counts"),
        ("session_ended", {"why": "closed"}, "The ego closed the session."),
        ("session_ended", {"why": "expired"}, "The session expired"),
        ("session_ended", {"why": "of old"}, "The session ended: of old."),
        ("message_refused", {"frame": None, "field": None, "detail": "it said"}, " was refused ("),
        ("message_refused", {"frame": 3, "field": "pose", "detail": "it said"}, "for frame 3 was refused ("),
        ("message_refused", {"frame": None, "reason": "malformed", "field": "", "detail": "it said"}, "A message of "),
        ("message_refused", {"frame": None, "reason": "unauthenticated", "field": ""}, "A request of "),
        ("message_refused", {"reason": "unauthenticated", "field": "", "detail": "it said"}, "cated): it said."),
    ],
)
def test_a_record_is_told_as_it_is(kind, changes, said, events):
    record = next(event for event in [*events, *others(events)] if event["event"] == kind)
    assert said in told(record, **changes)


def test_names_are_listed_as_one_says_them():
    assert [listed(names) for names in ((), ("a",), ("a", "b"), "abc")] == ["nobody", "a", "a and b", "a, b and c"]
    entry = RejectedTeammate(vehicle_id="a", reason=Reason.DISTRUSTED)
    assert entry.distrust is None


def test_a_line_is_told_whatever_its_format(events, lines):
    for line in lines:
        assert sentence(line) == sentence(line.decode()) == sentence(line.removesuffix(b"\n"))
    answered = next(event for event in events if event["event"] == "frame_answered")
    (short,) = seal_all([compact(event_of(answered))])
    assert len(short) < len(seal_all([answered])[0])
    assert sentence(short) == told(answered)
    assert "no words for" in sentence('{"event": "session_moved"}')
    with pytest.raises(RecordError):
        sentence("not JSON")


def test_the_command_shows_a_log_and_obeys_no_word_of_it(events, tmp_path):
    refused = next(event for event in events if event["event"] == "message_refused")
    path = tmp_path / "log.jsonl"
    lines = seal_all([*events, {**refused, "detail": "\x1b[2Jbang"}])
    path.write_bytes(b"".join(lines))
    shown = CliRunner().invoke(app, ["audit", "show", str(path)])
    assert shown.exit_code == 0, shown.output
    printed = shown.output.splitlines()
    assert len(printed) == len(lines)
    times = [json.loads(line)["time"] for line in lines]
    assert [line.split(" ", 2)[:2] for line in printed] == [[str(seq), at] for seq, at in enumerate(times, 1)]
    assert printed[0].endswith(sentence(lines[0]))
    assert "\x1b" not in shown.output
    path.write_bytes(b"".join([lines[0], b"{}\n", b"[]\n", lines[1]]))
    broken = CliRunner().invoke(app, ["audit", "show", str(path)])
    assert broken.exit_code == 1
    assert "line 3: not JSON" in broken.output
    assert broken.output.splitlines()[-1].endswith(sentence(lines[1]))
    path.write_bytes(b"")
    empty = CliRunner().invoke(app, ["audit", "show", str(path)])
    assert (empty.exit_code, empty.output) == (1, f"{path}: the log is empty\n")
    assert CliRunner().invoke(app, ["audit", "show", "/nowhere"]).exit_code == 2


def test_a_terminal_that_has_not_every_character_shows_what_it_has(events, tmp_path):
    refused = next(event for event in events if event["event"] == "message_refused")
    path = tmp_path / "log.jsonl"
    path.write_bytes(b"".join(seal_all([{**refused, "detail": "a name of 65 characters, \u00e9\u2026"}])))
    words = [sys.executable, "-c", "from robosac.cli import app; app()", "audit", "show", str(path)]
    environment = {**os.environ, "PYTHONIOENCODING": "latin-1"}
    done = subprocess.run(words, check=False, capture_output=True, encoding="latin-1", env=environment)
    assert (done.returncode, "characters, \u00e9?" in done.stdout) == (0, True), done.stderr


def test_whoever_has_read_enough_ends_it_without_a_word(lines, tmp_path):
    path = tmp_path / "log.jsonl"
    path.write_bytes(lines[0] * 5000)
    words = [sys.executable, "-c", "from robosac.cli import app; app()", "audit", "show", str(path)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as shown:
        assert shown.stdout.readline().endswith(".\n")
        shown.stdout.close()
        assert shown.stderr.read() == ""
    assert shown.returncode == 128 + signal.SIGPIPE
