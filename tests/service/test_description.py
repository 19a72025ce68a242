"""The API's own description, for tools and for whoever reads it: all of it is there, and what it says is so."""

import asyncio

import pytest

from robosac import wire
from robosac.audit.events import event_on
from service.app import create_app
from service.description import AUDIT_LINE, EXAMPLES, TAGS
from service.operations import operations
from service.pages import pages
from service.problems import ANSWERS, TYPE_PREFIX
from service.routes import v1
from service.settings import Settings
from tests.service.conftest import TEAM

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


def test_examples_of_records_and_refusals_are_such(description):
    assert event_on(AUDIT_LINE.rstrip("\n").encode()).event == "token_renewed"
    for calls in description["paths"].values():
        for said in calls.values():
            for status, answer in said["responses"].items():
                for content in answer.get("content", {}).values():
                    if "application/problem+json" in answer["content"]:
                        kind = content["example"]["type"].removeprefix(TYPE_PREFIX)
                        assert str(ANSWERS[kind][0]) == status


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
    assert (await call("post", f"{session}/token", rsu)).status_code == 201
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
