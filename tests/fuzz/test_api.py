"""Whatever is asked of a running gateway, it answers, refuses with a reason, forgets, and serves the others."""

import os
import socket
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import httpx
import numpy as np
import pytest
import requests
import schemathesis
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from schemathesis import GenerationMode

from robosac import wire

CASES = int(os.environ.get("ROBOSAC_FUZZ_CASES", "400"))
MSGPACK = {"Content-Type": "application/vnd.msgpack", "Accept": "application/json"}
GROWTH_BYTES = 48 * 2**20
fuzzed = settings(
    max_examples=max(CASES // 20, 20), deadline=None, suppress_health_check=list(HealthCheck), database=None
)


class Gateway:
    """A gateway in a process of its own, with a session that must not be disturbed and one for the fuzzing."""

    def __init__(self, url: str, pid: int, ego, benign) -> None:
        self.http = httpx.Client(base_url=url, timeout=60, trust_env=False)
        self.session = requests.Session()
        self.pid = pid
        self.url = url
        self._ego, self._benign = ego, benign
        self._frame = 0
        self.honest, self.target = self._open(), self._open()

    def _open(self):
        body = {"ego_id": "car-1", "teammates": sorted(self._benign), "defense": {"kind": "none"}}
        return self.http.post("/v1/sessions", json=body | {"latency_budget_ms": 20_000, "gather_ms": 0}).json()

    def serves_the_honest(self):
        """The honest session gets its answer."""
        self._frame += 1
        body = wire.pack_frame(self._frame, self._ego, self._benign)
        headers = MSGPACK | {"Authorization": f"Bearer {self.honest['ego_token']}"}
        answer = self.http.post(f"/v1/sessions/{self.honest['session_id']}/frames", content=body, headers=headers)
        assert answer.status_code == 200, answer.text
        assert answer.json()["accepted"] == sorted(self._benign)
        return np.array(answer.json()["boxes"])

    def resident(self) -> int:
        """Bytes of the process in memory."""
        return int(Path(f"/proc/{self.pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.fixture(scope="module")
def gateway(request, tmp_path_factory):
    ego, benign = request.getfixturevalue("ego_message"), request.getfixturevalue("benign")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    folder = tmp_path_factory.mktemp("gateway")
    command = [sys.executable, "-m", "uvicorn", "service.app:app", "--port", str(port), "--no-access-log"]
    environment = os.environ | {"ROBOSAC_MAX_SESSIONS": "64", "PYTHONPATH": str(Path(__file__).parents[2])}
    with (folder / "log").open("wb") as log:
        process = subprocess.Popen(command, cwd=folder, env=environment, stdout=log, stderr=log)
        try:
            url = f"http://127.0.0.1:{port}"
            end = time.monotonic() + 120
            while not _ready(url):
                assert process.poll() is None, (folder / "log").read_text()
                assert time.monotonic() < end, "not ready in time"
                time.sleep(0.2)
            gateway = Gateway(url, process.pid, ego, benign)
            with closing(gateway.http), gateway.session:
                yield gateway
        finally:
            process.terminate()
            process.wait(20)
    assert "Traceback" not in (folder / "log").read_text()


def _ready(url: str) -> bool:
    try:
        return httpx.get(f"{url}/readyz", trust_env=False).status_code == 200
    except httpx.TransportError:
        return False


def check(response) -> None:
    """No failure inside, and a reason for every refusal."""
    assert response.status_code < 500 or response.status_code == 503, response.text
    if response.status_code < 400:
        return
    headers = {name.lower(): str(value) for name, value in response.headers.items()}
    assert "application/problem+json" in headers["content-type"], response.text
    problem = response.json()
    assert problem["type"].startswith("urn:robosac:problem:")
    assert problem["status"] == response.status_code
    assert problem["title"]
    assert problem["detail"]
    if problem["type"].endswith(":invalid-request"):
        assert problem["field"], response.text
    if response.status_code == 503:
        assert headers["retry-after"]


OPERATIONS = [
    ("POST", "/v1/sessions"),
    ("GET", "/v1/sessions/{sid}"),
    ("POST", "/v1/sessions/{sid}/teammates"),
    ("DELETE", "/v1/sessions/{sid}/teammates/{vehicle_id}"),
    ("GET", "/v1/sessions/{sid}/audit"),
    ("GET", "/v1/sessions/{sid}/frames/{frame}/messages"),
]


@pytest.mark.parametrize("mode", list(GenerationMode), ids=lambda mode: mode.value)
@pytest.mark.parametrize(("method", "path"), OPERATIONS, ids=lambda value: value)
def test_requests_by_and_against_the_description(gateway, method, path, mode):
    operation = schemathesis.openapi.from_url(f"{gateway.url}/openapi.json")[path][method]
    token = {"Authorization": f"Bearer {gateway.target['ego_token']}"}
    pinned = {"sid": gateway.target["session_id"]} if "{sid}" in path else None
    before = gateway.serves_the_honest()

    @fuzzed
    @given(case=operation.as_strategy(mode, path_parameters=pinned), with_token=st.booleans())
    def run(case, with_token):
        check(case.call(gateway.url, session=gateway.session, headers=token if with_token else None))

    run()
    np.testing.assert_array_equal(gateway.serves_the_honest(), before)


@pytest.mark.parametrize("call", ["messages", "frames"])
def test_bodies_of_every_kind(gateway, call, ego_message, benign):
    teammate = gateway.target["teammate_tokens"]["rsu"] if call == "messages" else gateway.target["ego_token"]
    headers = MSGPACK | {"Authorization": f"Bearer {teammate}"}
    path = f"/v1/sessions/{gateway.target['session_id']}/{call}"
    before = gateway.serves_the_honest()

    def body(frame):
        if call == "messages":
            return wire.pack_message(frame, "rsu", benign["rsu"])
        return wire.pack_frame(frame, ego_message, {"rsu": benign["rsu"]})

    @settings(fuzzed, max_examples=max(CASES // 5, 50))
    @given(
        st.integers(0, 2**53),
        st.lists(st.tuples(st.integers(0, 400), st.integers(0, 255)), max_size=4),
        st.one_of(st.just(0), st.integers(0, 400), st.integers(0, 200_000)),
        st.one_of(st.just(b""), st.binary(max_size=20)),
    )
    def run(frame, changes, cut, tail):
        changed = bytearray(body(frame))
        for place, value in changes:
            changed[place] = value
        check(gateway.http.post(path, content=bytes(changed[: len(changed) - cut]) + tail, headers=headers))

    run()
    np.testing.assert_array_equal(gateway.serves_the_honest(), before)


def test_nothing_piles_up(gateway, benign):
    """Memory after the second half of many requests of every kind is what it was after the first."""
    token = gateway.target["teammate_tokens"]["rsu"]
    path = f"/v1/sessions/{gateway.target['session_id']}"
    body = wire.pack_message(2**52, "rsu", benign["rsu"])
    resident = []
    for _ in range(2):
        for number in range(max(CASES // 8, 50)):
            headers = MSGPACK | {"Authorization": f"Bearer {token}"}
            check(gateway.http.post(f"{path}/messages", content=body[: -1 - number % 50], headers=headers))
            check(gateway.http.post(f"{path}/frames", content=body, headers=headers))
            check(gateway.http.get(path, headers={"Authorization": "Bearer x" + "y" * number}))
            check(gateway.http.post("/v1/sessions", json={"ego_id": f"car-{number}", "teammates": [str(number)]}))
        resident.append(gateway.resident())
    assert resident[1] - resident[0] < GROWTH_BYTES
    gateway.serves_the_honest()
