import asyncio
import json
import time

import msgpack
import numpy as np
import pytest

from robosac.audit import expanded
from robosac.boxes import pose_matrix
from robosac.defenses import SampleConsensus
from robosac.detectors import Message
from robosac.fusion import fuse
from service.sessions.gathering import Gathering, Received
from service.sessions.room import Room
from tests.service.conftest import EGO, TEAM, problem, serve, until

ACCEPT_JSON = {"Accept": "application/json"}


async def test_over_http_and_through_the_library_the_answer_is_the_same(detector, ego_message, attacked):
    defense = {"kind": "sample_consensus", "attacker_ratio": 0.2, "sampling_budget": 7, "collaborators": 3}
    async with serve(range(100)) as served:
        session = await served.open(defense=defense)
        steps = []
        for frame in range(6):
            answer = await served.ego(session).post_frame(frame, ego_message, attacked)
            expected = fuse(
                detector,
                SampleConsensus(sampling_budget=7, collaborators=3),
                ego_message,
                {name: attacked[name] for name in TEAM},
                rng=np.random.default_rng(frame),
            )
            np.testing.assert_array_equal(answer.boxes, expected.boxes)
            assert answer.accepted == expected.accepted
            assert [tuple(h.teammates) for h in answer.hypotheses] == [o.teammates for o in expected.hypotheses]
            assert [h.verdict for h in answer.hypotheses] == [o.verdict.value for o in expected.hypotheses]
            assert [h.jaccard_index for h in answer.hypotheses] == [o.jaccard_index for o in expected.hypotheses]
            assert "car-2" not in answer.accepted
            steps.append(answer.sampling_steps)
        assert max(steps) > 1


async def test_the_audit_log_replays_a_decision(detector, served, ego_message, attacked):
    session = await served.open(defense={"kind": "sample_consensus", "sampling_budget": 7, "collaborators": 3})
    answer = await served.ego(session).post_frame(0, ego_message, attacked)
    record = (await served.ego(session).audit())[-1]
    again = fuse(
        detector,
        SampleConsensus(sampling_budget=7, collaborators=3),
        ego_message,
        {name: attacked[name] for name in TEAM},
        rng=np.random.default_rng(int(record["seed"], 16)),
    )
    assert again.accepted == answer.accepted
    np.testing.assert_array_equal(again.boxes, answer.boxes)


async def test_a_frame_result_has_the_fields_of_the_contract(served, good_frame):
    session = await served.open()
    response = await served.post(session, "frames", good_frame(7), **ACCEPT_JSON)
    assert response.headers["content-type"] == "application/json"
    result = response.json()
    assert result["frame"] == 7
    assert result["source"] == "consensus"
    assert all(len(box) == 6 for box in result["boxes"])
    assert set(result["accepted"]) | {entry["vehicle_id"] for entry in result["rejected"]} == set(TEAM)
    assert result["sampling_steps"] == len(result["hypotheses"]) >= 1
    assert set(result["hypotheses"][0]) == {"teammates", "jaccard_index", "verdict"}
    assert set(result["suspicion"]) == set(TEAM)
    assert result["attacker_ratio"] == pytest.approx(sum(result["suspicion"].values()) / len(TEAM))
    assert result["deadline_met"] is True
    assert result["degraded_by"] is None
    assert {"receive", "queue", "prepare", "ego_only", "hypotheses", "consensus", "total"} <= set(result["timings_ms"])


@pytest.mark.parametrize(
    ("accept", "media_type"),
    [
        ("application/vnd.msgpack", "application/vnd.msgpack"),
        ("application/msgpack", "application/vnd.msgpack"),
        ("text/html, application/msgpack;q=0.5", "application/vnd.msgpack"),
        ("application/json, application/msgpack", "application/json"),
        ("*/*", "application/json"),
        ("", "application/json"),
    ],
)
async def test_results_come_as_the_client_asks(served, good_frame, accept, media_type):
    session = await served.open()
    response = await served.post(session, "frames", good_frame(0), Accept=accept)
    assert response.headers["content-type"] == media_type
    result = response.json() if media_type.endswith("json") else msgpack.unpackb(response.content)
    assert result["frame"] == 0


