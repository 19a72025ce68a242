"""The API's own description, for tools and for whoever reads it: all of it is there, and what it says is so."""

import asyncio
import base64
import threading
from dataclasses import replace

import jsonschema_rs
import msgpack
import pytest
from fastapi import FastAPI

from robosac import wire
from robosac.audit.events import event_on
from robosac.detectors import TensorSpec, blank
from robosac.signatures import key_id, read_public_key
from service import tensor_bodies
from service.app import create_app
from service.description import AUDIT_LINE, EXAMPLES, TAGS
from service.operations import operations
from service.pages import pages
from service.problems import ANSWERS, TYPE_PREFIX
from service.routes import v1
from service.schemas import GatewayKeyList, SessionCreated
from service.settings import Settings
from tests.robosac.test_wire import EGO as TINY_EGO
from tests.robosac.test_wire import INFO as TINY
from tests.robosac.test_wire import TEAMMATE as TINY_TEAMMATE
from tests.service.conftest import TEAM, serve

MSGPACK = "application/vnd.msgpack"
ROUTES = [
    (method.lower(), route.path)
    for route in (*v1.routes, *operations.routes, *pages.routes)
    if route.include_in_schema
    for method in route.methods
]


@pytest.fixture(scope="module")
def description():
    return create_app(Settings(database_url="sqlite://")).openapi()


def resolved(schema, description):
    """A schema, looked up where it is only referred to."""
    name = schema.get("$ref", "").rpartition("/")[2]
    return description["components"]["schemas"][name] if name else schema


def test_nothing_is_described_that_is_not_there(description):
    described = {(method, path) for path, calls in description["paths"].items() for method in calls}
    assert described == set(ROUTES)


@pytest.mark.parametrize(("method", "path"), ROUTES)
def test_every_route_is_described(method, path, description):
    said = description["paths"][path][method]
    (tag,) = said["tags"]
    assert tag in {entry["name"] for entry in description["tags"]}
    assert said["description"].endswith(".")
    bodies = [said["requestBody"]] if "requestBody" in said else []
    assert bool(bodies) == (method == "post" and not path.endswith("/token"))
    for part in (*bodies, *said["responses"].values()):
        for media_type, content in part.get("content", {}).items():
            assert resolved(content["schema"], description).keys() & {"properties", "type"}, media_type
            assert "example" in content or media_type == MSGPACK
    for status, answer in said["responses"].items():
        assert answer["description"] not in ("", "Successful Response")
        assert bool(answer.get("content")) == (status != "204")


def test_answers_to_messages_and_frames_are_described_as_msgpack_too(description):
    for path, statuses in (("messages", ("200", "202")), ("frames", ("200",))):
        said = description["paths"][f"/v1/sessions/{{sid}}/{path}"]["post"]
        (body,) = said["requestBody"]["content"].values()
        assert {"frame"} < set(body["schema"]["required"]) <= set(body["schema"]["properties"])
        for status in statuses:
            content = said["responses"][status]["content"]
            assert content.keys() == {"application/json", MSGPACK}
            assert content[MSGPACK]["schema"] == content["application/json"]["schema"]


def test_not_to_be_ready_is_described(description):
    content = description["paths"]["/readyz"]["get"]["responses"]["503"]["content"]
    assert content["application/problem+json"]["example"]["type"] == f"{TYPE_PREFIX}not-ready"


def test_groups_are_told_apart(description):
    used = {tag for calls in description["paths"].values() for said in calls.values() for tag in said["tags"]}
    assert used == {entry["name"] for entry in TAGS}


@pytest.mark.parametrize("model", EXAMPLES, ids=lambda model: model.__name__)
def test_an_example_is_one_of_its_type(model):
    example = EXAMPLES[model]
    shown = model.model_validate(example).model_dump(mode="json")
    assert example.keys() <= shown.keys()


