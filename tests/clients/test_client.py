import asyncio

import httpx
import numpy as np
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from clients.client import STORE_UNAVAILABLE, FrameAnswer, GatewayClient
from clients.errors import (
    AccessDenied,
    FrameConflict,
    GatewayError,
    GatewayUnavailable,
    GatewayUnreachable,
    InvalidRequest,
    ProtocolError,
    SessionNotFound,
)
from robosac import wire

PROBLEM = {"type": "urn:robosac:problem:wrong-shape", "detail": "must be [1]", "field": "tensors.x.shape"}


def gateway(handler) -> GatewayClient:
    return GatewayClient("http://gateway", transport=httpx.MockTransport(handler))


@pytest.mark.parametrize(
    ("status", "kind"),
    [
        (400, InvalidRequest),
        (401, AccessDenied),
        (403, AccessDenied),
        (404, SessionNotFound),
        (409, FrameConflict),
        (413, InvalidRequest),
        (422, InvalidRequest),
        (500, GatewayUnavailable),
        (503, GatewayUnavailable),
    ],
)
async def test_problems_become_exceptions(status, kind):
    async with gateway(lambda _: httpx.Response(status, json=PROBLEM, headers={"Retry-After": "7"})) as client:
        with pytest.raises(kind) as caught:
            await client.detectors()
    error = caught.value
    assert (error.status, error.type, error.field) == (status, PROBLEM["type"], PROBLEM["field"])
    assert error.retry_after_s == 7.0
    assert "wrong-shape: tensors.x.shape: must be [1]" in str(error)


async def test_one_text_is_no_team():
    async with gateway(lambda _: httpx.Response(500)) as client:
        with pytest.raises(TypeError, match="teammates must be a sequence of ids, got 'car-2'"):
            await client.open_session("car-1", "car-2")


async def test_what_is_not_signed_already_is_rounded_for_its_way(ego_message, benign):
    bodies = []

    def refuse(request):
        bodies.append(wire.unpack(request.content))
        return httpx.Response(422, json=PROBLEM)

    async with gateway(refuse) as client:
        ego = client.vehicle("s", "car-1", "token", packing=wire.Packing("int8", compress=True))
        for act in (
            lambda: ego.post_frame(0, ego_message, benign, {"rsu": bytes(64)}),
            lambda: ego.ask(0, ego_message),
            lambda: ego.send(0, ego_message),
        ):
            with pytest.raises(InvalidRequest):
                await act()
    frame, *own = bodies
    sent = {"car-1": frame["ego"], **frame["teammates"]}
    types = {name: each["tensors"]["features"]["dtype"] for name, each in sent.items()}
    assert types == {name: "float16" if name == "rsu" else "int8" for name in ("car-1", *benign)}
    assert [each["tensors"]["features"]["dtype"] for each in own] == ["int8"] * 2
    assert all(each["tensors"]["features"]["compression"] == "zstd" for each in (*sent.values(), *own))


async def test_a_refusal_without_a_problem_is_still_one():
    async with gateway(lambda _: httpx.Response(502, text="<html>")) as client:
        with pytest.raises(GatewayUnavailable, match="502"):
            await client.detectors()


@pytest.mark.parametrize(
    ("status", "problem", "path", "again"),
    [
        (503, "draining", "/v1/sessions", True),
        (503, "draining", "/v1/sessions/s/frames", True),
        (503, "store-unavailable", "/v1/sessions/s/frames", True),
        (503, "store-unavailable", "/v1/sessions/s/messages", True),
        (503, "store-unavailable", "/v1/sessions", False),  # nobody knows whether the session was opened
        (503, "overloaded", "/v1/sessions/s/frames", False),
        (502, "", "/v1/sessions/s/frames", True),
        (502, "", "/v1/sessions", False),
        (500, "internal-error", "/v1/sessions/s/frames", False),
    ],
)
async def test_what_does_no_harm_is_sent_again(status, problem, path, again):
    asked = []

    def answer(request):
        asked.append(request.url.path)
        if len(asked) > 2:
            return httpx.Response(200)
        return httpx.Response(status, json={"type": f"urn:robosac:problem:{problem}"})

    async with gateway(answer) as client:
        if again:
            assert (await client._request("POST", path)).is_success
        else:
            with pytest.raises(GatewayUnavailable):
                await client._request("POST", path)
    assert asked == [path] * (3 if again else 1)


async def test_a_token_whose_answer_was_lost_is_asked_for_again_with_the_same_key_and_a_new_proof():
    asked = []

    def answer(request):
        asked.append((request.headers["Idempotency-Key"], request.headers["DPoP"]))
        if len(asked) % 2:
            raise httpx.ReadError("lost")
        return httpx.Response(201, json={"token": f"fresh {len(asked)}", "expires_at": "2026-11-28T00:00:00Z"})

    async with gateway(answer) as client:
        ego = client.vehicle("s", "car-1", "old", Ed25519PrivateKey.generate())
        assert [(await ego.renew()).token, (await ego.renew()).token] == ["fresh 2", "fresh 4"]
    keys, proofs = zip(*asked, strict=True)
    assert (keys[0], keys[2]) == (keys[1], keys[3])
    assert len(set(keys)) == 2
    assert len(set(proofs)) == 4


