import base64
import json
import subprocess
import sys
from datetime import UTC, datetime

import numpy as np
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from typer.testing import CliRunner

from clients.errors import GatewayError
from robosac.audit import misbehaviour, verify
from robosac.cli import app
from robosac.detectors import Message
from robosac.signatures import is_valid, read_public_key, show_public_key
from robosac.wire import content_digest
from tests.robosac.audit.conftest import KEY, SESSION, head, proof, seal_all
from tests.service.conftest import serve

NOW = datetime(2025, 1, 1, tzinfo=UTC)
HARMLESS = ("not_sampled", "suspected", "missing", "late", "malformed", "stale", "unauthenticated", "replayed")


def observations(made):
    return [
        (target["tgtId"], found["obsId"], found["class"], found["obs"]["frame"])
        for target in made["report"]["content"]["observations"]
        for found in target["observations"]
    ]


def test_a_rejected_vehicle_is_reported_with_its_evidence(lines, events):
    made = misbehaviour.report(lines, "car-2", NOW)
    assert (made["version"], made["report"]["aid"]) == (2, 270549119)
    assert observations(made) == [("perception", "dissensus", 4, 0), ("perception", "dissensus", 4, 5)]
    content = made["report"]["content"]
    (first, _) = content["observations"][0]["observations"]
    assert first["obs"] == {
        "frame": 0, "hypotheses": [0], "lowestJaccardIndex": 0.125, "consensusThreshold": 0.3
    }  # fmt: skip
    assert content["v2xPduEvidence"][0] == {
        "type": "robosac-message",
        "v2xPdus": [{"frame": 0, "digest": proof("car-2", 0).digest, "signature": None}],
        "certificate": None,
        "subjectPduIndex": 0,
    }
    *decisions, log = content["nonV2xPduEvidence"]
    assert [decision["evidence"]["seq"] for decision in decisions] == [2, 7]
    evidence = decisions[0]["evidence"]
    assert evidence["hypotheses"] == [
        {"teammates": ["car-2", "rsu"], "jaccardIndex": 0.125, "verdict": "dissensus"},
        {"teammates": ["rsu", "car-3"], "jaccardIndex": 0.75, "verdict": "consensus"},
    ]
    assert evidence["messages"]["rsu"] == proof("rsu", 0).as_json()
    assert evidence["messages"].keys() == events[1]["messages"].keys()
    assert log["evidence"] == {
        "sessionId": SESSION, "egoId": "car-1", "head": head(lines), "lastSeq": 8, "seq": [2, 7]
    }  # fmt: skip
    assert made["observationLocation"]["frame"] == 5


def test_an_equivocation_is_reported_with_both_signatures(lines):
    made = misbehaviour.report(lines, "rsu", NOW)
    both = (proof("rsu", 1), proof("rsu", 1, ", otherwise"))
    assert observations(made) == [("message", "equivocation", 2, 1)]
    (stream,) = made["report"]["content"]["v2xPduEvidence"]
    assert [pdu["digest"] for pdu in stream["v2xPdus"]] == [each.digest for each in both]
    assert [pdu["signature"] for pdu in stream["v2xPdus"]] == [each.as_json()["signature"] for each in both]
    assert stream["certificate"]["vehicleId"] == "rsu"
    assert read_public_key(stream["certificate"]["ed25519PublicKey"]) == KEY.public_key()


async def test_two_signed_messages_of_the_gateway_prove_an_equivocation(messages):
    other = Message(messages["rsu"].pose + 0.25 * np.eye(4, k=3), messages["rsu"].tensors)
    async with serve() as served:
        session = await served.open(gather_ms=20, public_keys={"rsu": show_public_key(KEY)})
        unit = served.client.vehicle(session.session_id, "rsu", session.teammate_tokens["rsu"], KEY)
        await unit.send(3, messages["rsu"])
        with pytest.raises(GatewayError):
            await unit.send(3, other)
        lines = [line.encode() for line in await served.ego(session).audit_lines()]
    assert verify(lines) == []
    (stream,) = misbehaviour.report(lines, "rsu", NOW)["report"]["content"]["v2xPduEvidence"]
    key = read_public_key(stream["certificate"]["ed25519PublicKey"])
    for pdu, message in zip(stream["v2xPdus"], (messages["rsu"], other), strict=True):
        assert pdu["digest"] == content_digest(3, "rsu", message)
        assert is_valid(key, session.session_id, "rsu", 3, pdu["digest"], base64.b64decode(pdu["signature"]))


