"""Nobody's body is read before its sender is known, and no request costs much before it is looked at."""

import asyncio
import json
import sys
import threading
from types import SimpleNamespace

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, field_validator
from starlette.requests import Request
from starlette.responses import StreamingResponse

from robosac.signatures import show_public_key
from service.app import create_app
from service.arriving import bodies
from service.arriving.doors import HEADER_BYTES, HEADERS, TARGET_BYTES
from service.arriving.limits import UNREAD_BYTES, BodyLimit, Unfinished
from service.arriving.metering import METER
from service.schemas import SessionRequest
from service.settings import Settings
from tests.service.conftest import problem, serve
from tests.service.test_identity import ANYBODY, EGO_ONLY, KEY, KEY_HOLDER, OTHER_KEY, RULES, bearer

JSON = {"Content-Type": "application/json"}


async def unread():
    pytest.fail("the body was asked for")
    yield b""


async def head(served, method, path, media_type, size, credential=None):
    """Ask with headers that announce a body, which must not be asked for."""
    headers = {"Content-Type": media_type, "Content-Length": str(size), **bearer(credential)}
    return await served.http.request(method, path, headers=headers, content=unread())


@pytest.mark.parametrize("media_type", ["application/json", "application/vnd.msgpack"])
@pytest.mark.parametrize("route", [route for route, rule in RULES.items() if rule != ANYBODY])
async def test_strangers_are_refused_from_their_headers_alone(route, media_type):
    method, path = route.split()
    async with serve(api_key=KEY, api_keys=KEY) as served:
        session, other = await served.open(), await served.open()
        path = path.format(sid=session.session_id, vehicle_id="car-3", frame=0)
        strangers = [None, "x", "y" * 5000, other.ego_token, other.teammate_tokens["car-2"]]
        strangers += [session.ego_token, OTHER_KEY] if RULES[route] == KEY_HOLDER else [KEY]
        for size in (100, bodies.JSON_BYTES, Settings().max_body_bytes):
            for credential in strangers:
                problem(await head(served, method, path, media_type, size, credential), 401, "unauthenticated")
        if RULES[route] == EGO_ONLY:
            token = session.teammate_tokens["car-2"]
            problem(await head(served, method, path, media_type, size, token), 403, "ego-only")


@pytest.mark.parametrize("route", [route for route, rule in RULES.items() if rule == ANYBODY])
async def test_a_body_that_nobody_needs_is_not_read(route, served):
    method, path = route.format(name="live.js").split()
    assert (await head(served, method, path, "application/json", Settings().max_body_bytes)).status_code == 200


@pytest.mark.parametrize(
    ("size", "token", "closes"),
    [
        (UNREAD_BYTES + 1, None, True),
        (32 * 2**20, None, True),
        (33 * 2**20, None, True),
        (2**64 - 1, None, True),
        (f"{32 * 2**20:05000}", None, True),
        (UNREAD_BYTES, None, False),
        (f"{UNREAD_BYTES:05000}", None, False),
    ],
)
async def test_a_large_body_that_is_not_wanted_is_not_waited_for(size, token, closes):
    async with serve(api_key=KEY, api_keys=KEY) as served:
        session = await served.open()
        for path in ("/v1/sessions", f"/v1/sessions/{session.session_id}/frames"):
            refused = await head(served, "POST", path, "application/vnd.msgpack", size, token)
            assert refused.status_code in (401, 413)
            assert (refused.headers.get("connection") == "close") is closes
        assert "connection" not in (await served.http.get("/healthz")).headers


async def test_a_body_of_unknown_length_is_not_waited_for_either_unless_it_was_read(good_frame):
    async def sent(body):
        yield body

    async with serve() as served:
        session = await served.open()
        path = f"/v1/sessions/{session.session_id}/frames"
        headers = {"Content-Type": "application/vnd.msgpack"}
        refused = await served.http.post(path, content=unread(), headers=headers)
        assert (refused.status_code, refused.headers["connection"]) == (401, "close")
        answered = await served.http.post(
            path, content=sent(good_frame(0)), headers=headers | bearer(session.ego_token)
        )
        assert (answered.status_code, "connection" in answered.headers) == (200, False)


