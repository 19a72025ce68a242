import asyncio
import itertools
import threading

import msgpack
import numpy as np

from robosac import wire
from tests.service.conftest import EGO, MSGPACK, TEAM, problem, serve


async def test_vehicles_send_their_own_messages(served, messages):
    session = await served.open()
    sends = [served.teammate(session, name).send(0, messages[name]) for name in TEAM]
    answer, *_ = await asyncio.gather(served.ego(session).ask(0, messages[EGO]), *sends)
    assert answer.source == "consensus"
    assert {entry.reason for entry in answer.rejected.values()} <= {"not_sampled", "dissensus"}
    assert answer.timings_ms["gather"] >= 0


async def test_the_ego_does_not_wait_longer_than_for_all(served, messages):
    session = await served.open(gather_ms=10_000)
    for name in TEAM:
        await served.teammate(session, name).send(0, messages[name])
    answer = await served.ego(session).ask(0, messages[EGO])
    assert answer.timings_ms["gather"] < 1000


async def test_an_ego_that_hangs_up_is_not_waited_for(messages):
    """Its next request would wait behind it for all of the time."""
    async with serve() as served:
        session = await served.open(gather_ms=15_000)
        gone, sent = asyncio.Event(), []
        first = asyncio.create_task(post_until(gone, served, session, wire.pack_message(0, EGO, messages[EGO]), sent))
        for name in TEAM[1:]:
            await served.teammate(session, name).send(0, messages[name])
        await asyncio.sleep(0.1)
        assert not first.done()
        gone.set()
        await first
        assert sent[0]["status"] == 400
        assert b"problem:hung-up" in sent[1]["body"]
        await served.teammate(session, TEAM[0]).send(0, messages[TEAM[0]])
        again = await served.ego(session).ask(0, messages[EGO])
        assert again.timings_ms["gather"] < 5000
        assert "missing" not in {entry.reason for entry in again.rejected.values()}


async def post_until(gone, served, session, body, sent):
    """Post an ego's message as a server would that hears of hanging up; what is answered is put into ``sent``."""
    told = iter([{"type": "http.request", "body": body, "more_body": False}])
    headers = {"host": "gateway", **MSGPACK, "authorization": f"Bearer {session.ego_token}"}
    scope = {
        "type": "http",
        "http_version": "1.1",
        "method": "POST",
        "scheme": "http",
        "path": f"/v1/sessions/{session.session_id}/messages",
        "query_string": b"",
        "headers": [(name.lower().encode(), value.encode()) for name, value in headers.items()],
        "client": ("127.0.0.1", 1),
        "server": ("gateway", 80),
    }

    async def receive():
        if (message := next(told, None)) is None:
            await gone.wait()
            return {"type": "http.disconnect"}
        return message

    async def send(message):
        sent.append(message)

    await served.http._transport.app(scope, receive, send)


async def test_missing_teammates_are_waited_for_and_then_left_out(served, messages):
    session = await served.open(gather_ms=60)
    for name in ("car-2", "car-3"):
        await served.teammate(session, name).send(0, messages[name])
    answer = await served.ego(session).ask(0, messages[EGO])
    assert answer.timings_ms["receive"] + answer.timings_ms["gather"] >= 50
    assert [answer.rejected[name].reason for name in ("car-4", "car-5", "rsu")] == ["missing"] * 3
    assert set(answer.accepted) <= {"car-2", "car-3"}


async def test_with_nobody_there_the_ego_answers_alone(served, messages):
    session = await served.open(gather_ms=0)
    answer = await served.ego(session).ask(0, messages[EGO])
    assert (answer.source, answer.accepted, answer.sampling_steps) == ("ego_only", (), 0)
    assert len(answer.boxes)
    assert set(answer.rejected) == set(TEAM)


async def test_messages_may_come_some_frames_ahead_but_only_so_many(messages):
    async with serve(max_pending_frames=2) as served:
        session = await served.open(gather_ms=20)
        token = session.teammate_tokens["car-2"]

        async def post(frame):
            return await served.post(session, "messages", wire.pack_message(frame, "car-2", messages["car-2"]), token)

        for frame in (0, 1, 2):
            assert (await post(frame)).status_code == 202
        problem(await post(3), 409, "too-far-ahead")
        for frame in (0, 1, 2):
            assert "car-2" in (await served.ego(session).ask(frame, messages[EGO])).accepted


