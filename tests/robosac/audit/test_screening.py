"""Refused messages in the log of a gateway, and made again from it."""

import asyncio

import numpy as np
import pytest

from robosac.answers import Reason
from robosac.audit import replay, verify
from robosac.detectors import Message
from robosac.screening import MEMORY
from tests.robosac.audit.conftest import seal_all, unpacked
from tests.service.conftest import serve


def moved(message, metres):
    pose = np.array(message.pose)
    pose[0, 3] += metres
    return Message(pose, message.tensors)


async def drive(ego_message, benign):
    """Everybody's map is of one moment, and car-2 drives on with it; car-3 sends car-4's in frame 1."""
    async with serve(iter(range(40, 60)), keep_frames=9) as served:
        session = await served.open(defense={"kind": "halving"})
        ego, answers = served.ego(session), []
        for frame in range(3):
            sent = {**benign, "car-2": moved(benign["car-2"], 2.0 * frame)}
            if frame == 1:
                sent["car-3"] = Message(benign["car-3"].pose, benign["car-4"].tensors)
            if frame == 2:
                await ego.dismiss("car-5")
                del sent["car-5"]
            answers.append(await ego.post_frame(frame, ego_message, sent))
        lines = [line.encode() for line in await ego.audit_lines()]
        return answers, lines, [await ego.kept_messages(frame) for frame in range(3)]


@pytest.fixture(scope="module")
def got(ego_message, benign):
    return asyncio.run(drive(ego_message, benign))


def frame_lines(lines):
    return [i for i, line in enumerate(lines) if b'"frame_answered"' in line]


def test_a_gateway_tests_messages_before_it_fuses_them(got):
    reasons = [{name: why.reason for name, why in answer.rejected.items()} for answer in got[0]]
    assert Reason.REPEATED not in reasons[0].values()
    assert reasons[1]["car-3"] is Reason.COPIED
    assert reasons[2]["car-2"] is Reason.REPEATED
    assert got[0][1].rejected["car-3"]["of"] == "car-4"
    assert {(each.vehicle, each.other) for each in got[0][1].alike} >= {("car-3", "car-4")}


def test_the_log_says_it_and_a_replay_tests_them_again(got, detector):
    _, lines, bodies = got
    assert verify(lines) == []
    for frame, body in enumerate(bodies):
        assert replay.replay(replay.find(lines, frame), body, detector) == []
    last = unpacked(lines[frame_lines(lines)[1]])
    lied = [why if why["vehicle_id"] != "car-3" else {**why, "reason": "late"} for why in last["rejected"]]
    records = [unpacked(line) for line in lines]
    records[frame_lines(lines)[1]]["rejected"] = lied
    forged = seal_all(records, records[0]["session_id"])
    assert {each.what for each in replay.replay(replay.find(forged, 1), bodies[1], detector)} == {"rejected"}
    records[frame_lines(lines)[1]].update(rejected=last["rejected"], alike=last["alike"][1:])
    forged = seal_all(records, records[0]["session_id"])
    assert {each.what for each in replay.replay(replay.find(forged, 1), bodies[1], detector)} == {"alike"}


def test_a_log_of_an_older_version_is_replayed_without_the_tests(got, detector):
    """In such a log nobody is refused so, and the state holds nothing of messages."""
    answers, lines, bodies = got
    records = [unpacked(line) for line in lines]
    for record in records:
        record.get("state", {}).pop(MEMORY, None)
        record.pop("alike", None)
        record.pop("screening", None)
    older = seal_all(records, records[0]["session_id"])
    assert "car-2" in answers[0].accepted
    assert verify(older) == []
    assert replay.replay(replay.find(older, 0), bodies[0], detector) == []
    assert {each.what for each in replay.replay(replay.find(older, 1), bodies[1], detector)} >= {"accepted"}