def test_no_route_leaves_its_body_to_the_framework():
    """Which reads it before the credential is asked for."""

    def bodies_of(router):
        for route in getattr(router, "original_router", router).routes:
            if hasattr(getattr(route, "original_router", route), "routes"):
                yield from bodies_of(route)
            else:
                yield route.path, getattr(route, "body_field", None) is not None

    app = create_app(Settings())

    @app.post("/an-example")
    async def example(fields: dict[str, int]) -> None: ...

    found = list(bodies_of(app.router))
    assert {path for path, _ in found} == {route.split()[1] for route in RULES} | {"/an-example"}
    assert [path for path, has_body in found if has_body] == ["/an-example"]


def enrolment(number):
    names = [f"{i:04d}" + "x" * 60 for i in range(number)]
    return {"teammates": names, "public_keys": dict.fromkeys(names, show_public_key(Ed25519PrivateKey.generate()))}


async def test_the_largest_honest_requests_are_taken_and_larger_ones_not_read():
    async with serve(max_teammates=1024) as served:
        opening = {"ego_id": "e" * 64, **enrolment(1024)}
        response = await served.http.post("/v1/sessions", json=opening)
        assert response.status_code == 201, response.text
        calibration = [i / 2000 + 1e-9 for i in range(2000)]
        defense = {"kind": "conformal", "calibration": calibration}
        response = await served.http.post("/v1/sessions", json={"ego_id": "a", "teammates": ["b"], "defense": defense})
        assert response.status_code == 201, response.text
        session = await served.client.open_session("a", [], defense={"kind": "none"})  # soon adds a thousand
        path, ego = f"/v1/sessions/{session.session_id}/teammates", bearer(session.ego_token)
        response = await served.http.post(path, json=enrolment(1024), headers=ego)
        assert response.status_code == 201, response.text
        for where, credential in (("/v1/sessions", None), (path, session.ego_token)):
            refused = await head(served, "POST", where, "application/json", bodies.JSON_BYTES + 1, credential)
            assert str(bodies.JSON_BYTES) in problem(refused, 413, "too-large")["detail"]

            async def endless():
                while True:
                    yield b"[" * 10_000

            refused = await served.http.post(where, content=endless(), headers=JSON | bearer(credential))
            problem(refused, 413, "too-large")


class Noting(BaseModel):
    """Notes the thread in which it is read."""

    text: str

    @field_validator("text")
    @classmethod
    def _note(cls, text: str) -> str:
        return threading.current_thread().name


@pytest.mark.parametrize(("length", "on_the_loop"), [(100, True), (bodies.SMALL_BYTES + 1, False)])
async def test_large_json_is_parsed_off_the_event_loop(length, on_the_loop):
    async def receive():
        return {"type": "http.request", "body": json.dumps({"text": "x" * length}).encode()}

    request = Request({"type": "http", "headers": [(b"content-type", b"application/json")]}, receive)
    parsed = await bodies.read_json(request, Noting)
    assert (parsed.text == threading.current_thread().name) is on_the_loop


@pytest.mark.parametrize("path", ["/v1/sessions", "/v1/sessions/{sid}/teammates"])
@pytest.mark.parametrize(
    ("headers", "slug"),
    [
        ({}, "unsupported-media-type"),
        ({"Content-Type": "text/plain"}, "unsupported-media-type"),
        ({"Content-Type": "application/vnd.msgpack"}, "unsupported-media-type"),
        (JSON | {"Content-Encoding": "gzip"}, "unsupported-encoding"),
        (JSON | {"Transfer-Encoding": "gzip, chunked"}, "unsupported-encoding"),
    ],
)
async def test_json_is_asked_for_by_name(served, path, headers, slug):
    session = await served.open()
    body = json.dumps({"ego_id": "a", "teammates": ["b"]})
    where = path.format(sid=session.session_id)
    refused = await served.http.post(where, content=body, headers=headers | bearer(session.ego_token))
    detail = problem(refused, 415, slug)["detail"]
    assert slug == "unsupported-encoding" or "send application/json" in detail
    charset = {"Content-Type": "Application/JSON; charset=utf-8"}
    assert (await served.http.post("/v1/sessions", content=body, headers=charset)).status_code == 201