@pytest.mark.parametrize(("method", "path"), ROUTES)
def test_every_example_is_one_of_its_schema(method, path, description):
    said = description["paths"][path][method]
    for part in (*([said["requestBody"]] if "requestBody" in said else ()), *said["responses"].values()):
        for content in part.get("content", {}).values():
            schema = {**content["schema"], "components": description["components"]}
            if "example" in content:
                jsonschema_rs.validate(schema, content["example"])


def test_examples_of_records_and_refusals_are_such(description):
    assert event_on(AUDIT_LINE.rstrip("\n").encode()).event == "token_renewed"
    for calls in description["paths"].values():
        for said in calls.values():
            for status, answer in said["responses"].items():
                for content in answer.get("content", {}).values():
                    if "application/problem+json" in answer["content"]:
                        kind = content["example"]["type"].removeprefix(TYPE_PREFIX)
                        assert str(ANSWERS[kind][0]) == status


@pytest.mark.parametrize(("method", "path"), ROUTES)
async def test_what_is_refused_at_the_doors_is_described(served, method, path, description):
    answers = description["paths"][path][method]["responses"]
    asked = path.format(sid="x", frame=0, vehicle_id="rsu")
    heads = {
        403: ({"Origin": "http://elsewhere.example"}, ""),
        414: ({}, "?" + "x" * 3000),
        421: ({"Host": "elsewhere.example"}, ""),
        431: ({f"x-{i}": "1" for i in range(200)}, ""),
    }
    for status, (headers, query) in heads.items():
        if (refused := await served.http.request(method, asked + query, headers=headers)).status_code == status:
            schema = answers[str(status)]["content"]["application/problem+json"]["schema"]
            jsonschema_rs.validate(schema, refused.json())
        else:
            assert path == "/healthz", (status, refused.text)


async def test_that_a_log_is_full_is_described_where_more_would_be_written(description):
    async with serve(audit_max_records=2) as served:
        session = await served.open()
        headers = {"Authorization": f"Bearer {session.ego_token}"}
        of_session, team = "/v1/sessions/{sid}", {"json": {"teammates": ["car-9"]}}
        actual = of_session.format(sid=session.session_id)
        assert (await served.http.post(f"{actual}/teammates", headers=headers, **team)).status_code == 201
        for method, path, body in (
            ("post", "/teammates", {"json": {"teammates": ["car-8"]}}),
            ("delete", "/teammates/{vehicle_id}", {}),
            ("post", "/token", {}),
        ):
            asked = actual + path.format(vehicle_id="rsu")
            assert (await served.http.request(method, asked, headers=headers, **body)).status_code == 507
            assert "507" in description["paths"][of_session + path][method]["responses"]


