import asyncio
from contextlib import ExitStack

import pytest

from robosac import wire
from service.deciding.admission import SESSION_FRAMES, Admission
from service.errors import Kind, Refused
from tests.service.conftest import EGO, problem, serve


def test_frames_are_admitted_as_long_as_they_can_be_answered_in_time():
    admission = Admission()
    for number in range(200):
        admission.learn(number, number + 0.010, 0.001)
    taken = []

    def take_on_until_refused():
        for number in range(100):
            block = admission.frame(f"session {number}", 0.2)
            block.__enter__()
            taken.append(block)

    with pytest.raises(Refused) as refused:
        take_on_until_refused()
    assert 9 <= len(taken) <= 10  # 0.5 x 200 ms / 10 ms
    assert refused.value.kind is Kind.OVERLOADED
    assert refused.value.retry_after_s >= 1
    with admission.frame("more time", 20.0):
        pass
    taken.pop().__exit__(None, None, None)
    with admission.frame("again", 0.2):
        pass


def test_frames_that_overlap_cost_what_each_adds():
    """Each takes 40 ms from its arrival to its end, but one ends every 10 ms."""
    admission = Admission()
    for number in range(400):
        admission.learn(0.01 * number, 0.01 * number + 0.04, 0.0)
    with ExitStack() as taken:
        for number in range(9):
            taken.enter_context(admission.frame(f"session {number}", 0.2))


def test_a_frame_that_cannot_be_in_time_anyway_is_admitted_if_nothing_else_is_in_hand():
    admission = Admission()
    for number in range(200):
        admission.learn(2.0 * number, 2.0 * number + 1.0, 0.001)
    with admission.frame("slow", 0.1), pytest.raises(Refused):
        admission.check("other", 0.1)


async def test_no_ego_takes_the_share_of_the_others(served, good_frame, messages, benign):
    greedy, modest = await served.open(), await served.open()
    posts = [served.post(greedy, "frames", good_frame(frame)) for frame in range(SESSION_FRAMES + 4)]
    *answers, answer = await asyncio.gather(*posts, served.ego(modest).post_frame(0, messages[EGO], benign))
    refused = [response for response in answers if response.status_code != 200]
    assert len(refused) >= 4
    for response in refused:
        problem(response, response.status_code, "overloaded" if response.status_code == 503 else "stale-frame")
    assert any(response.status_code == 503 for response in refused)
    assert answer.source == "consensus"


async def test_beyond_capacity_a_frame_is_refused_before_it_is_read(served, good_frame):
    session = await served.open(latency_budget_ms=200.0, gather_ms=0)
    admission = served.gateway.admission
    for number in range(200):
        admission.learn(number - 1000, number - 1000 + 0.1, 0.0)

    async def unread():
        pytest.fail("the body was read")
        yield b""

    with admission.frame("another", 10.0), admission.frame("a third", 10.0):
        refused = await served.post(session, "frames", unread(), token="not even looked at")
        assert refused.headers["retry-after"]
        problem(refused, 503, "overloaded")
    assert (await served.post(session, "frames", good_frame(0))).status_code == 200


async def test_a_slow_body_is_cut_off(messages, benign):
    async with serve(body_timeout_s=0.3) as served:
        session = await served.open()
        body = wire.pack_frame(0, messages[EGO], benign)

        async def dripping():
            yield body[:1000]
            for i in range(1000, 1200):
                await asyncio.sleep(0.1)
                yield body[i : i + 1]

        refused = await served.post(session, "frames", dripping())
        assert problem(refused, 408, "slow-body")["detail"]
        (record,) = [r for r in await served.ego(session).audit() if r["event"] == "message_refused"]
        assert "in time" in record["detail"]
        assert (await served.ego(session).post_frame(0, messages[EGO], benign)).source == "consensus"
        opening = await served.http.post(
            "/v1/sessions", content=dripping(), headers={"content-type": "application/json"}
        )
        problem(opening, 408, "slow-body")


@pytest.mark.parametrize("length", [None, "0", "+5", "9" * 30])
async def test_a_body_is_bounded_whatever_its_headers_say(length):
    """Servers refuse such headers themselves; nothing here rests on it."""

    async def dripping():
        for _ in range(30):
            yield b" "
            await asyncio.sleep(0.05)

    async def call(served, body):
        headers = {"content-type": "application/json"} | ({} if length is None else {"content-length": length})
        return await served.http.post("/v1/sessions", content=body, headers=headers)

    async with serve(body_timeout_s=0.2) as served:
        problem(await call(served, dripping()), 408, "slow-body")
    async with serve(max_body_bytes=2048) as served:
        problem(await call(served, _endless()), 413, "too-large")


async def _endless():
    for _ in range(1000):
        yield bytes(1024)


async def test_opening_sessions_costs_little_and_ends_at_the_limit():
    async with serve(max_sessions=300) as served:
        for number in range(300):
            await served.client.open_session(f"car-{number}", ["rsu"])
        body = {"ego_id": "one-more", "teammates": ["rsu"]}
        problem(await served.http.post("/v1/sessions", json=body), 503, "too-many-sessions")
