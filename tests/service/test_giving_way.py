"""Requests other than vehicles' frames and messages are let in by turns."""

import asyncio
import contextlib
import time

import pytest
from starlette.responses import PlainTextResponse, StreamingResponse

from robosac import wire
from service.arriving.giving_way import AT_A_TIME, EVERY_S, GivesWay, Line
from service.arriving.parties import Parties
from tests.service.conftest import EGO, serve
from tests.service.credentials import KEY, OTHER_KEY, SECRET, forged, segment


class Frames:
    """Whether frames are in hand, as a test has it."""

    in_hand = False

    def __call__(self):
        return self.in_hand


class Requests:
    """Requests through the middleware, each answered once it is let."""

    def __init__(self, line, app=None):
        self.begun = []
        self.let = asyncio.Event()
        self._app = GivesWay(app or self._answer, line, lambda scope: scope["party"], lambda _, sid: sid == "own")

    async def _answer(self, scope, receive, send):
        self.begun.append(scope["path"])
        await self.let.wait()
        await PlainTextResponse("done")(scope, receive, send)

    def ask(self, path, party="", member="", send=None, **more):
        scope = {"type": "http", "method": "GET", "path": path, "headers": [], "party": (party, member), **more}
        return asyncio.create_task(self._app(scope, self._receive, send or self._drop))

    async def _receive(self):
        await asyncio.Event().wait()

    async def _drop(self, message):
        pass


def parties_of(gateway):
    return Parties(gateway.api_keys, gateway.viewer_tokens, gateway.store.seen, gateway.sessions.tokens.signed)


async def settled():
    for _ in range(10):
        await asyncio.sleep(0)


async def test_few_requests_are_answered_at_a_time_and_parties_take_turns():
    requests = Requests(Line(Frames()))
    asked = [requests.ask(f"/greedy/{number}", "greedy") for number in range(20)]
    asked += [requests.ask("/modest", "modest"), requests.ask("/stranger")]
    await settled()
    assert requests.begun == ["/greedy/0", "/greedy/1"][:AT_A_TIME]
    requests.let.set()
    await asyncio.gather(*asked)
    assert {"/modest", "/stranger"} <= set(requests.begun[: AT_A_TIME + 4])
    assert len(requests.begun) == 22


async def test_the_members_of_a_party_take_turns_within_those_of_the_party():
    requests = Requests(Line(Frames()))
    asked = [requests.ask(f"/{number}/{member}", "large", f"{member}") for member in range(4) for number in range(3)]
    asked += [requests.ask("/alone", "small"), requests.ask("/alone", "small")]
    await settled()
    requests.let.set()
    await asyncio.gather(*asked)
    large = [path for path in requests.begun if path != "/alone"][AT_A_TIME:]
    assert {path[-1] for path in large[:4]} == {"0", "1", "2", "3"}
    assert requests.begun[: AT_A_TIME + 4].count("/alone") == 2


async def test_only_credentials_that_count_make_a_party():
    async with serve(
        api_key=KEY, api_keys=f"{KEY},{OTHER_KEY}", viewer_tokens="v" * 20, token_secrets=SECRET
    ) as served:
        gateway, session, other = served.gateway, await served.open(), await served.open()
        parties = parties_of(gateway)

        def party(credential, address="192.0.2.1", scheme="Bearer"):
            headers = [(b"authorization", f"{scheme} {credential}".encode("latin-1"))] if credential else []
            return parties({"type": "http", "headers": headers, "client": (address, 1)})

        made_up = [None, "x", KEY[:-1], forged(session.ego_token, jti="0" * 32), forged(session.ego_token, sid="x")]
        made_up += [*(f"{n}" * 16 for n in range(9)), "a.b.c", "..", "\xff.\xff.\xff", "x" * 5000]
        made_up += [f"a.{segment(b'[' * 2500)}.c", f"a.{segment(b'[]')}.c", forged(session.ego_token, sid=[1])]
        assert {party(credential) for credential in made_up} == {party(None)}
        assert party(None) != party(None, "192.0.2.2")
        tokens = [session.ego_token, *session.teammate_tokens.values(), other.ego_token]
        assert {party(token)[0] for token in tokens} == {party(KEY)[0]}
        assert len({party(token) for token in [*tokens, KEY]}) == len(tokens) + 1
        assert party(tokens[0], scheme="DPoP") == party(tokens[0])
        assert len({party(credential)[0] for credential in (None, KEY, OTHER_KEY, "v" * 20)}) == 4
        request = {"headers": [(b"authorization", f"Bearer {session.ego_token}".encode())]}
        assert parties.is_vehicle(request, session.session_id)
        assert not parties.is_vehicle(request, other.session_id)
        gateway.store._seen.forget(session.session_id)
        assert parties.is_vehicle(request, session.session_id)
        assert not parties.is_vehicle(request, other.session_id)
        renewed = await served.teammate(session, "rsu").renew()
        assert party(session.teammate_tokens["rsu"]) == party(None)
        assert party(renewed.token)[0] == party(KEY)[0]


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ("2001:db8::1", "2001:db8::ffff:2", True),  # of one network, as whoever has one address has all of it
        ("2001:db8::1", "2001:db8:0:1::1", False),
        ("::ffff:192.0.2.1", "192.0.2.1", True),
        ("::ffff:192.0.2.1", "::ffff:192.0.2.2", False),
        ("192.0.2.1", "192.0.2.2", False),
        ("fe80::1%eth0", "fe80::2%eth0", True),
        ("no:address", "no:other", False),
    ],
)
async def test_strangers_are_told_apart_by_what_nobody_has_many_of(one, other, same):
    async with serve(api_keys=KEY) as served:
        parties = parties_of(served.gateway)
        first, second = (parties({"type": "http", "headers": [], "client": (address, 1)}) for address in (one, other))
        assert (first == second) is same


