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
    assert "neither a dissensus nor an equivocation of car-3" in said
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
