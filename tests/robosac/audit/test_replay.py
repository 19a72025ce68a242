"""Decisions of the gateway itself, downloaded, verified and made again."""

import asyncio
import dataclasses
import itertools
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from robosac import wire
from robosac.audit import replay, verify
from robosac.cli import app
from robosac.detectors import Message
from tests.robosac.audit.conftest import seal_all, unpacked
from tests.service.conftest import serve

BUDGET_MS = 1000
SAMPLING = {"sampling_budget": 7, "collaborators": 3}


class Downloaded:
    """What an auditor has of a session: its log, its head, and the messages of its frames."""

    def __init__(self, lines, head, bodies):
        self.lines, self.head, self.bodies = lines, head, bodies

    def differences(self, frame, detector, lines=None):
        return replay.replay(replay.find(lines or self.lines, frame), self.bodies[frame], detector)


async def drive(frames, change=None, serving=None, ready=lambda: None, **options):
    """Post frames (number, ego's message, teammates' messages) to a gateway of its own, once it is ready."""
    async with serve(itertools.count(40), keep_frames=100, **(serving or {})) as served:
        session = await served.open(**options)
        ego = served.ego(session)
        ready()
        for number, own, others in frames:
            if change is not None and change[0] == number:
                await ego.dismiss(change[1])
            await ego.post_frame(number, own, others)
        bodies = {number: await ego.kept_messages(number) for number, *_ in frames}
        lines = [line.encode() for line in await ego.audit_lines()]
        return Downloaded(lines, (await ego.state())["audit_head"], bodies)


def moved(message, metres):
    pose = np.array(message.pose)
    pose[0, 3] += metres
    return Message(pose, message.tensors)


DEFENSES = {
    "sample_consensus": {"kind": "sample_consensus", **SAMPLING},
    "static_team": {"kind": "static_team", "recheck_every": 2, **SAMPLING},
    "a2cp": {"kind": "a2cp"},
    "previous": {"kind": "sample_consensus", "reference": "previous", **SAMPLING},
    "none": {"kind": "none"},
    "group_testing": {"kind": "group_testing"},
}


@pytest.mark.parametrize("name", DEFENSES)
async def test_every_decision_comes_out_the_same(name, detector, ego_message, attacked):
    poses = [moved(ego_message, 0.3 * i) for i in range(4)]
    frames = [(number, own, attacked) for number, own in zip((0, 1, 2, 4), poses, strict=True)]
    got = await drive(frames, change=(2, "car-3"), defense=DEFENSES[name])
    assert verify(got.lines, got.head) == []
    for number, *_ in frames:
        assert got.differences(number, detector) == []
    previous = [replay.find(got.lines, number).previous for number, *_ in frames]
    assert [p and p.frame for p in previous] == [None, 0, 1, 2]
    assert [bool(p.motion.any()) for p in previous[1:]] == [False, True, True]


async def test_group_testing_comes_out_the_same_with_who_is_missing_and_who_is_named(
    detector, ego_message, benign, attacked
):
    silent = {name: message for name, message in attacked.items() if name != "car-4"}
    parts = (benign, attacked, attacked, silent, attacked, attacked)
    frames = [(i, moved(ego_message, 0.3 * i), others) for i, others in enumerate(parts)]
    got = await drive(frames, change=(4, "car-3"), defense={"kind": "group_testing"})
    assert verify(got.lines, got.head) == []
    assert [got.differences(number, detector) for number, *_ in frames] == [[]] * 6
    answers = [replay.find(got.lines, number).answer for number, *_ in frames]
    assert answers[3].rejected["car-4"].reason == "missing"
    assert "named" in [answer.rejected["car-2"].distrust for answer in answers[2:]]
    assert [answer.state is None for answer in answers] == [False, *[True] * 5]  # the others have its digest
    after = json.loads(wire.unpack(got.bodies[2])["states"]["after"])
    lie = {**after, "suspicion": {**after["suspicion"], "car-2": 0.5}}
    index = next(i for i, line in enumerate(got.lines) if unpacked(line).get("frame") == 2)
    assert "state" in told(got, detector, frame=2, index=index, state=lie)


@pytest.fixture(scope="module")
def got(detector, ego_message, attacked):
    frames = [(number, moved(ego_message, 0.3 * number), attacked) for number in range(3)]
    return asyncio.run(drive(frames, defense=DEFENSES["previous"]))


def changed(got, index=-1, **fields):
    """The log of a gateway that lied about a record, and chained it properly."""
    records = [unpacked(line) for line in got.lines]
    records[index].update(fields)
    return seal_all(records, records[0]["session_id"])