async def test_what_is_answered_is_described(served, description, ego_message, benign):
    """Calls of a session's life, each with its status and media type."""
    seen = []

    async def call(method, path, token=None, **request):
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        headers |= request.pop("headers", {})
        actual = path.format(sid=sid, frame=0, vehicle_id="rsu")
        response = await served.http.request(method, actual, headers=headers, **request)
        answers = description["paths"][path][method]["responses"]
        content = answers[str(response.status_code)].get("content", {})
        media_type = response.headers.get("content-type", "").partition(";")[0]
        assert media_type in content if content else not response.content
        seen.append((method, path))
        return response

    sid = ""
    opened = (await call("post", "/v1/sessions", json={"ego_id": "car-1", "teammates": list(TEAM)})).json()
    sid, ego, rsu = opened["session_id"], opened["ego_token"], opened["teammate_tokens"]["rsu"]
    session = "/v1/sessions/{sid}"
    for number, accept in ((0, MSGPACK), (1, "application/json")):
        sent = {"Content-Type": MSGPACK, "Accept": accept}
        message = wire.pack_message(number, "rsu", benign["rsu"])
        assert (await call("post", f"{session}/messages", rsu, content=message, headers=sent)).status_code == 202
        frame = wire.pack_frame(number, ego_message, benign)
        assert (await call("post", f"{session}/frames", ego, content=frame, headers=sent)).status_code == 200
    assert (await call("get", f"{session}/frames/{{frame}}/messages", ego)).status_code == 404
    assert (await call("get", session)).status_code == 401
    fresh = await call("post", f"{session}/token", rsu)
    assert fresh.status_code == 201
    standing_by = asyncio.create_task(call("get", f"{session}/standby", fresh.json()["token"]))
    live = served.gateway.sessions.in_use(sid)
    while not live.standing:
        await asyncio.sleep(0.001)
    live.send_away()
    assert (await standing_by).status_code == 200
    await call("get", "/v1/live")
    with_it = asyncio.create_task(call("get", "/v1/live/{sid}"))
    while not served.gateway.feed.sessions()[0]["viewers"]:
        await asyncio.sleep(0.001)
    served.gateway.feed.end()
    assert (await with_it).status_code == 200
    await call("delete", f"{session}/teammates/{{vehicle_id}}", ego)
    await call("post", f"{session}/teammates", ego, json={"teammates": ["car-9"]})
    for path in ("/v1/detectors", "/v1/keys", session, f"{session}/audit", "/healthz", "/readyz", "/metrics"):
        await call("get", path, ego)
    assert "audit-head" in (await call("delete", session, ego)).headers
    assert set(seen) == set(ROUTES)


def bytes_of(rendered):
    """A body that was rendered as JSON, with binary where it stands for that."""
    if isinstance(rendered, list):
        return [bytes_of(item) for item in rendered]
    if not isinstance(rendered, dict):
        return rendered
    if rendered.keys() == {"base64", "times"}:
        return base64.b64decode(rendered["base64"]) * rendered["times"]
    return {name: bytes_of(value) for name, value in rendered.items()}


def as_text(value):
    """A body as a validator of JSON takes it: each byte of binary is a character."""
    if isinstance(value, bytes):
        return value.decode("latin-1")
    if isinstance(value, list):
        return [as_text(item) for item in value]
    return {name: as_text(item) for name, item in value.items()} if isinstance(value, dict) else value


async def test_it_is_made_off_the_event_loop(served, monkeypatch):
    threads, made = [], FastAPI.openapi
    monkeypatch.setattr(FastAPI, "openapi", lambda app: threads.append(threading.get_ident()) or made(app))
    answers = await asyncio.gather(*(served.http.get("/openapi.json") for _ in range(9)))
    assert len({answer.content for answer in answers}) == 1
    assert len(threads) == 1  # and once, however many ask
    assert threading.get_ident() not in threads


def conforms(value, schema, document=None):
    components = {} if document is None else {"components": document["components"]}
    return jsonschema_rs.is_valid({**components, **schema}, as_text(value))


async def test_the_examples_of_tensor_bodies_are_such_and_are_accepted(served):
    """All that is sent comes from the description alone."""
    document = (await served.http.get("/openapi.json")).json()
    calls = {path: item["post"] for path, item in document["paths"].items() if "post" in item}
    opening = calls["/v1/sessions"]["requestBody"]["content"]["application/json"]["example"]
    opened = (await served.http.post("/v1/sessions", json={**opening, "latency_budget_ms": 20_000})).json()
    tokens = {opening["ego_id"]: opened["ego_token"], **opened["teammate_tokens"]}
    for name, status in (("messages", 202), ("frames", 200)):
        path = f"/v1/sessions/{{sid}}/{name}"
        (media_type, body), *others = calls[path]["requestBody"]["content"].items()
        assert not others
        sent = bytes_of(body["examples"][opened["detector"]["name"]]["value"])
        assert conforms(sent, body["schema"], document)
        headers = {"Authorization": f"Bearer {tokens[sent.get('vehicle_id', opening['ego_id'])]}"}
        headers |= {"Content-Type": media_type, "Accept": media_type}
        place = path.format(sid=opened["session_id"])
        response = await served.http.post(place, content=msgpack.packb(sent), headers=headers)
        assert response.status_code == status, response.text
        answered = calls[path]["responses"][str(status)]["content"][response.headers["content-type"]]
        assert conforms(msgpack.unpackb(response.content), answered["schema"], document)


