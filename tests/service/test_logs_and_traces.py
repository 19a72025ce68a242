import asyncio
import contextlib
import gc
import json
import logging
import os
import re
import socket
import sqlite3
import subprocess
import sys
import time
import traceback
from pathlib import Path

import httpx
import pytest
import structlog
from opentelemetry.sdk.trace import TracerProvider
from opentelemetry.sdk.trace.export import SimpleSpanProcessor
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter

from robosac import wire
from service.settings import Settings
from service.watching.logs import LINES, logging_to_stderr
from service.watching.tracing import provider_from_environment
from tests.service.conftest import EGO, HOOKED, problem, serve
from tests.service.test_identity import bearer


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


def test_what_a_start_failed_for_is_told_first(capsys):
    """A server says it as a text that ends with it."""
    with logging_to_stderr(Settings()):
        try:
            [].stat()
        except AttributeError:
            logging.getLogger("uvicorn.error").error(traceback.format_exc())
    (line,) = capsys.readouterr().err.splitlines()
    assert json.loads(line)["event"].startswith("AttributeError: 'list' object has no attribute 'stat'\n")


async def test_what_was_lost_is_told_in_the_form_of_the_log(capsys, monkeypatch):
    async with serve():
        LINES.flush(10)
        capsys.readouterr()
        monkeypatch.setattr(LINES, "_lost", 3)
        structlog.stdlib.get_logger("service.test").info("read again")
    lost, again, *_ = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    assert (lost["event"], lost["level"]) == ("3 lines of the log were lost: nobody read those before them", "warning")
    assert again["event"] == "read again"


KEY, OTHER_KEY, SECRET = "an-api-key-0123456789", "another-key-9876543210", "not-for-the-log-" * 3
LOG_BYTES = 10_000


class Seeds:
    """Seeds that can be foreseen, until drawing one fails."""

    fault: Exception | None = None

    def __iter__(self):
        return self

    def __next__(self):
        if self.fault is not None:
            raise self.fault
        return SEED


SEED = 12345678901234567890123456789


async def a_faulty_frame(served, _, messages, benign):
    """A fault inside the detector, whose calls hold messages and the frame's draws."""

    def broken(*arguments):
        if arguments[-1]:
            raise ValueError(f"{arguments}") from RuntimeError(arguments)

    session = await served.open(defense={"kind": "none"})
    served.detector.before_prepare = broken
    answer = await served.ego(session).post_frame(0, messages[EGO], benign)
    assert (answer.source, answer.degraded_by) == ("ego_only", "fault")
    return session


async def a_faulty_decision(served, seeds, messages, benign):
    """A fault beneath a route, in calls that hold tokens, seeds and tensors."""
    session = await served.open(defense={"kind": "none"})
    seeds.fault = KeyError(benign, f"{SEED:064x}", session)
    body = wire.pack_frame(0, messages[EGO], benign)
    problem(await served.post(session, "frames", body), 500, "internal-error")
    return session


async def a_faulty_opening(served, seeds, messages, benign):
    """A fault with the caller's credential in its message, and causes without end."""
    session = await served.open()
    seeds.fault = error = RuntimeError(f"{KEY}, {OTHER_KEY}, {SECRET} and {session}" + " and so on" * 10_000)
    for _ in range(50):
        error.__cause__ = error = RuntimeError(bytes(range(256)) * 10)
    opening = await served.http.post("/v1/sessions", json={"ego_id": "a", "teammates": []}, headers=bearer(KEY))
    problem(opening, 500, "internal-error")
    return session


async def a_faulty_task(served, _, messages, benign):
    """A fault that nobody waits for: asyncio tells of it."""
    session = await served.open()

    async def broken(tensor):
        raise RuntimeError(session, tensor)

    task = asyncio.create_task(broken(messages["rsu"]))
    await asyncio.wait([task])
    del task
    gc.collect()
    return session


@pytest.mark.parametrize("log_format", ["json", "console"])
@pytest.mark.parametrize("fault", [a_faulty_frame, a_faulty_decision, a_faulty_opening, a_faulty_task])
async def test_a_fault_leaves_no_secret_in_the_log_and_little_of_it(
    fault, log_format, messages, benign, capsys, tmp_path
):
    file = tmp_path / "keys"
    file.write_text(OTHER_KEY)
    settings = {"api_keys": KEY, "api_keys_file": file, "token_secrets": SECRET, "log_format": log_format}
    seeds = Seeds()
    async with serve(seeds, api_key=KEY, extra_detectors=HOOKED, **settings) as served:
        await served.client.ready()
        LINES.flush(10)
        capsys.readouterr()
        session = await fault(served, seeds, messages, benign)
        LINES.flush(10)
        text = capsys.readouterr().err
    assert "Error" in text
    assert len(text.encode()) < LOG_BYTES
    tokens = [session.ego_token, *session.teammate_tokens.values()]
    for secret in (KEY, OTHER_KEY, SECRET, f"{SEED:064x}", str(SEED), *tokens):
        assert secret[8:] not in text
        assert secret.rpartition(".")[2][:20] not in text
    assert not re.search(r"(?:[-+]?\d*\.\d+[\s,\]\[]+){6}", text)
    assert "\\x00" not in text
    if log_format == "json":
        assert all("level" in json.loads(line) for line in text.splitlines())


