import asyncio
import gc
import time
from collections.abc import AsyncIterator, Callable, Iterable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Any

import httpx
import pytest
from opentelemetry.sdk.trace import TracerProvider

from clients.client import GatewayClient, OpenedSession, VehicleClient
from clients.continuity import Traffic
from robosac import wire
from robosac.detectors import Detector, EmbeddedDetector, load
from robosac.detectors.loading import warm_up
from service.app import create_app
from service.gateway import Gateway
from service.settings import Settings

EGO = "car-1"
TEAM = ("car-2", "car-3", "car-4", "car-5", "rsu")
MSGPACK = {"Content-Type": "application/vnd.msgpack"}


class Hooked(EmbeddedDetector):
    """The shipped detector in its own place, which calls a test first where the test wants it to."""

    before_info: Callable[[], object] | None = None
    before_prepare: Callable[..., object] | None = None

    @property
    def info(self):
        if self.before_info is not None:
            self.before_info()
        return self._info

    @info.setter
    def info(self, info):
        self._info = info

    def prepare(self, ego, teammates):
        if self.before_prepare is not None:
            self.before_prepare(ego, teammates)
        return super().prepare(ego, teammates)


HOOKED = "tests.service.conftest:Hooked"


@pytest.fixture(scope="package", autouse=True)
def shipped_detectors_are_ready():
    """A thousand gateways start in these tests. Those that ship are loaded, and warm, once in a process."""
    ready: dict[str, Detector] = {}

    def load_once(name, device="cpu"):
        if (name, device) != (EmbeddedDetector.name, "cpu"):
            return load(name, device)
        if name not in ready:
            ready[name] = load(name)
            warm_up(ready[name])
        return ready[name]

    def warm_up_once(detector):
        if detector is not ready.get(EmbeddedDetector.name):
            warm_up(detector)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("service.engine.load", load_once)
        patch.setattr("service.engine.warm_up", warm_up_once)
        yield


@dataclass
class Served:
    """A gateway in this process, its typed client, and raw HTTP for what the client would never send."""

    gateway: Gateway
    client: GatewayClient
    http: httpx.AsyncClient

    async def open(self, **options: Any) -> OpenedSession:
        options.setdefault("gather_ms", 2000)
        options.setdefault("latency_budget_ms", 20_000)
        return await self.client.open_session(EGO, TEAM, **options)

    @property
    def detector(self) -> Any:
        return self.gateway.engine.detectors["intersection-mean"]

    def ego(self, session: OpenedSession) -> VehicleClient:
        return self.client.vehicle(session.session_id, EGO, session.ego_token)

    def teammate(self, session: OpenedSession, name: str) -> VehicleClient:
        return self.client.vehicle(session.session_id, name, session.teammate_tokens[name])

    async def post(self, session: OpenedSession, what: str, body: bytes, token: str | None = None, **headers: str):
        bearer = {"Authorization": f"Bearer {token or session.ego_token}"}
        return await self.http.post(
            f"/v1/sessions/{session.session_id}/{what}", content=body, headers={**MSGPACK, **bearer, **headers}
        )


@asynccontextmanager
async def serve(
    seeds: Iterable[int] | None = None,
    *,
    spans: TracerProvider | None = None,
    api_key: str | None = None,
    clock: Callable[[], float] = time.time,
    **settings: Any,
) -> AsyncIterator[Served]:
    """A gateway, by default on a database in memory; ``seeds`` are those of its frames, one after another, if it is to
    be foreseen.
    """
    settings.setdefault("database_url", "sqlite://")
    settings.setdefault("allowed_hosts", "gateway")
    options: dict[str, Any] = {"spans": spans, "clock": clock}
    if seeds is not None:
        numbers = iter(seeds)
        options["seeds"] = lambda: f"{next(numbers):064x}"
    app = create_app(Settings(**settings), **options)
    transport = httpx.ASGITransport(app, raise_app_exceptions=False)
    async with (
        app.router.lifespan_context(app),
        GatewayClient("http://gateway", api_key, transport=transport) as client,
        httpx.AsyncClient(base_url="http://gateway", transport=transport) as http,
    ):
        yield Served(app.state.gateway, client, http)


@pytest.fixture(scope="module", autouse=True)
def _short_searches_for_garbage():
    """The objects of all earlier tests make a search for garbage take a second, in which no frame is answered."""
    gc.collect()
    gc.freeze()


@pytest.fixture
async def served() -> AsyncIterator[Served]:
    async with serve() as served:
        yield served


@pytest.fixture
async def hooked() -> AsyncIterator[Served]:
    async with serve(extra_detectors=HOOKED) as served:
        yield served


@pytest.fixture
def good_frame(ego_message, benign) -> Callable[[int], bytes]:
    """The body of a good frame with a given number."""
    return lambda index: wire.pack_frame(index, ego_message, benign)


async def until(condition: Callable[[], Any], within_s: float = 20.0) -> None:
    """Wait for what is to become true soon, however slow the machine is."""
    end = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < end
        await asyncio.sleep(0.001)


async def answered_since(traffic: Traffic, frames: int) -> None:
    """Wait until every session had so many frames answered since now."""
    before, end = [len(session.acknowledged) for session in traffic.sessions], time.monotonic() + 90
    while any(len(one.acknowledged) < was + frames for one, was in zip(traffic.sessions, before, strict=True)):
        assert time.monotonic() < end, [phase.as_dict() for phase in traffic.phases]
        await asyncio.sleep(0.05)


def problem(response: httpx.Response, status: int, slug: str) -> dict[str, Any]:
    """Check that a response is this problem, and give its fields."""
    assert response.status_code == status, response.text
    assert response.headers["content-type"] == "application/problem+json"
    fields = response.json()
    assert fields["type"] == f"urn:robosac:problem:{slug}"
    assert fields["status"] == status
    assert fields["title"]
    assert fields["detail"]
    return fields