def test_a_dissensus_with_the_previous_answer_is_a_conflict_with_other_stations(events):
    events[0] = {**events[0], "defense": {**events[0]["defense"], "reference": "previous"}}
    events[6] = {**events[6], "previous_frame": 4}
    made = misbehaviour.report(seal_all(events), "car-2", NOW)
    assert [found[2] for found in observations(made)] == [4, 5]
    events[6] = {**events[6], "previous_frame": 1}
    made = misbehaviour.report(seal_all(events), "car-2", NOW)
    assert [found[2] for found in observations(made)] == [4, 4]


def rejecting(event, reason, **fields):
    (entry,) = [entry for entry in event["rejected"] if entry["vehicle_id"] == "car-2"]
    others = [other for other in event["rejected"] if other is not entry]
    return {**event, "rejected": [*others, {"vehicle_id": "car-2", "reason": reason, **fields}]}


@pytest.mark.parametrize(
    ("reason", "fields", "target", "detector_class", "told"),
    [
        (
            "implausible",
            {"tensor": "features", "largest": 90.0, "rms": None, "most_largest": 20.0, "most_rms": 2.0},
            "message",
            1,
            {"tensor": "features", "largest": 90.0, "rms": None, "mostLargest": 20.0, "mostRms": 2.0},
        ),
        (
            "repeated",
            {"of_frame": 1, "moved_m": 8.5, "correlation": 1.0},
            "message",
            2,
            {"ofFrame": 1, "movedM": 8.5, "correlation": 1.0},
        ),
        ("copied", {"of": "rsu", "of_frame": 1}, "message", 5, {"of": "rsu", "ofFrame": 1}),
        (
            "distrusted",
            {"distrust": "named", "suspicion": 0.99, "evidence": [{"test": "objects"}], "misplaced_m": 1.0},
            "perception",
            5,
            {"suspicion": 0.99, "evidence": [{"test": "objects"}]},
        ),
    ],
)
def test_what_else_accuses_is_reported_with_its_evidence(events, reason, fields, target, detector_class, told):
    events[6] = rejecting(events[6], reason, **fields)
    made = misbehaviour.report(seal_all(events), "car-2", NOW)
    kind = "named" if reason == "distrusted" else reason
    assert set(observations(made)) == {("perception", "dissensus", 4, 0), (target, kind, detector_class, 5)}
    content = made["report"]["content"]
    seen = content["observations"][-1]["observations"][-1]
    assert seen["obs"] == {"frame": 5, **told}
    stream = content["v2xPduEvidence"][seen["v2xPduEvidenceIndex"]]
    frames = [1, 5] if reason == "repeated" else [5]
    assert [(pdu["frame"], pdu["digest"]) for pdu in stream["v2xPdus"]] == [
        (frame, proof("car-2", frame).digest) for frame in frames
    ]
    assert stream["subjectPduIndex"] == len(frames) - 1
    decision, log = content["nonV2xPduEvidence"][-2:]
    assert (decision["evidence"]["seq"], decision["evidence"]["rejected"]["car-2"]) == (7, reason)
    assert log["evidence"]["seq"] == [2, 7]
    assert made["observationLocation"]["frame"] == 5


def test_who_is_named_when_its_message_is_refused_is_reported_for_both(events):
    events[6] = rejecting(events[6], "implausible", tensor="features", distrust="named")
    made = misbehaviour.report(seal_all(events), "car-2", NOW)
    assert [found[:2] for found in observations(made) if found[3] == 5] == [
        ("perception", "named"), ("message", "implausible")
    ]  # fmt: skip
    assert len([e for e in made["report"]["content"]["nonV2xPduEvidence"] if e["id"] == "decision"]) == 2


@pytest.mark.parametrize(
    ("reason", "fields"),
    [
        *((reason, {}) for reason in HARMLESS),
        ("not_sampled", {"suspicion": 0.9, "misplaced_m": 2.0}),
        ("distrusted", {"distrust": "untrusted"}),
        ("distrusted", {"distrust": "equivocation"}),
    ],
)
def test_what_accuses_nobody_is_not_reported(events, reason, fields):
    events[1], events[6] = (rejecting(events[i], reason, **fields) for i in (1, 6))
    with pytest.raises(misbehaviour.NothingToReport, match="car-2"):
        misbehaviour.report(seal_all(events), "car-2", NOW)


