"""The example of a client in another language, against a gateway that asks for a key."""

import asyncio
import os
import re
import shutil
from pathlib import Path

import pytest

from clients.local_gateway import local_gateway
from tests.service.credentials import KEY

NODE = shutil.which("node")
PROGRAM = Path(__file__).parents[2] / "examples" / "client.mjs"


async def run(url, frames="2", **environment):
    command = [NODE, PROGRAM, url, frames]
    piped = {"stdout": asyncio.subprocess.PIPE, "stderr": asyncio.subprocess.PIPE}
    process = await asyncio.create_subprocess_exec(*command, env=os.environ | environment, **piped)
    out, errors = await asyncio.wait_for(process.communicate(), 60)
    return process.returncode, out.decode(), errors.decode()


@pytest.mark.skipif(NODE is None, reason="needs node")
async def test_the_client_for_node_has_its_frames_answered(tmp_path, monkeypatch):
    monkeypatch.setenv("ROBOSAC_LATENCY_BUDGET_MS", "5000")  # the machine of the tests may be busy
    async with local_gateway(tmp_path / "gateway.log", KEY) as url:
        status, out, errors = await run(url, ROBOSAC_API_KEY=KEY)
        assert status == 0, errors
        opened, *frames = out.splitlines()
        assert re.fullmatch(r"session \w+, detector intersection-mean, defence group_testing", opened)
        told = [
            re.fullmatch(r"frame (\d): \w+, \d+ boxes, fused [\w, -]+, left out .+, [\d.]+ ms", line) for line in frames
        ]
        assert [match[1] for match in told] == ["0", "1"]
        status, out, errors = await run(url, ROBOSAC_API_KEY="")
    assert (status, out) == (1, "")
    assert "POST /v1/sessions: 401" in errors
    assert "urn:robosac:problem:" in errors
    assert len(errors.splitlines()) == 1  # the stack is the example's own, and no help


@pytest.mark.skipif(NODE is None, reason="needs node")
async def test_the_client_for_node_says_in_a_line_that_no_gateway_is_there():
    status, out, errors = await run("http://127.0.0.1:1")
    assert (status, out) == (1, "")
    assert re.fullmatch(r"fetch failed.*\n", errors)


@pytest.mark.skipif(NODE is None, reason="needs node")
@pytest.mark.parametrize("frames", ["two", "-1", "1.5", ""])
async def test_the_client_for_node_refuses_a_number_of_frames_that_is_none(frames):
    status, out, errors = await run("http://127.0.0.1:1", frames)
    assert (status, out) == (1, "")
    assert errors.strip() == f"the number of frames must be whole, not {frames}".strip()