async def test_nothing_is_sent_again_for_ever(monkeypatch):
    monkeypatch.setattr("clients.client.AGAIN_FOR_S", 0.1)
    asked = []

    def answer(_):
        asked.append(1)
        return httpx.Response(503, json={"type": STORE_UNAVAILABLE})

    async with gateway(answer) as client:
        with pytest.raises(GatewayUnavailable, match="store-unavailable"):
            await client._request("POST", "/v1/sessions/s/frames")
    assert 2 <= len(asked) <= 4


@pytest.mark.parametrize("error", [httpx.ConnectError("refused"), httpx.ReadTimeout("slow")])
async def test_a_gateway_that_does_not_answer_is_unreachable(error):
    def fail(_):
        raise error

    async with gateway(fail) as client:
        assert not await client.ready()
        with pytest.raises(GatewayUnreachable):
            await client.detectors()


@pytest.mark.parametrize("content", ["<html>hello</html>", "<html>\n</html>\n", '{"seq":1}\n{"se', "null"])
async def test_what_is_no_log_is_a_protocol_error(content):
    async with gateway(lambda _: httpx.Response(200, text=content)) as client:
        with pytest.raises(ProtocolError, match="a line each"):
            await client.vehicle("s", "e", "t").audit_lines()


async def test_a_redirection_is_told_with_where_it_leads():
    def elsewhere(_):
        return httpx.Response(308, headers={"Location": "https://gateway/v1/detectors"})

    async with gateway(elsewhere) as client:
        with pytest.raises(ProtocolError, match="redirected to https://gateway/v1/detectors"):
            await client.detectors()


async def test_a_refusal_that_is_no_problem_is_told_by_its_status():
    async with gateway(lambda _: httpx.Response(500, text="<html>")) as client:
        with pytest.raises(GatewayUnavailable, match=r"^500: Internal Server Error$"):
            await client.detectors()


async def test_an_unreachable_gateway_is_told_with_its_prefix_and_without_a_password():
    def fail(_):
        raise httpx.ConnectError("refused")

    transport = httpx.MockTransport(fail)
    async with GatewayClient("http://me:secret@gateway/gw/", transport=transport) as client:
        with pytest.raises(GatewayUnreachable, match=r"^GET http://gateway/gw/v1/detectors: "):
            await client.detectors()


@pytest.mark.parametrize(
    ("media_type", "content"),
    [
        ("text/html", "<html>"),
        ("text/event-stream", ""),
        ("text/event-stream", "event: standing\ndata: {\n\n"),
        ("text/event-stream", "event: standing\ndata: {}\n\n"),
        ("text/event-stream", "event: standing\ndata: 5\n\n"),
    ],
)
async def test_whoever_stands_by_asks_seldom_where_no_gateway_answers(media_type, content):
    asked = []

    def answer(_):
        asked.append(1)
        return httpx.Response(200, text=content, headers={"Content-Type": media_type})

    async with gateway(answer) as client, client.vehicle("s", "rsu", "t").standing_by():
        await asyncio.sleep(0.3)
    assert 2 <= len(asked) <= 6


@pytest.mark.parametrize("content", [b"", b"junk", b"\x80", wire.pack({"frame": 1, "boxes": 3})])
async def test_an_answer_that_is_no_frame_result_is_a_protocol_error(content, ego_message):
    async with gateway(lambda _: httpx.Response(200, content=content)) as client:
        with pytest.raises(ProtocolError):
            await client.vehicle("s", "e", "t").ask(0, ego_message)
        with pytest.raises(ProtocolError):
            await client.open_session("e", ["a"])


async def test_a_vehicle_sends_its_token_and_asks_for_msgpack(ego_message):
    seen = []

    def answer(request):
        seen.append(request)
        return httpx.Response(202, content=wire.pack({}))

    async with gateway(answer) as client:
        await client.vehicle("s1", "car-2", "token").send(3, ego_message)
    (request,) = seen
    assert request.url.path == "/v1/sessions/s1/messages"
    assert request.headers["authorization"] == "Bearer token"
    assert request.headers["content-type"] == request.headers["accept"] == "application/vnd.msgpack"
    envelope = wire.read_message(request.content)
    assert (envelope.frame, envelope.vehicle_id) == (3, "car-2")


def test_a_frame_without_boxes_has_an_empty_array():
    fields = {
        "frame": 0, "boxes": [], "source": "ego_only", "accepted": [], "rejected": [], "hypotheses": [],
        "sampling_steps": 0, "attacker_ratio": None, "deadline_met": True, "degraded_by": None, "timings_ms": {},
    }  # fmt: skip
    assert FrameAnswer.model_validate(fields).boxes.shape == (0, 6)
    np.testing.assert_array_equal(
        FrameAnswer.model_validate({**fields, "boxes": [[1, 2, 3, 4, 5, 6]]}).boxes, [[1, 2, 3, 4, 5, 6]]
    )


def test_every_exception_has_one_root():
    for kind in (GatewayUnreachable, ProtocolError, AccessDenied, FrameConflict, InvalidRequest):
        assert issubclass(kind, GatewayError)
