"""What was on its way when its vehicle left, joined again, or took another token."""

import asyncio
import contextlib
import json

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from robosac import audit, wire
from robosac.signatures import show_public_key, sign
from tests.service.conftest import EGO, HOOKED, TEAM, problem, serve

KEY, OTHER_KEY = (Ed25519PrivateKey.from_private_bytes(bytes([number]) * 32) for number in (1, 2))
NONE = {"kind": "none"}


@contextlib.asynccontextmanager
async def on_the_way(served, session, what, body, token, media_type=None):
    """A request whose body comes to its end after the block only; gives what will hold the response."""
    begun, go_on, answer = asyncio.Event(), asyncio.Event(), []

    async def slowly():
        yield body[:10]
        begun.set()
        await go_on.wait()
        yield body[10:]

    headers = {"Content-Length": str(len(body)), **({"Content-Type": media_type} if media_type else {})}
    post = asyncio.create_task(served.post(session, what, slowly(), token, **headers))
    await begun.wait()
    yield answer
    go_on.set()
    answer.append(await post)


async def faults(ego):
    return audit.verify([line.encode() for line in await ego.audit_lines()])


def signed(key, session, frame, name, message):
    return sign(key, session.session_id, name, frame, wire.content_digest(frame, name, message))


@pytest.mark.parametrize("key", [None, KEY])
async def test_a_message_on_its_way_does_not_count_for_whoever_joins_by_its_name(key, served, messages):
    session = await served.open(gather_ms=20, defense=NONE)
    ego, body = served.ego(session), wire.pack_message(0, "rsu", messages["rsu"])
    async with on_the_way(served, session, "messages", body, session.teammate_tokens["rsu"]) as answer:
        await ego.dismiss("rsu")
        await ego.enrol(["rsu"], {"rsu": show_public_key(key)} if key else {})
    problem(answer[0], 401, "unauthenticated")
    assert (await ego.ask(0, messages[EGO])).rejected["rsu"].reason == "missing"
    assert await faults(ego) == []


async def test_a_message_on_its_way_does_not_count_once_its_token_is_renewed(served, messages):
    session = await served.open(gather_ms=20, defense=NONE)
    body = wire.pack_message(0, "rsu", messages["rsu"])
    async with on_the_way(served, session, "messages", body, session.teammate_tokens["rsu"]) as answer:
        renewed = await served.teammate(session, "rsu").renew()
    problem(answer[0], 401, "unauthenticated")
    await served.client.vehicle(session.session_id, "rsu", renewed.token).send(0, messages["rsu"])


async def test_nobody_joins_by_a_token_that_was_renewed_meanwhile(served):
    session = await served.open()
    body = json.dumps({"teammates": ["friend"]}).encode()
    async with on_the_way(served, session, "teammates", body, session.ego_token, "application/json") as answer:
        renewed = await served.ego(session).renew()
    problem(answer[0], 401, "unauthenticated")
    state = await served.client.vehicle(session.session_id, EGO, renewed.token).state()
    assert state["teammates"] == list(TEAM)


async def test_a_part_of_a_frame_that_was_checked_by_a_key_of_before_is_left_out(messages, benign):
    async with serve(extra_detectors=HOOKED) as served:
        session = await served.open(defense=NONE)
        ego = served.ego(session)
        loop = asyncio.get_running_loop()
        lock = served.gateway.sessions.in_use(session.session_id).lock
        await lock.acquire()  # as while the frame before is answered
        changes = []
        for change in (ego.dismiss("rsu"), ego.enrol(["rsu"], {"rsu": show_public_key(KEY)})):
            changes.append(loop.create_task(change))
            await asyncio.sleep(0.1)
        post = loop.create_task(ego.post_frame(0, messages[EGO], benign))
        await asyncio.sleep(0.3)
        lock.release()
        answer = await post
        await asyncio.gather(*changes)
        assert set(answer.accepted) == {*TEAM} - {"rsu"}
        assert answer.rejected["rsu"].reason == "unauthenticated"
        assert await faults(ego) == []


async def test_what_waits_at_one_gateway_does_not_count_for_whoever_joins_at_another(tmp_path, messages):
    where = {"database_url": f"sqlite:///{tmp_path}/robosac.db"}
    async with serve(**where) as one, serve(**where) as other:
        keys = {"rsu": show_public_key(KEY)}
        session = await one.client.open_session(EGO, TEAM, defense=NONE, gather_ms=20, public_keys=keys)
        body = wire.pack_message(0, "rsu", messages["rsu"], signed(KEY, session, 0, "rsu", messages["rsu"]))
        assert (await one.post(session, "messages", body, session.teammate_tokens["rsu"])).status_code == 202
        ego = other.ego(session)
        await ego.dismiss("rsu")
        await ego.enrol(["rsu"], {"rsu": show_public_key(OTHER_KEY)})
        assert (await one.ego(session).ask(0, messages[EGO])).rejected["rsu"].reason == "missing"
        assert await faults(ego) == []