async def test_what_a_gateway_refuses_and_names_is_reported(messages):
    loud = {name: tensor * 1000 for name, tensor in messages["car-2"].tensors.items()}
    async with serve() as served:
        session = await served.open(defense={"kind": "group_testing"})
        ego = served.ego(session)
        others = {name: message for name, message in messages.items() if name != "car-1"}
        for frame in range(3):
            await ego.post_frame(frame, messages["car-1"], {**others, "car-2": Message(messages["car-2"].pose, loud)})
        lines = [line.encode() for line in await ego.audit_lines()]
    assert verify(lines) == []
    made = misbehaviour.report(lines, "car-2", NOW)
    assert observations(made) == [
        *(("message", "implausible", 1, frame) for frame in range(3)), ("perception", "named", 5, 2)
    ]  # fmt: skip
    obs = made["report"]["content"]["observations"][0]["observations"][0]["obs"]
    assert obs["largest"] > obs["mostLargest"]


async def test_who_is_named_by_a_gateway_is_reported(ego_message, attacked):
    async with serve() as served:
        session = await served.open(defense={"kind": "group_testing"})
        ego = served.ego(session)
        answers = [await ego.post_frame(frame, ego_message, attacked) for frame in range(4)]
        lines = [line.encode() for line in await ego.audit_lines()]
    assert answers[-1].named == ("car-2",)
    made = misbehaviour.report(lines, "car-2", NOW)
    named = [found["obs"] for target in made["report"]["content"]["observations"]
             for found in target["observations"] if found["obsId"] == "named"]  # fmt: skip
    assert [obs["frame"] for obs in named] == [answer.frame for answer in answers if answer.named]
    assert named[0]["evidence"]
    assert named[0]["suspicion"] > 0.5


def test_the_key_reported_is_that_of_the_time(events):
    other = show_public_key(Ed25519PrivateKey.from_private_bytes(bytes(31) + b"\x02"))
    events[5] = {**events[5], "public_keys": {"rsu": other}}
    late = {**events[4], "frame": 5}
    made = misbehaviour.report(seal_all([*events[:7], late]), "rsu", NOW)
    keys = [stream["certificate"]["ed25519PublicKey"] for stream in made["report"]["content"]["v2xPduEvidence"]]
    assert keys == [show_public_key(KEY), other]


def test_the_time_counts_leap_seconds(lines):
    days = 7671  # from 2004 to 2025
    assert misbehaviour.report(lines, "car-2", NOW)["generationTime"] == (days * 86400 + 5) * 1_000_000


@pytest.mark.parametrize("vehicle", ["car-1", "car-3", "nobody"])
def test_of_whom_the_log_says_nothing_nothing_is_reported(lines, vehicle):
    with pytest.raises(misbehaviour.NothingToReport, match=vehicle):
        misbehaviour.report(lines, vehicle, NOW)


def run(*arguments):
    result = CliRunner().invoke(app, ["audit", "report", *map(str, arguments)])
    return result.exit_code, result.output


def test_the_command_reads_a_pipe_as_it_reads_a_file(lines):
    words = [sys.executable, "-c", "from robosac.cli import app; app()", "audit", "report", "/dev/stdin"]
    done = subprocess.run(
        [*words, "--vehicle", "car-2"], check=False, input=b"".join(lines), capture_output=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["report"]["content"]["v2xPduEvidence"]


def test_the_command_writes_a_report_from_a_sound_log_only(lines, tmp_path):
    log, out = tmp_path / "log.jsonl", tmp_path / "report.json"
    log.write_bytes(b"".join(lines))
    assert run(log, "--vehicle", "car-2", "--out", out) == (0, f"{out}: 2 observations of car-2\n")
    code, said = run(log, "--vehicle", "car-2")
    fields, printed = json.loads(out.read_text()), json.loads(said)
    assert code == 0
    assert printed.pop("generationTime") >= fields.pop("generationTime") > 0
    assert printed == fields
    code, said = run(log, "--vehicle", "car-3")
    assert code == 1
    assert "nothing to report of car-3: no dissensus, no naming as an attacker" in said
    code, said = run(log, "--vehicle", "car-9")
    assert code == 2
    assert "car-9 was never in the session; these were: car-1, car-2, rsu, car-3, car-4" in said
    one = tmp_path / "one.json"
    assert run(log, "--vehicle", "rsu", "--out", one) == (0, f"{one}: 1 observation of rsu\n")
    assert run(log, "--vehicle", "car-2", "--out", tmp_path)[0] == 2
    log.write_bytes(b"".join(lines[1:]))
    code, said = run(log, "--vehicle", "car-2")
    assert code == 1
    assert "line 1 (seq 2): wrong-seq" in said