async def test_absurd_frame_numbers_do_not_lock_their_sender_out(messages):
    async with serve(max_pending_frames=2) as served:
        session = await served.open(gather_ms=20)
        teammate = served.teammate(session, "car-2")
        for frame in (10**6, 10**6 + 1, 10**6 + 2):
            await teammate.send(frame, messages["car-2"])
        for frame in range(4):
            await teammate.send(frame, messages["car-2"])
            assert "car-2" in (await served.ego(session).ask(frame, messages[EGO])).accepted


async def test_a_refused_message_counts_for_its_own_frame(served, messages):
    session = await served.open(gather_ms=20)
    ego, token = served.ego(session), session.teammate_tokens["rsu"]
    await served.teammate(session, "rsu").send(0, messages["rsu"])
    early = msgpack.unpackb(wire.pack_message(2, "rsu", messages["rsu"]))
    early["pose"] = [0.0] * 16
    problem(await served.post(session, "messages", msgpack.packb(early), token), 422, "bad-pose")
    assert (await ego.ask(0, messages[EGO])).accepted == ("rsu",)
    assert (await ego.ask(1, messages[EGO])).rejected["rsu"].reason == "missing"
    assert (await ego.ask(2, messages[EGO])).rejected["rsu"].reason == "malformed"
    assert (await ego.ask(3, messages[EGO])).rejected["rsu"].reason == "missing"


async def test_a_message_for_a_session_that_ends_meanwhile_is_not_accepted(served, messages):
    session = await served.open()

    async def body():
        await served.ego(session).close()
        yield wire.pack_message(0, "rsu", messages["rsu"])

    problem(await served.post(session, "messages", body(), session.teammate_tokens["rsu"]), 404, "unknown-session")


async def test_late_stale_and_second_messages_are_refused_and_named(served, messages):
    session = await served.open(gather_ms=20)
    ego, teammate = served.ego(session), served.teammate(session, "car-2")

    def body(frame):
        return wire.pack_message(frame, "car-2", messages["car-2"])

    async def post(frame):
        return await served.post(session, "messages", body(frame), session.teammate_tokens["car-2"])

    await teammate.send(5, messages["car-2"])
    problem(await post(5), 409, "duplicate-message")
    assert (await ego.ask(5, messages[EGO])).accepted == ("car-2",)
    problem(await post(5), 409, "duplicate-message")
    assert (await ego.ask(6, messages[EGO])).rejected["car-2"].reason == "replayed"
    problem(await post(6), 409, "stale-frame")
    assert (await ego.ask(7, messages[EGO])).rejected["car-2"].reason == "late"
    problem(await post(3), 409, "stale-frame")
    assert (await ego.ask(8, messages[EGO])).rejected["car-2"].reason == "stale"
    assert (await ego.ask(9, messages[EGO])).rejected["car-2"].reason == "missing"
    refused = [r["reason"] for r in await ego.audit() if r["event"] == "message_refused"]
    assert refused == ["replayed", "replayed", "late", "stale"]


async def test_while_teammates_are_waited_for_the_ego_sees_alone_and_what_is_there_is_read(messages):
    async with serve(seeds=itertools.repeat(7)) as served:
        at_once = await served.open()
        whole = await served.ego(at_once).post_frame(0, messages[EGO], {name: messages[name] for name in TEAM})
        session = await served.open(gather_ms=20_000)
        asking = asyncio.create_task(served.ego(session).ask(0, messages[EGO]))
        for name in TEAM[:-1]:
            await served.teammate(session, name).send(0, messages[name])
        for _ in range(3):  # pieces of work are done in turn: once this one is, those of the messages above are
            done = threading.Event()
            served.gateway.engine.when_idle(done.set)
            await asyncio.to_thread(done.wait)
        await served.teammate(session, TEAM[-1]).send(0, messages[TEAM[-1]])
        answer = await asking
        assert (answer.accepted, answer.suspicion) == (whole.accepted, whole.suspicion)
        np.testing.assert_array_equal(answer.boxes, whole.boxes)
        assert answer.timings_ms["ahead"] > 0
        assert "ahead" not in whole.timings_ms
        assert answer.timings_ms["ego_only"] < 0.2 * whole.timings_ms["ego_only"]
        assert answer.timings_ms["testimony"] < whole.timings_ms["testimony"]
