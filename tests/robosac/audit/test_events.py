import json
from typing import get_args

import pytest

from robosac.audit import events as kinds
from robosac.audit.events import Event, event_on
from robosac.audit.lines import RecordError
from tests.robosac.audit.conftest import proof


def others(events):
    """One event of each kind that the log of the fixture lacks."""
    return [
        kinds.DetectorChanged(detector="d", weights_digest="ab", accepted=False).as_json(),
        kinds.AccessRefused(vehicle_id=None, detail="a bearer token is needed").as_json(),
        kinds.TokenRenewed(vehicle_id="rsu", expires_at="2026-01-01T00:00:00Z").as_json(),
    ]


def test_every_kind_reads_back_as_it_was_written(events):
    written = [*events, *others(events)]
    assert {event["event"] for event in written} == {kind.model_fields["event"].default for kind in get_args(Event)}
    for event in written:
        read = event_on(json.dumps({**event, "session_id": "s", "seq": 1, "previous": "0" * 64}).encode())
        assert read.as_json() == event


def test_a_kind_of_a_later_version_is_none():
    assert event_on(b'{"event": "session_moved"}') is None


@pytest.mark.parametrize(
    ("index", "changes", "where"),
    [
        (0, {"ego_id": 3}, "ego_id"),
        (0, {"public_keys": {"rsu": None}}, "public_keys.rsu"),
        (0, {"state": {"trusted": [1]}}, "state"),
        (0, {"state": {"trusted": "rsu"}}, "state"),
        (1, {"frame": "0"}, "frame"),
        (1, {"frame": True}, "frame"),
        (1, {"frame": -1}, "frame"),
        (1, {"timings_ms": {"total": 1e308}}, "timings_ms.total"),
        (1, {"timings_ms": {"total": -1.0}}, "timings_ms.total"),
        (4, {"frame": -1}, "frame"),
        (1, {"seed": "xyz"}, "seed"),
        (1, {"ego_pose": [1.0]}, "ego_pose"),
        (1, {"messages": {"rsu": {"digest": 3}}}, "messages.rsu.digest"),
        (1, {"messages": {"rsu": {"digest": "d", "signature": "?"}}}, "messages.rsu.signature"),
        (1, {"hypotheses": [{"teammates": ["a"], "jaccard_index": "1", "verdict": "consensus"}]}, "jaccard_index"),
        (1, {"out_of_time": 0}, "out_of_time"),
        (3, {"reason": "whim"}, "reason"),
        (4, {"second": None}, "second"),
    ],
)
def test_a_record_is_read_strictly(events, index, changes, where):
    with pytest.raises(RecordError, match=where):
        event_on(json.dumps({**events[index], **changes}).encode())
    (name,) = changes
    without = {key: value for key, value in events[index].items() if key != name}
    with pytest.raises(RecordError, match=f"{name}: Field required"):
        event_on(json.dumps(without).encode())


def test_what_older_versions_did_not_write_is_not_missed(events):
    answered = dict(events[1])
    for name in ("fault", "previous_frame", "unlogged_refusals", "suspicion", "support", "contradicted"):
        del answered[name]
    read = event_on(json.dumps(answered).encode())
    assert (read.fault, read.previous_frame, read.unlogged_refusals, read.suspicion) == (None, None, {}, None)
    assert (read.support, read.contradicted) == (None, None)


def test_support_is_read_strictly_where_it_is_written(events):
    good = {"status": "confirmed", "witnesses": ["rsu"], "deniers": []}
    assert event_on(json.dumps({**events[1], "support": [good]}).encode()).support[0].witnesses == ("rsu",)
    for wrong in ([], [{**good, "status": "hearsay"}], [{**good, "witnesses": "rsu"}]):
        with pytest.raises(RecordError, match="support"):
            event_on(json.dumps({**events[1], "support": wrong}).encode())


def test_a_signature_is_bytes_in_python_and_base64_in_json():
    signed = proof("rsu", 0)
    assert len(signed.signature) == 64
    assert signed.as_json()["signature"].endswith("==")
    assert "signature" not in proof("car-2", 0).as_json()


@pytest.mark.parametrize("event", [None, 5, ["session_ended"]])
def test_a_record_says_what_happened(event):
    with pytest.raises(RecordError, match="event: must be a string"):
        event_on(json.dumps({"seq": 1, "event": event}).encode())


@pytest.mark.parametrize("line", [b"", b"[]", b"\xff", b'{"a": NaN}', b"[" * 100_000])
def test_what_is_no_record_is_told(line):
    with pytest.raises(RecordError, match="not JSON"):
        event_on(line)