@contextlib.asynccontextmanager
async def two_gateways(tmp_path):
    """Of one database, and a session in which rsu signs."""
    where = {"database_url": f"sqlite:///{tmp_path}/robosac.db", "extra_detectors": HOOKED}
    async with serve(**where) as one, serve(**where) as other:
        keys = {"rsu": show_public_key(KEY)}
        yield one, other, await one.client.open_session(EGO, TEAM, defense=NONE, gather_ms=20, public_keys=keys)


@pytest.mark.parametrize("back", [True, False])
@pytest.mark.parametrize("second", ["another", "junk"])
async def test_who_left_at_another_gateway_puts_nothing_on_record(tmp_path, messages, back, second):
    async with two_gateways(tmp_path) as (one, other, session):
        said = [
            wire.pack_message(0, "rsu", message, signed(KEY, session, 0, "rsu", message))
            for message in (messages["rsu"], messages["car-2"])
        ]
        token, ego = session.teammate_tokens["rsu"], one.ego(session)
        assert (await one.post(session, "messages", said[0], token)).status_code == 202
        body = said[1] if second == "another" else b"junk" * 10
        async with on_the_way(one, session, "messages", body, token):
            await other.ego(session).dismiss("rsu")
            if back:
                await other.ego(session).enrol(["rsu"], {"rsu": show_public_key(OTHER_KEY)})
        assert [record["event"] for record in await ego.audit()] == ["session_opened"] + ["team_changed"] * (1 + back)
        await ego.ask(0, messages[EGO])
        assert (await ego.audit())[-1]["unlogged_refusals"] == {"?": 1}
        assert await faults(ego) == []


async def test_an_ego_whose_token_was_renewed_at_another_gateway_puts_nothing_on_record(tmp_path, messages, benign):
    async with two_gateways(tmp_path) as (one, other, session):
        benign = {name: message for name, message in benign.items() if name != "rsu"}
        await one.ego(session).post_frame(0, messages[EGO], benign)
        body = wire.pack_frame(0, messages["car-2"], benign)
        async with on_the_way(one, session, "frames", body, session.ego_token):
            renewed = await other.ego(session).renew()
        ego = other.client.vehicle(session.session_id, EGO, renewed.token)
        events = [record["event"] for record in await ego.audit()]
        assert events == ["session_opened", "frame_answered", "token_renewed"]


async def test_a_message_in_hand_does_not_count_by_a_key_that_was_replaced_at_another_gateway(tmp_path, messages):
    async with two_gateways(tmp_path) as (one, other, session):
        loop, changes = asyncio.get_running_loop(), [None]

        async def join_again():
            await other.ego(session).dismiss("rsu")
            await other.ego(session).enrol(["rsu"], {"rsu": show_public_key(OTHER_KEY)})

        def change(*_):
            if changes.pop() is None:
                asyncio.run_coroutine_threadsafe(join_again(), loop).result()

        body = wire.pack_message(0, "rsu", messages["rsu"], signed(KEY, session, 0, "rsu", messages["rsu"]))
        await one.post(session, "messages", body, session.teammate_tokens["rsu"])
        await one.teammate(session, "car-2").send(0, messages["car-2"])
        one.detector.before_prepare = lambda *_: change() if changes else None
        answer = await one.ego(session).ask(0, messages[EGO])
        assert (changes, answer.accepted, answer.rejected["rsu"].reason) == ([], ("car-2",), "unauthenticated")
        assert await faults(one.ego(session)) == []


async def test_nothing_is_remembered_of_where_those_were_who_left(served, messages, benign):
    session = await served.open(defense=NONE)
    ego, live = served.ego(session), served.gateway.sessions.in_use(session.session_id)
    await ego.post_frame(0, messages[EGO], benign)
    for name in TEAM[1:]:
        await ego.dismiss(name)
    assert set(live.motion._last) == {EGO, TEAM[0]}


async def test_nothing_is_remembered_of_who_has_left(served, messages):
    session = await served.open()
    unit = served.teammate(session, "rsu")
    await unit.renew()
    await unit.send(0, messages["rsu"])
    live = (await served.gateway.sessions.authenticate(session.session_id, session.ego_token)).live
    assert "rsu" in live.renewals
    assert "rsu" in live.unread
    await served.ego(session).dismiss("rsu")
    assert "rsu" not in live.renewals
    assert "rsu" not in live.unread
