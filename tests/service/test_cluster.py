"""Replicas on Ray Serve, really running, with PostgreSQL."""

import asyncio
import contextlib
import os
import signal
import subprocess
import sys
import time
from functools import partial
from importlib.util import find_spec

import httpx
import pytest
from starlette.responses import PlainTextResponse

from clients.client import GatewayClient
from clients.continuity import Traffic, affinity, prepare
from clients.load_test import DEFENSE
from clients.local_gateway import free_port
from service.arriving.doors import Door
from service.cluster import check_routed
from tests.service.conftest import answered_since, problem
from tests.service.store.conftest import postgres  # noqa: F401 (a fixture)

START_S = 240.0
SERVE = "import typer; from service.command import main; typer.run(main)"


async def test_what_the_router_cannot_see_is_refused():
    app = Door(PlainTextResponse("here"), check=check_routed)
    async with httpx.AsyncClient(base_url="http://gateway", transport=httpx.ASGITransport(app)) as http:
        for path in ("/v1/sessions/ab", "/v1/sessions/ab/messages", "/v1/live/ab"):
            for headers in ({}, {"X-Session-Id": "cd"}):
                problem(await http.get(path, headers=headers), 421, "misrouted")
            assert (await http.get(path, headers={"X-Session-Id": "ab"})).text == "here"
        for path in ("/v1/sessions", "/v1/live", "/readyz"):
            assert (await http.get(path)).text == "here"


@contextlib.asynccontextmanager
async def served(url, tmp_path):
    """A cluster of two replicas on this machine; the process that runs it, and what makes a client."""
    port, log = free_port(), tmp_path / "log"
    command = [sys.executable, "-c", SERVE, "--cluster", "--replicas", "2", "--port", str(port)]
    environment = os.environ | {"ROBOSAC_DATABASE_URL": url}
    with log.open("wb") as out:
        process = subprocess.Popen(command, env=environment, stdout=out, stderr=out)
    try:
        end = time.monotonic() + START_S
        while b"version 0 at" not in log.read_bytes():
            assert process.poll() is None, log.read_text()
            assert time.monotonic() < end, log.read_text()
            await asyncio.sleep(0.2)
        yield process, partial(GatewayClient, f"http://127.0.0.1:{port}")
    finally:
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 0


@pytest.mark.skipif(find_spec("ray") is None, reason="Ray is not installed")
async def test_sessions_go_on_when_a_replica_is_killed_and_the_database_restarted(postgres, tmp_path):  # noqa: F811
    async with served(await postgres.new_database(), tmp_path) as (_, connect), connect() as client:
        traffic = Traffic(connect, prepare(2), rate_hz=2.0, budget_ms=20_000.0)
        await traffic.open(4, DEFENSE)
        traffic.begin("both")
        await answered_since(traffic, 2)
        ego = traffic.sessions[0].ego(client)
        writers = [record["gateway"] for record in await ego.audit() if record["event"] == "frame_answered"]
        assert len(set(writers)) == 1
        traffic.begin("kill")
        os.kill(int(writers[0].split("-")[-2]), signal.SIGKILL)
        await answered_since(traffic, 2)
        traffic.begin("database")
        await asyncio.to_thread(postgres.stop)
        await asyncio.to_thread(postgres.start)
        await answered_since(traffic, 2)
        await traffic.stop()
        wrong, writers = await traffic.check()
    assert wrong == []
    assert affinity(writers, moves=2) == []
    assert len(writers[0]) >= 2
    assert all(phase.answered for phase in traffic.phases)