async def test_of_a_long_accept_only_the_beginning_is_read(served, good_frame):
    session = await served.open()
    for before, media_type in (("," * 400, "application/vnd.msgpack"), ("," * 30_000, "application/json")):
        accept = f"{before}application/vnd.msgpack"
        response = await served.post(session, "frames", good_frame(len(before)), Accept=accept)
        assert (response.status_code, response.headers["content-type"]) == (200, media_type)


async def test_both_msgpack_types_are_taken_and_others_are_not(served, good_frame):
    session = await served.open()
    response = await served.post(session, "frames", good_frame(0), **{"Content-Type": "application/msgpack"})
    assert response.status_code == 200
    for media_type in ("application/json", "application/octet-stream", ""):
        response = await served.post(session, "frames", good_frame(1), **{"Content-Type": media_type})
        problem(response, 415, "unsupported-media-type")
    response = await served.post(session, "frames", good_frame(1), **{"Content-Encoding": "gzip"})
    problem(response, 415, "unsupported-encoding")


async def test_frames_of_the_ego_must_increase(served, good_frame):
    session = await served.open()
    assert (await served.post(session, "frames", good_frame(3))).status_code == 200
    for stale in (3, 2):
        assert problem(await served.post(session, "frames", good_frame(stale)), 409, "stale-frame")["field"] == "frame"
    assert (await served.post(session, "frames", good_frame(4))).status_code == 200


async def test_a_frame_sent_again_is_a_replay_and_an_older_one_is_stale(served, good_frame):
    session = await served.open()
    for frame in (3, 3, 2):
        await served.post(session, "frames", good_frame(frame))
    refused = [r["reason"] for r in await served.ego(session).audit() if r["event"] == "message_refused"]
    assert refused == ["replayed", "stale"]


async def test_the_budget_counts_from_the_arrival_not_from_the_fusion(served, good_frame):
    session = await served.open(latency_budget_ms=150, gather_ms=0)
    live = served.gateway.sessions._live[session.session_id]
    async with live.lock:
        posting = asyncio.create_task(served.post(session, "frames", good_frame(0)))
        await asyncio.sleep(0.3)
    result = (await posting).json()
    assert (result["degraded_by"], result["deadline_met"]) == ("deadline", False)


class Counted:
    """A coroutine, and how often whoever awaits it had to wait."""

    def __init__(self, coroutine):
        self.coroutine, self.waits = coroutine, 0

    def __await__(self):
        steps = self.coroutine.__await__()
        while True:
            try:
                step = next(steps)
            except StopIteration as end:
                return end.value
            self.waits += 1
            yield step


async def test_waiting_for_teammates_costs_nothing(messages):
    gathering = Gathering(TEAM, 4, Room(2**30).share("", "session"))
    counted = Counted(gathering.collect(0, time.perf_counter() + 60))

    async def wait():
        return await counted

    waiting = asyncio.create_task(wait())
    for name in TEAM:
        await asyncio.sleep(0.02)
        gathering.offer(0, name, Received(messages[name], "digest"))
    assert set(await waiting) == set(TEAM)
    assert counted.waits == len(TEAM)


async def test_the_wait_for_the_detectors_thread_is_measured(served, good_frame):
    session = await served.open()
    busy = served.gateway.engine._executor.submit(time.sleep, 0.2)
    result = (await served.post(session, "frames", good_frame(0))).json()
    busy.result()
    assert 100 < result["timings_ms"]["queue"] < 1000


async def test_a_refusal_of_the_ego_blames_no_teammate(served, good_frame):
    session = await served.open()
    await served.post(session, "messages", b"junk")
    assert served.gateway.sessions._live[session.session_id].gathering._refusals == {}


