"""Bodies that do not come to their end keep nobody from being answered."""

import asyncio
import contextlib

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from robosac import wire
from robosac.signatures import show_public_key
from service.arriving.limits import Unfinished
from service.deciding.admission import SESSION_FRAMES
from service.errors import Kind, Refused
from service.sessions.unread import BODIES
from tests.service.conftest import EGO, problem, serve


@contextlib.asynccontextmanager
async def stalled(served, session, number, what="messages", token=None):
    """Requests in the name of the ego whose bodies never come to their end; gives their tasks."""

    async def body():
        yield b"x"
        await asyncio.sleep(3600.0)

    tasks = [asyncio.create_task(served.post(session, what, body(), token)) for _ in range(number)]
    async with asyncio.timeout(30.0):
        while sum(task.done() for task in tasks) < number - BODIES:
            await asyncio.sleep(0.02)
    await asyncio.sleep(0.2)
    yield tasks
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


@pytest.mark.parametrize("number", [SESSION_FRAMES, 3 * BODIES])
@pytest.mark.parametrize("what", ["messages", "frames"])
async def test_slow_bodies_with_its_token_keep_no_ego_from_being_answered(served, messages, benign, number, what):
    key = Ed25519PrivateKey.generate()
    session = await served.open(public_keys={EGO: show_public_key(key)}, gather_ms=0)
    ego = served.client.vehicle(session.session_id, EGO, session.ego_token, key)
    async with stalled(served, session, number, what) as thieves:
        pushed_out = [task for task in thieves if task.done()]
        assert len(pushed_out) == max(number - BODIES, 0)
        for task in pushed_out:
            problem(task.result(), 408, "slow-body")
        for frame in range(4):
            if what == "frames":
                assert (await ego.post_frame(frame, messages[EGO], benign)).frame == frame
            else:
                assert (await ego.ask(frame, messages[EGO])).frame == frame


async def test_bad_bodies_with_its_token_take_no_place_of_a_frame(served, messages):
    key = Ed25519PrivateKey.generate()
    session = await served.open(public_keys={EGO: show_public_key(key)}, gather_ms=0)
    ego = served.client.vehicle(session.session_id, EGO, session.ego_token, key)
    unsigned = wire.pack_message(0, EGO, messages[EGO])
    thieves = [asyncio.create_task(served.post(session, "messages", unsigned)) for _ in range(4 * SESSION_FRAMES)]
    assert (await ego.ask(0, messages[EGO])).frame == 0
    for refused in await asyncio.gather(*thieves):
        problem(refused, 401, "bad-signature")


async def test_a_body_that_keeps_coming_is_read_whatever_stands_still_beside_it(served, messages):
    session = await served.open(gather_ms=0)
    body = wire.pack_message(0, EGO, messages[EGO])

    async def coming():
        for at in range(0, len(body), len(body) // 30):
            yield body[at : at + len(body) // 30]
            await asyncio.sleep(0.02)

    honest = asyncio.create_task(served.post(session, "messages", coming()))
    for _ in range(3):
        async with stalled(served, session, BODIES - 1):
            pass
    assert not honest.done()
    assert (await honest).status_code == 200


async def test_slow_bodies_of_one_vehicle_push_out_none_of_another(served):
    session = await served.open()
    async with (
        stalled(served, session, 1, token=session.teammate_tokens["rsu"]) as (of_another,),
        stalled(served, session, 3 * BODIES),
    ):
        assert not of_another.done()


@pytest.mark.parametrize("what", ["messages", "frames"])
async def test_a_process_that_is_to_end_waits_for_no_body(what):
    async with serve(body_timeout_s=120) as served:
        session = await served.open(gather_ms=0)
        async with stalled(served, session, 2, what) as senders:
            served.gateway.stop()
            for refused in await asyncio.wait_for(asyncio.gather(*senders), 30):
                problem(refused, 503, "draining")


async def test_bodies_that_are_given_up_in_whatever_state_end_once():
    unfinished, ended = Unfinished(), []

    async def wait(end):
        try:
            async with unfinished.wait_until(end):
                await asyncio.sleep(3600)
        except Refused as refused:
            ended.append(refused.kind)

    now = asyncio.get_running_loop().time()
    waits = [asyncio.create_task(wait(end)) for end in (now, now + 3600)]
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    unfinished.give_up()
    await asyncio.wait_for(asyncio.gather(*waits, wait(now + 3600)), 30)
    assert ended == [Kind.DRAINING] * 3
    async with unfinished.wait_until(now + 3600):
        pass  # what is there already is taken
