import json
import logging

import pytest
import structlog
from opentelemetry.sdk.trace import TracerProvider
from opentelemetry.sdk.trace.export import SimpleSpanProcessor
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter

from robosac import wire
from service.settings import Settings
from service.tracing import provider_from_environment
from tests.service.conftest import EGO, problem, serve


async def test_events_are_logged_as_json_without_secrets(capsys, messages, benign):
    async with serve(log_level="debug") as served:
        session = await served.open(defense={"kind": "none"})
        await served.ego(session).post_frame(0, messages[EGO], benign)
        bad = wire.pack_message(0, 'rsu"\n{"event": "forged"}', messages["rsu"])
        await served.post(session, "messages", bad, session.teammate_tokens["rsu"])
        await served.ego(session).close()
    text = capsys.readouterr().err
    events = [json.loads(line) for line in text.splitlines()]
    assert events.pop(0)["event"].startswith("no API key is set")
    assert [event["event"] for event in events] == [
        "gateway ready", "session opened", "frame answered", "message refused", "session ended", "gateway stopped",
    ]  # fmt: skip
    assert all(event["timestamp"].endswith("Z") for event in events)
    assert events[2]["session_id"] == session.session_id
    assert events[2]["level"] == "debug"
    for token in (session.ego_token, *session.teammate_tokens.values()):
        assert token not in text


async def test_faults_are_logged_with_their_trace_and_for_the_eye_if_wanted(capsys):
    async with serve(log_format="console"):
        try:
            raise RuntimeError("boom")
        except RuntimeError:
            structlog.stdlib.get_logger("service.test").exception("it failed")
        logging.getLogger("robosac.test").warning("from the library")
        structlog.stdlib.get_logger("service.test").debug("not at this level")
    text = capsys.readouterr().err
    assert "RuntimeError" in text
    assert "from the library" in text
    assert "not at this level" not in text


@pytest.fixture
def exporter():
    return InMemorySpanExporter()


@pytest.fixture
def provider(exporter):
    provider = TracerProvider()
    provider.add_span_processor(SimpleSpanProcessor(exporter))
    return provider


async def test_a_frame_is_a_span_of_the_callers_trace_with_its_stages(exporter, provider, messages, benign):
    async with serve(spans=provider) as served:
        session = await served.open()
        trace_id, caller = "4bf92f3577b34da6a3ce929d0e0e4736", "00f067aa0ba902b7"
        body = wire.pack_frame(0, messages[EGO], benign)
        await served.post(session, "frames", body, traceparent=f"00-{trace_id}-{caller}-01")
        problem(await served.post(session, "frames", body), 409, "stale-frame")
        spans = exporter.get_finished_spans()
    posts = [span for span in spans if span.name == "POST /v1/sessions/{sid}/frames"]
    assert [span.attributes["http.response.status_code"] for span in posts] == [200, 409]
    assert f"{posts[0].context.trace_id:032x}" == trace_id
    assert f"{posts[0].parent.span_id:016x}" == caller
    assert posts[0].attributes["robosac.source"] == "consensus"
    stages = {span.name: span for span in spans if span.parent and span.parent.span_id == posts[0].context.span_id}
    assert {"receive", "prepare", "ego_only", "hypotheses", "store"} <= set(stages)
    assert all(span.end_time >= span.start_time for span in stages.values())


def test_without_an_endpoint_nothing_is_traced_and_with_one_spans_are_exported(monkeypatch):
    for name in ("OTEL_EXPORTER_OTLP_ENDPOINT", "OTEL_EXPORTER_OTLP_TRACES_ENDPOINT"):
        monkeypatch.delenv(name, raising=False)
    assert provider_from_environment() is None
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", "http://127.0.0.1:9")
    provider = provider_from_environment()
    assert provider.resource.attributes["service.name"] == "robosac-gateway"
    provider.shutdown()


def test_a_configured_endpoint_without_the_packages_is_explained(monkeypatch):
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", "http://127.0.0.1:9")
    monkeypatch.setitem(__import__("sys").modules, "opentelemetry.exporter.otlp.proto.http.trace_exporter", None)
    with pytest.raises(ValueError, match=r"robosac\[tracing\]"):
        provider_from_environment()


def test_unknown_levels_are_refused():
    with pytest.raises(ValueError, match="log_level"):
        Settings(log_level="loud")
