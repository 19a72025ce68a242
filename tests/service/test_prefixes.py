"""Behind a proxy that takes a prefix of the path away, which the server knows (``--root-path``) and puts before it."""

import asyncio

import httpx
import pytest

from service.arriving.doors import capacity_check
from service.arriving.giving_way import Line
from service.arriving.hanging_up import HangingUp
from service.arriving.paths import path_of
from tests.service.conftest import problem, serve
from tests.service.test_giving_way import Frames, Requests, settled

PREFIX = "/gw"


@pytest.mark.parametrize(
    ("prefix", "path", "asked"),
    [
        ("", "/healthz", "/healthz"),
        ("/gw", "/gw/healthz", "/healthz"),
        ("/gw/", "/gw/healthz", "/healthz"),
        ("/gw", "/gw/gw/healthz", "/gw/healthz"),
        ("/gw", "/healthz", "/healthz"),
        ("/gw", "/gwx/healthz", "/gwx/healthz"),
    ],
)
def test_the_prefix_is_taken_away_once(prefix, path, asked):
    assert path_of({"path": path, "root_path": prefix}) == asked


async def test_who_lives_is_told_to_everybody():
    async with serve(allowed_hosts="") as served:
        transport = httpx.ASGITransport(served.http._transport.app, root_path=PREFIX)
        async with httpx.AsyncClient(base_url=f"http://far.example{PREFIX}", transport=transport) as http:
            assert (await http.get("/healthz")).status_code == 200
            problem(await http.get("/readyz"), 421, "foreign-host")


async def test_a_frame_beyond_capacity_is_refused_from_its_head():
    asked = []
    check = capacity_check(None, asked.append)
    check({"method": "POST", "path": f"{PREFIX}/v1/sessions/abc/frames", "root_path": PREFIX})
    assert asked == ["abc"]


async def test_frames_of_a_vehicle_wait_for_nobody():
    requests, frames = Requests(line := Line(Frames())), Frames()
    others = [requests.ask("/slow") for _ in range(5)]
    await settled()
    line._busy, frames.in_hand = frames, True
    asked = requests.ask(path := f"{PREFIX}/v1/sessions/own/frames", root_path=PREFIX)
    await settled()
    assert path in requests.begun
    requests.let.set()
    await asyncio.gather(asked, *others)


async def test_a_viewer_who_takes_nothing_is_hung_up_on():
    async def endless(scope, receive, send):
        while True:
            await send({"type": "http.response.body", "body": b"x", "more_body": True})

    async def stuck(_):
        await asyncio.sleep(60)

    async with asyncio.timeout(10):
        scope = {"type": "http", "path": f"{PREFIX}/v1/live/s", "root_path": PREFIX}
        await HangingUp(endless, 0.05)(scope, None, stuck)