@pytest.mark.parametrize(
    ("path", "waits"),
    [
        ("/healthz", False),
        ("/v1/sessions/own/frames", False),
        ("/v1/sessions/own/messages", False),
        ("/v1/sessions/own/standby", False),
        ("/v1/live/abc", False),
        ("/v1/sessions/own", True),
        ("/v1/sessions/another/frames", True),
        ("/v1/sessions/another/messages", True),
        ("/v1/sessions/another/standby", True),
    ],
)
async def test_frames_of_vehicles_and_what_lasts_wait_for_nobody(path, waits):
    requests, frames = Requests(line := Line(Frames())), Frames()
    others = [requests.ask("/slow") for _ in range(5)]
    await settled()
    line._busy, frames.in_hand = frames, True
    asked = requests.ask(path)
    await settled()
    assert (path in requests.begun) is not waits
    line._busy.in_hand = False
    requests.let.set()
    await asyncio.gather(asked, *others)


async def test_while_frames_are_in_hand_requests_begin_seldom_but_do():
    frames = Frames()
    requests = Requests(Line(frames))
    requests.let.set()
    frames.in_hand = True
    loop = asyncio.get_running_loop()
    began = loop.time()
    await asyncio.gather(*(requests.ask("/page") for _ in range(5)))
    assert loop.time() - began >= 4 * EVERY_S
    late = [requests.ask("/page") for _ in range(50)]
    await settled()
    frames.in_hand = False
    await asyncio.wait_for(asyncio.gather(*late), 25 * EVERY_S)


async def test_who_waits_for_its_client_holds_up_nobody_for_long():
    requests = Requests(Line(Frames(), turn_s=0.05))
    asked = [requests.ask(f"/slow/{number}") for number in range(3 * AT_A_TIME)]
    await asyncio.sleep(0.2)
    assert len(requests.begun) == 3 * AT_A_TIME
    requests.let.set()
    await asyncio.gather(*asked)


async def test_who_goes_away_leaves_its_place():
    requests = Requests(line := Line(Frames()))
    asked = [requests.ask(f"/page/{number}") for number in range(AT_A_TIME + 2)]
    await settled()
    for gone in (asked[0], asked[-1]):
        gone.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await gone
    await settled()
    assert requests.begun == [f"/page/{number}" for number in range(AT_A_TIME + 1)]
    requests.let.set()
    await asyncio.gather(*asked[1:-1])
    assert not line._waiting
    assert line._at_work == 0


async def test_an_answer_in_parts_gives_way_after_each():
    async def parts():
        for _ in range(3):
            yield b"part"

    reading = asyncio.Event()

    async def unread(message):
        if message.get("body") == b"part":
            await reading.wait()

    async def streaming(scope, receive, send):
        if scope["path"] == "/log":
            await StreamingResponse(parts())({**scope, "asgi": {"spec_version": "2.4"}}, receive, send)
        else:
            requests.begun.append(scope["path"])
            await PlainTextResponse("done")(scope, receive, send)

    requests = Requests(Line(Frames()), streaming)
    logs = [requests.ask("/log", send=unread) for _ in range(2 * AT_A_TIME)]
    await settled()
    await asyncio.wait_for(requests.ask("/page"), 1)
    reading.set()
    await asyncio.gather(*logs)


async def test_strangers_with_frames_and_messages_wait_as_others_do_and_vehicles_do_not(messages):
    async with serve(token_secrets=SECRET) as served:
        session, other = await served.open(), await served.open()
        made_up = forged(session.ego_token, "z" * 32, jti="0" * 32)
        strange = ["x", made_up, forged(session.ego_token, sid="x"), other.ego_token]
        with served.gateway.admission.frame("", "another", 1e9, 1.0):
            began = time.monotonic()
            for what in ("messages", "frames"):
                posts = [served.post(session, what, b"x", credential) for credential in strange]
                assert [answer.status_code for answer in await asyncio.gather(*posts)] == [401] * len(strange)
            assert time.monotonic() - began >= 6 * EVERY_S
            began = time.monotonic()
            body = wire.pack_message(0, "rsu", messages["rsu"])
            for status in (202, *[409] * 12):
                answer = await served.post(session, "messages", body, session.teammate_tokens["rsu"])
                assert answer.status_code == status
            assert time.monotonic() - began < 12 * EVERY_S


async def test_a_gateway_answers_pages_while_frames_are_in_hand(messages, benign):
    async with serve() as served:
        session = await served.open(latency_budget_ms=2000.0, gather_ms=0)
        ego = served.ego(session)
        with served.gateway.admission.frame("", "another", 1e9, 1.0):
            answer = await ego.post_frame(0, messages[EGO], benign)
            began = time.monotonic()
            answers = await asyncio.gather(*(served.http.get("/v1/keys") for _ in range(8)))
            assert time.monotonic() - began >= 6 * EVERY_S
        assert [page.status_code for page in answers] == [200] * 8
        assert answer.source == "consensus"