def _conformal(calibration):
    defense = '{"kind": "conformal", "calibration": [' + calibration + "]}"
    return ('{"ego_id": "a", "teammates": [], "defense": ' + defense + "}").encode()


def test_of_many_wrong_numbers_few_are_told():
    """To tell what is wrong with each of 120,000 took two seconds, and let nothing else go on meanwhile."""
    with pytest.raises(RequestValidationError) as refused:
        bodies._parsed(_conformal("2," * 1999 + "2"), SessionRequest, None)
    assert len(refused.value.errors()) <= 2


async def test_what_is_read_on_a_thread_counts_as_its_senders():
    async def receive():
        return {"type": "http.request", "body": json.dumps({"text": ["x"] * 2000}).encode()}

    took = []
    state = {METER: SimpleNamespace(elsewhere=took.append)}
    request = Request({"type": "http", "headers": [(b"content-type", b"application/json")], "state": state}, receive)
    with pytest.raises(RequestValidationError):
        await bodies.read_json(request, Noting)
    assert len(took) == 1
    assert took[0] > 0


@pytest.mark.parametrize(
    ("body", "status", "slug", "field"),
    [
        (b"", 400, "malformed-json", None),
        (b"{", 400, "malformed-json", None),
        (b"\xff", 400, "malformed-json", None),
        (b'"\\ud800"', 400, "malformed-json", None),
        (b"[" * 4000, 400, "malformed-json", None),
        (b"[" * 100_000, 422, "invalid-request", "body"),
        (b'{"ego_id": "a", "teammates": []} []', 400, "malformed-json", None),
        (b'{"ego_id": "a", "ego_id": "b", "teammates": []}', 400, "malformed-json", None),
        (b'{"ego_id": "a", "teammates": [], "defense": {"kind": "a2cp", "kind": "a2cp"}}', 400, "malformed-json", None),
        (b"null", 422, "invalid-request", "body"),
        (b'{"ego_id": "a"}', 422, "invalid-request", "teammates"),
        (b'{"ego_id": "a", "teammates": ["b", 3]}', 422, "invalid-request", "teammates.1"),
        (b'{"ego_id": "a", "teammates": [], "gather_ms": NaN}', 422, "invalid-request", "gather_ms"),
        (b'{"ego_id": "a", "teammates": [], "defense": {"kind": "a2cp", "ratios": 3}}',
         422, "invalid-request", "defense.ratios"),
        (json.dumps({"ego_id": "a", "teammates": ["b"], "public_keys": {str(i): "" for i in range(2000)}}).encode(),
         422, "invalid-request", "public_keys"),
        (_conformal("2," * 2500 + "2"), 422, "invalid-request", "defense.calibration.0"),
        (_conformal("2," * 120_000 + "2"), 422, "invalid-request", "defense"),
        (_conformal("[" + "[0]," * 3000 + "0]"), 422, "invalid-request", "defense"),
        (_conformal("[]," * 5000 + "2"), 422, "invalid-request", "body"),
        (json.dumps({"ego_id": "a", "teammates": ["#"] * 2000}).encode(), 422, "invalid-request", "teammates.0"),
        (json.dumps({"ego_id": "a", "teammates": [], **{f"x{i}": 0 for i in range(20_000)}}).encode(),
         422, "invalid-request", "body"),
        (json.dumps([[] for _ in range(50_000)]).encode(), 422, "invalid-request", "body"),
        (json.dumps({"\ud800": {f"x{i}": 0 for i in range(2000)}}).encode(), 422, "invalid-request", "body"),
        (json.dumps({"x" * 200_000: {f"x{i}": 0 for i in range(1050)}}).encode(), 422, "invalid-request", "ego_id"),
    ],
)  # fmt: skip
async def test_bad_json_is_told_where(served, body, status, slug, field):
    refused = await served.http.post("/v1/sessions", content=body, headers=JSON)
    assert problem(refused, status, slug).get("field") == field