def told(got, detector, frame=0, **fields):
    return {difference.what for difference in got.differences(frame, detector, changed(got, **fields))}


def test_what_a_gateway_lies_about_comes_out_otherwise(got, detector):
    logged = unpacked(got.lines[-1])
    boxes = [[x + 1e-5, *rest] for x, *rest in logged["boxes"]]
    (first, *rest) = logged["hypotheses"]
    lies = [
        ({"seed": "0" * 63 + "1"}, {"hypotheses"}),
        ({"boxes": boxes}, {"boxes"}),
        ({"boxes": [[round(x + 0.01, 2), *rest] for x, *rest in logged["boxes"]]}, {"boxes"}),
        ({"boxes": boxes[1:]}, {"boxes"}),
        ({"state_digest": "0" * 64}, {"state"}),
        ({"source": "ego_only"}, {"source"}),
        ({"accepted": ["rsu"]}, {"accepted"}),
        ({"fault": "MemoryError: "}, {"fault"}),
        ({"state": {"trusted": ["rsu"]}}, {"state"}),
        ({"rejected": []}, {"rejected"}),
        ({"hypotheses": [{**first, "jaccard_index": first["jaccard_index"] + 1e-8}, *rest]}, {"hypotheses"}),
        ({"previous_frame": None}, {"hypotheses"}),
        ({"out_of_time": True}, {"out_of_time"}),
    ]
    for fields, expected in lies:
        assert told(got, detector, 2, **fields) >= expected, fields
    assert told(got, detector, 2) == set()


def test_what_was_remembered_has_to_be_what_the_log_has_the_digest_of(got, detector):
    decision, body = replay.find(got.lines, 2), wire.unpack(got.bodies[2])
    assert decision.state is None
    without = wire.pack({name: part for name, part in body.items() if name != "states"})
    for text in (b'{"trusted": ["rsu"]}', b"[1]", b"[", b"\xff"):
        forged = wire.pack({**body, "states": {**body["states"], "before": text}})
        for kept in (without, forged):
            with pytest.raises(replay.ReplayError, match="only the digest"):
                replay.replay(decision, kept, detector)
        forged = wire.pack({**body, "states": {**body["states"], "after": text}})
        assert replay.replay(decision, forged, detector) == []  # by the digest
    kept = json.loads(body["states"]["before"])
    assert replay.replay(dataclasses.replace(decision, state=kept), without, detector) == []


def test_other_inputs_are_told_and_nothing_is_recomputed(got, detector, ego_message, benign):
    decision = replay.find(got.lines, 2)
    others = {**benign, "car-9": benign["rsu"]}
    del others["car-3"]
    body = wire.pack_frame(2, moved(ego_message, 0.6), others)
    assert [str(difference) for difference in replay.replay(decision, body, detector)] == [
        "messages: that of car-2 is not the one in the log",
        "messages: that of car-3 is missing",
        "messages: that of car-9 is not in the log",
    ]
    other = decision.session.model_copy(update={"weights_digest": "0" * 64})
    (difference,) = replay.replay(dataclasses.replace(decision, session=other), got.bodies[2], detector)
    assert difference.what == "detector"
    testing = {"defense": {"kind": "group_testing"}, "calibration_digest": "0" * 64}
    other = decision.session.model_copy(update=testing)
    (difference,) = replay.replay(dataclasses.replace(decision, session=other), got.bodies[2], detector)
    assert "calibration" in str(difference)


def test_what_cannot_be_replayed_is_explained(got, detector):
    decision = replay.find(got.lines, 2)
    body = wire.unpack(got.bodies[2])
    wrong = wire.pack({**body, "teammates": {"rsu": {}}})
    for body, complaint in (
        (b"?", "must be a map"),
        (got.bodies[1], "of frame 1, not 2"),
        (wrong, "rsu.pose"),
    ):
        with pytest.raises(replay.ReplayError, match=complaint):
            replay.replay(decision, body, detector)
    for lines, complaint in (
        (got.lines[:3], "no answer to frame 2"),
        ([got.lines[0], got.lines[3]], "lacks frame 1"),
        (got.lines[3:], "does not begin"),
        ([b"{"], "line 1: not JSON"),
    ):
        with pytest.raises(replay.ReplayError, match=complaint):
            replay.find(lines, 2)
    session = decision.session.model_copy(update={"defense": {"kind": "nonesuch"}})
    with pytest.raises(replay.ReplayError, match="no defence of kind 'nonesuch'"):
        replay.replay(dataclasses.replace(decision, session=session), got.bodies[2], detector)
    twice = decision.session.model_copy(update={"teammates": decision.session.teammates * 2})
    with pytest.raises(replay.ReplayError, match="the log's team makes no session"):
        replay.replay(dataclasses.replace(decision, session=twice), got.bodies[2], detector)