async def test_a_fault_is_told_with_the_calls_that_led_to_it(hooked, capsys):
    def inner(token):
        raise LookupError("what went wrong")

    def outer():
        try:
            inner("not-for-the-log")
        except LookupError as error:
            raise RuntimeError("what came of it") from error

    hooked.detector.before_info = outer
    problem(await hooked.http.get("/v1/detectors"), 500, "internal-error")
    LINES.flush(10)
    (event,) = [json.loads(line) for line in capsys.readouterr().err.splitlines() if "unhandled" in line]
    assert (event["level"], event["path"]) == ("error", "/v1/detectors")
    late, early = event["exception"].split("\nfrom ")
    assert late.startswith("RuntimeError: what came of it\n")
    assert early.startswith("LookupError: what went wrong\n")
    assert "in list_detectors:" in late
    assert "in inner: raise LookupError" in early
    assert "not-for-the-log" not in late.replace('inner("not-for-the-log")', "")


async def test_a_database_that_fails_tells_of_no_row(caplog, tmp_path):
    async with serve(database_url=f"sqlite:///{tmp_path}/robosac.db") as served:
        session = await served.open()
        token = session.ego_token
        with contextlib.closing(sqlite3.connect(tmp_path / "robosac.db")) as database:
            fail = f"SELECT RAISE(ABORT, 'failing row: {token}, {'ab' * 32}')"
            database.execute(f"CREATE TRIGGER refusing BEFORE INSERT ON audit_lines BEGIN {fail}; END")
        path = f"/v1/sessions/{session.session_id}/token"
        problem(await served.http.post(path, headers=bearer(token)), 503, "store-unavailable")
    (record,) = [r for r in caplog.records if "database failed" in r.getMessage()]
    assert "IntegrityError: failing row: " in record.getMessage()
    assert "ab" * 32 not in caplog.text
    assert token.split(".")[2] not in caplog.text


FAULTY = """
from service.app import create_app
drawn = iter(["ab" * 32])
def seed():
    for one in drawn:
        return one
    raise RuntimeError("broken")
app = create_app(seeds=seed)
"""


def test_a_running_gateway_writes_no_more_either(tmp_path):
    """The server logs a fault, too."""
    (tmp_path / "faulty.py").write_text(FAULTY)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    environment = os.environ | {"ROBOSAC_API_KEYS": KEY, "PYTHONPATH": str(Path(__file__).parents[2])}
    with (tmp_path / "log").open("wb") as log:
        command = [sys.executable, "-m", "uvicorn", "faulty:app", "--port", str(port)]
        process = subprocess.Popen(command, cwd=tmp_path, env=environment, stdout=log, stderr=log)
    try:
        with httpx.Client(base_url=f"http://127.0.0.1:{port}", trust_env=False) as http:
            end = time.monotonic() + 60
            while not _ready(http):
                assert process.poll() is None, (tmp_path / "log").read_text()
                assert time.monotonic() < end
                time.sleep(0.1)
            opened = http.post("/v1/sessions", json={"ego_id": "a", "teammates": ["b"]}, headers=bearer(KEY)).json()
            before = (tmp_path / "log").stat().st_size
            again = http.post("/v1/sessions", json={"ego_id": "a", "teammates": ["b"]}, headers=bearer(KEY))
            problem(again, 500, "internal-error")
    finally:
        process.terminate()
        process.wait(30)
    text = (tmp_path / "log").read_text()
    events = [json.loads(line)["event"] for line in text.splitlines()]  # the server's, too, from the first to the last
    assert events[0].startswith("Started server process")
    assert events[-1].startswith("Finished server process")
    assert "RuntimeError: broken" in text
    assert "Exception in ASGI application" in text
    assert len(text.encode()) - before < LOG_BYTES
    for secret in (KEY, opened["ego_token"], opened["teammate_tokens"]["b"]):
        assert secret not in text


def _ready(http):
    try:
        return http.get("/readyz").status_code == 200
    except httpx.TransportError:
        return False


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