async def test_the_same_frame_sent_twice_at_once_is_answered_once(served, good_frame):
    session = await served.open()
    responses = await asyncio.gather(*(served.post(session, "frames", good_frame(0)) for _ in range(3)))
    assert sorted(response.status_code for response in responses) == [200, 409, 409]


async def test_a_session_that_ends_under_a_waiting_ego_says_so(served, messages):
    session = await served.open(gather_ms=300)
    ego = served.ego(session)
    asking = asyncio.create_task(ego.ask(0, messages[EGO]))
    await until(served.gateway.sessions._live[session.session_id].lock.locked)
    await ego.close()
    assert (await asking).source == "ego_only"


async def test_when_time_is_short_the_ego_answers_alone_and_says_why(served, good_frame):
    session = await served.open(latency_budget_ms=0.01, gather_ms=0)
    result = (await served.post(session, "frames", good_frame(0))).json()
    assert (result["source"], result["degraded_by"], result["deadline_met"]) == ("ego_only", "deadline", False)
    assert {entry["reason"] for entry in result["rejected"]} == {"not_sampled"}
    assert len(result["boxes"])


async def test_a_fault_inside_still_gives_the_ego_its_own_boxes(hooked, good_frame, caplog):
    caplog.set_level("CRITICAL")

    def broken(_, teammates):
        if teammates:
            raise RuntimeError("boom")

    hooked.detector.before_prepare = broken
    session = await hooked.open()
    result = (await hooked.post(session, "frames", good_frame(0))).json()
    assert (result["source"], result["degraded_by"]) == ("ego_only", "fault")
    assert "boom" in (await hooked.ego(session).audit())[-1]["fault"]
    hooked.detector.before_prepare = None
    assert (await hooked.post(session, "frames", good_frame(1))).json()["source"] == "consensus"


async def test_an_empty_street_is_no_evidence_and_earns_nobody_trust(served, ego_message):
    blank = {"features": np.zeros((64, 32, 32), dtype=np.float16)}
    nothing = Message(pose_matrix(0, 0, 1.7, 0), blank)
    session = await served.open(defense={"kind": "sample_consensus", "sampling_budget": 3, "collaborators": 3})
    answer = await served.ego(session).post_frame(0, nothing, dict.fromkeys(TEAM, nothing))
    if len(answer.boxes) == 0:
        assert answer.source == "ego_only"
        assert {h.verdict for h in answer.hypotheses} == {"no_evidence"}


async def test_the_audit_log_is_json_lines_from_any_point(served, ego_message, attacked):
    session = await served.open(defense={"kind": "sample_consensus", "sampling_budget": 7, "collaborators": 3})
    ego = served.ego(session)
    for frame in range(3):
        await ego.post_frame(frame, ego_message, attacked)
    response = await served.http.get(
        f"/v1/sessions/{session.session_id}/audit", headers={"Authorization": f"Bearer {session.ego_token}"}
    )
    assert response.headers["content-type"] == "application/jsonl"
    records = [json.loads(line) for line in response.text.splitlines()]
    assert [record["seq"] for record in records] == [1, 2, 3, 4]
    assert [record["event"] for record in records] == ["session_opened"] + ["frame_answered"] * 3
    assert records[0]["weights_digest"] == session.detector["weights_digest"]
    for record in records[1:]:
        assert {"accepted", "rejected", "hypotheses", "seed", "timings_us", "state_digest"} <= set(record)
    assert ["state" in record for record in records] == [True, True, False, False]
    assert await ego.audit(after=2) == [expanded(record) for record in records[2:]]
    (last,) = await ego.audit(after=3)
    assert {"timings_ms", "deadline_met", "boxes", "trusted"} <= set(last)
    limited = await served.http.get(
        f"/v1/sessions/{session.session_id}/audit?after=1&limit=2",
        headers={"Authorization": f"Bearer {session.ego_token}"},
    )
    assert limited.text.splitlines() == response.text.splitlines()[1:3]
    assert await ego.audit(after=99) == []