async def test_what_is_wrong_is_told_in_plain_words(served):
    body = {"ego": "a", "teammates": []}
    missing = problem(await served.http.post("/v1/sessions", json=body), 422, "invalid-request")
    assert (missing["field"], missing["detail"]) == ("ego_id", "is missing")
    unknown = problem(await served.http.post("/v1/sessions", json={"ego_id": "a", **body}), 422, "invalid-request")
    assert (unknown["field"], unknown["detail"]) == ("ego", "there is no such field")
    assert problem(await served.http.get("/v1/session"), 404, "not-found")["detail"] == "there is nothing at this path"
    refused = await served.http.put("/v1/sessions")
    assert problem(refused, 405, "method-not-allowed")["detail"] == "this path does not take this method"
    assert refused.headers["allow"] == "POST"
    assert (await served.http.put("/v1/sessions/x")).headers["allow"] == "DELETE, GET"


async def test_the_description_says_what_to_send(served):
    paths = (await served.http.get("/openapi.json")).json()["paths"]
    for path, name in (("/v1/sessions", "ego_id"), ("/v1/sessions/{sid}/teammates", "teammates")):
        schema = paths[path]["post"]["requestBody"]["content"]["application/json"]["schema"]
        assert name in schema["required"]
        assert "$ref" not in json.dumps(schema)
    kinds = paths["/v1/sessions"]["post"]["requestBody"]["content"]["application/json"]["schema"]
    assert "group_testing" in json.dumps(kinds["properties"]["defense"])


@pytest.mark.parametrize(
    ("target", "headers", "status"),
    [
        ("/healthz?" + "a&" * (TARGET_BYTES // 2), {}, 414),
        ("/v1/sessions/" + "a" * TARGET_BYTES, {}, 414),
        ("/healthz", {f"x-{i}": "y" for i in range(HEADERS)}, 431),
        ("/healthz", {"Authorization": "Bearer " + "x" * HEADER_BYTES}, 431),
    ],
)
async def test_absurd_heads_are_refused(served, target, headers, status):
    refused = await served.http.get(target, headers=headers)
    problem(refused, status, {414: "uri-too-long", 431: "headers-too-large"}[status])
    assert refused.headers["connection"] == "close"
    assert (await served.http.get("/healthz?" + "a&" * 500, headers={"x": "y" * 10_000})).status_code == 200


@pytest.mark.skipif(sys.platform == "win32", reason="no such limit")
async def test_idle_connections_do_not_use_up_a_small_limit_of_open_files():
    """The limit of 1024 that many systems begin with is raised as far as they grant."""
    code = (
        "import resource as r\n_, most = r.getrlimit(r.RLIMIT_NOFILE)\nr.setrlimit(r.RLIMIT_NOFILE, (256, most))\n"
        "from service.runtime import tune_process\ntune_process()\n"
        "granted, most = r.getrlimit(r.RLIMIT_NOFILE)\nprint(granted == (65536 if most < 0 else min(65536, most)))"
    )
    process = await asyncio.create_subprocess_exec(sys.executable, "-c", code, stdout=asyncio.subprocess.PIPE)
    assert (await process.communicate())[0].strip() == b"True"


@pytest.mark.parametrize(("piece", "sent"), [(b"", b"abc"), (b"x" * 60, b"a")])
async def test_a_body_beside_an_answer_that_goes_on_is_no_fault(piece, sent):
    async def answer():
        for part in (b"a", b"b", b"c"):
            yield part
            await asyncio.sleep(0.1)

    async def receive():
        await asyncio.sleep(0.02 if piece else 3600.0)
        return {"type": "http.request", "body": piece, "more_body": True}

    async def send(message):
        answered.append(message.get("body", b""))

    answered: list[bytes] = []
    scope = {"type": "http", "method": "GET", "headers": [(b"transfer-encoding", b"chunked")]}
    await BodyLimit(StreamingResponse(answer()), 100, 0.05, Unfinished())(scope, receive, send)
    assert b"".join(answered) == sent