@pytest.mark.parametrize(
    ("spoil", "code"),
    [
        (lambda part: part["tensors"]["features"].update(data=b"\0" * 11), "wrong-length"),
        (lambda part: part["tensors"]["features"].update(shape=[3, 2]), "wrong-shape"),
        (lambda part: part["tensors"]["features"].update(dtype="float32"), "wrong-dtype"),
        (lambda part: part["tensors"].update(other=part["tensors"]["features"]), "unknown-tensor"),
        (lambda part: part["tensors"].pop("features"), "missing-field"),
        (lambda part: part.update(pose=part["pose"][:15]), "bad-pose"),
        (lambda part: part.update(signature=b"short"), "wrong-length"),
        (lambda part: part.pop("pose"), "missing-field"),
    ],
)
def test_the_schemas_of_tensor_bodies_allow_what_the_codec_does(spoil, code):
    """Of a detector whose ego sends more than its teammates."""
    sent = msgpack.unpackb(wire.pack_frame(0, TINY_EGO, {"car-2": TINY_TEAMMATE}))
    own = msgpack.unpackb(wire.pack_message(0, "car-2", TINY_TEAMMATE))
    other = blank(served_info("other"), "teammate")
    others = msgpack.unpackb(wire.pack_message(0, "car-2", other))
    whole, single = tensor_bodies.frame_body([TINY])["schema"], tensor_bodies.message_body([TINY])["schema"]
    assert conforms(sent, whole)
    assert conforms(own, single)
    assert conforms(msgpack.unpackb(wire.pack_message(0, "car-1", TINY_EGO)), single)
    small = wire.Packing(compress=True)
    assert conforms(msgpack.unpackb(wire.pack_message(0, "car-2", TINY_TEAMMATE, packing=small)), single)
    assert not conforms(others, single)
    assert conforms(others, tensor_bodies.message_body([TINY, served_info("other")])["schema"])
    assert conforms(others, tensor_bodies.message_body(())["schema"])
    assert conforms({**sent, "states": {"before": b"{}"}}, tensor_bodies.kept_frame([TINY])["schema"])
    assert not conforms({**sent, "ego": sent["teammates"]["car-2"]}, whole)  # it lacks what only an ego sends
    for part, schema, body in ((sent["teammates"]["car-2"], whole, sent), (own, single, own)):
        spoil(part)
        assert not conforms(body, schema)
        with pytest.raises(wire.WireError) as refused:
            checked(part)
        assert refused.value.code == code


def test_the_keys_of_the_examples_are_keys():
    (key,) = EXAMPLES[GatewayKeyList]["keys"]
    assert len(base64.b64decode(key["public_key"], validate=True)) == 32
    assert key["key_id"] == key_id(read_public_key(key["public_key"])) == EXAMPLES[SessionCreated]["receipt"]["key_id"]
    assert len(base64.b64decode(EXAMPLES[SessionCreated]["receipt"]["signature"], validate=True)) == 64


def served_info(name):
    layout = {"map": TensorSpec("uint8", (5,))}
    return replace(TINY, name=name, tensors={"ego": layout, "teammate": layout})


def checked(part):
    return wire.check_message(part, TINY, "teammate"), wire.read_signature(part)


def test_calls_of_a_session_take_the_header_by_which_a_cluster_finds_it(description):
    for path, calls in description["paths"].items():
        for call in calls.values():
            headers = [told["name"] for told in call.get("parameters", []) if told["in"] == "header"]
            assert ("X-Session-Id" in headers) == ("{sid}" in path), path