def test_the_commands_prove_a_decision(got, tmp_path):
    log, messages = tmp_path / "log.jsonl", tmp_path / "frame.msgpack"
    log.write_bytes(b"\n".join(got.lines) + b"\n")
    messages.write_bytes(got.bodies[2])
    assert run("verify", log, "--head", got.head) == (
        0,
        f"{log}: 4 records, nothing wrong; head {got.head}, which is the head given",
    )
    code, said = run("replay", log, "--messages", messages)
    assert code == 0
    assert said.startswith("frame 2 (line 4): the same decision: consensus, ")
    assert run("replay", log, "--messages", messages, "--frame", 2, "--detector", "intersection-mean") == (0, said)
    log.write_bytes(b"".join(changed(got, source="ego_only")))
    code, said = run("replay", log, "--messages", messages)
    assert code == 1
    assert 'source: "consensus", logged "ego_only"' in said
    code, said = run("verify", log, "--head", got.head)
    assert code == 1
    assert "line 4 (seq 4): contradiction: frame 2: an ego-only answer with" in said
    assert "line 4 (seq 4): wrong-head" in said


def test_a_log_names_no_code_to_run_and_says_nothing_to_the_terminal(got, tmp_path):
    log, messages = tmp_path / "log.jsonl", tmp_path / "frame.msgpack"
    messages.write_bytes(got.bodies[2])
    log.write_bytes(b"".join(changed(got, 0, detector="antigravity:fly")))
    code, said = run("replay", log, "--messages", messages)
    assert code == 2
    assert "'antigravity:fly', does not ship" in said
    log.write_bytes(b"".join(changed(got, accepted=["\x1b[2J"])))
    code, said = run("verify", log)
    assert code == 1
    assert "\x1b" not in said
    assert r"\x1b[2J fused without a message" in said


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["verify", "nonesuch"], "No such file"),
        (["verify", "log", "--head", "12"], "64 hexadecimal digits"),
        (["replay", "log", "--messages", "nonesuch"], "No such file"),
        (["replay", "log", "--messages", "log"], "is no msgpack"),
        (["replay", "log", "--messages", "body", "--frame", "7"], "no answer to frame 7"),
        (["replay", "log", "--messages", "body", "--frame", "1"], "of frame 2, not 1"),
        (["replay", "log", "--messages", "body", "--detector", "nonesuch"], "no detector 'nonesuch'"),
        (["replay", "log", "--messages", "body", "--defense", "halving"], "the log's defence is "),
        (["report", "nonesuch", "--vehicle", "rsu"], "No such file"),
    ],
)
def test_bad_arguments_are_explained(got, arguments, complaint, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("log").write_bytes(b"\n".join(got.lines))
    Path("body").write_bytes(got.bodies[2])
    code, said = run(*arguments)
    assert code == 2
    assert complaint in said


def test_of_a_file_without_end_no_more_is_read_than_a_frame_has(got, tmp_path, monkeypatch):
    log, messages = tmp_path / "log", tmp_path / "frame"
    log.write_bytes(b"\n".join(got.lines))
    messages.write_bytes(got.bodies[2])
    size = len(got.bodies[2])
    for most, told in ((size, "the same decision"), (size - 1, f"a frame of more than {size - 1} bytes is not read")):
        monkeypatch.setattr("robosac.cli.audit.MOST_FRAME_BYTES", most)
        assert told in run("replay", log, "--messages", messages)[1]
    assert run("replay", log, "--messages", "/dev/zero")[0] == 2


def test_a_decision_is_made_again_with_as_many_threads_as_a_gateway_has(got, tmp_path):
    """More add up in another order, which shifts boxes by more than is tolerated."""
    (tmp_path / "log").write_bytes(b"\n".join(got.lines))
    (tmp_path / "body").write_bytes(got.bodies[2])
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        code, said = run("replay", tmp_path / "log", "--messages", tmp_path / "body")
    finally:
        torch.set_num_threads(before)
    assert (code, "the same decision" in said) == (0, True), said


def run(*arguments):
    result = CliRunner().invoke(app, ["audit", *map(str, arguments)])
    return result.exit_code, " ".join(result.output.replace("│", "").split())
