import inspect

import httpx
import pytest
from fastapi.routing import APIRoute

from robosac import wire
from service.app import create_app
from service.operations import operations
from service.pages import pages
from service.routes import v1
from service.settings import Settings
from tests.service.conftest import problem, serve


async def test_alive_at_once_and_ready_after_the_warm_up():
    app = create_app(Settings(database_url="sqlite://"))
    transport = httpx.ASGITransport(app)
    async with httpx.AsyncClient(base_url="http://localhost", transport=transport) as http:
        assert (await http.get("/healthz")).status_code == 200
        problem(await http.get("/readyz"), 503, "not-ready")
        problem(await http.post("/v1/sessions", json={"ego_id": "a", "teammates": ["b"]}), 503, "not-ready")
        async with app.router.lifespan_context(app):
            assert (await http.get("/readyz")).json() == {"status": "ready"}
        problem(await http.get("/readyz"), 503, "not-ready")


async def test_who_watches_may_ask_for_the_heads_alone(served):
    for path in ("/healthz", "/readyz"):
        head, whole = await served.http.head(path), await served.http.get(path)
        assert (head.status_code, head.content) == (200, b"")
        assert head.headers["content-length"] == str(len(whole.content))
    served.gateway.stop()
    head = await served.http.head("/readyz")
    assert (head.status_code, head.content) == (503, b"")


async def test_metrics_count_what_happened(served, ego_message, attacked, messages):
    session = await served.open(defense={"kind": "sample_consensus", "sampling_budget": 7, "collaborators": 3})
    for frame in range(4):
        await served.ego(session).post_frame(frame, ego_message, attacked)
    bad = wire.pack_message(0, "car-3", messages["car-3"])
    await served.post(session, "messages", bad, session.teammate_tokens["car-2"])
    text = (await served.http.get("/metrics")).text
    values = {line.rsplit(" ", 1)[0]: float(line.rsplit(" ", 1)[1]) for line in text.splitlines() if line[0] != "#"}
    assert values["robosac_sessions"] == 1
    assert values['robosac_frames_total{source="consensus"}'] == 4
    assert values['robosac_hypotheses_total{verdict="consensus"}'] == 4
    assert values['robosac_refused_messages_total{reason="unauthenticated"}'] == 1
    assert values['robosac_stage_seconds_count{stage="total"}'] == 4
    assert values['robosac_problems_total{type="wrong-vehicle"}'] == 1
    assert values["process_cpu_seconds_total"] > 0
    rejected = sum(v for k, v in values.items() if k.startswith("robosac_rejected_teammates_total"))
    assert rejected == 4 * 2


async def test_problems_are_counted_wherever_they_are_answered():
    async with serve(allowed_hosts="gateway", max_body_bytes=2048) as served:
        await served.http.get("/healthz/none")
        await served.http.get("/metrics", headers={"Host": "elsewhere"})
        await served.http.get("/metrics", params={"long": "x" * 4000})
        await served.http.post("/v1/sessions", content=b"x" * 4096)
        await served.http.post("/v1/sessions", json={})
        text = (await served.http.get("/metrics")).text
    for slug in ("not-found", "foreign-host", "uri-too-long", "too-large", "invalid-request"):
        assert f'robosac_problems_total{{type="{slug}"}} 1.0' in text


async def test_late_frames_are_counted(served, ego_message, attacked):
    for budget in (0.01, 20_000):
        session = await served.open(latency_budget_ms=budget, gather_ms=0)
        await served.ego(session).post_frame(0, ego_message, attacked)
    assert "robosac_late_frames_total 1.0" in (await served.http.get("/metrics")).text


async def test_a_default_detector_that_does_not_exist_keeps_the_gateway_from_starting():
    app = create_app(Settings(detector="nonesuch", database_url="sqlite://"))
    with pytest.raises(ValueError, match="ROBOSAC_DETECTOR"):
        async with app.router.lifespan_context(app):
            pytest.fail("it started")


async def test_the_api_describes_itself(served):
    description = (await served.http.get("/openapi.json")).json()
    paths = set(description["paths"])
    assert {
        "/v1/detectors",
        "/v1/sessions",
        "/v1/sessions/{sid}",
        "/v1/sessions/{sid}/messages",
        "/v1/sessions/{sid}/frames",
        "/v1/sessions/{sid}/audit",
        "/healthz",
        "/readyz",
        "/metrics",
    } <= paths
    body = description["paths"]["/v1/sessions/{sid}/frames"]["post"]
    assert "application/vnd.msgpack" in body["requestBody"]["content"]
    assert "FrameAnswer" in str(body["responses"]["200"])
    assert (await served.http.get("/docs")).status_code == 200


async def test_an_error_nobody_foresaw_is_a_problem_without_its_inside(hooked, caplog):
    caplog.set_level("CRITICAL")

    def broken():
        raise RuntimeError("secret")

    hooked.detector.before_info = broken
    response = await hooked.http.get("/v1/detectors")
    problem(response, 500, "internal-error")
    assert "secret" not in response.text


def test_settings_come_from_the_environment(monkeypatch):
    monkeypatch.setenv("ROBOSAC_LATENCY_BUDGET_MS", "75")
    assert Settings().latency_budget_ms == 75
    monkeypatch.setenv("ROBOSAC_GATHER_MS", "-1")
    with pytest.raises(ValueError, match="gather_ms"):
        Settings()


async def test_what_a_strange_header_puts_into_the_log_breaks_no_line(served):
    session = await served.open()
    headers = {"Content-Type": b"a\x85b", "Authorization": f"Bearer {session.teammate_tokens['rsu']}"}
    path = f"/v1/sessions/{session.session_id}/messages"
    assert (await served.http.post(path, content=b"x", headers=headers)).status_code == 415
    (_, refused) = await served.ego(session).audit()
    assert refused["detail"].endswith("a\x85b")


def test_no_request_is_handed_to_a_thread_on_its_way_to_a_route():
    """FastAPI calls plain functions on threads of its own, and every change of threads costs every frame."""

    def called(dependant):
        yield dependant.call
        for part in dependant.dependencies:
            yield from called(part)

    routes = [route for router in (v1, operations, pages) for route in router.routes if isinstance(route, APIRoute)]
    calls = {call for route in routes for call in called(route.dependant)}
    assert len(routes) > 10
    assert len(calls) > len(routes)
    for call in calls:
        plain = inspect.unwrap(call) if inspect.isroutine(call) else call.__call__
        assert inspect.iscoroutinefunction(plain) or inspect.isasyncgenfunction(plain), call
