import asyncio
import dataclasses

import numpy as np
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from robosac import wire
from robosac.detectors import Message
from robosac.detectors.narrow import rounded
from robosac.signatures import show_public_key, sign
from service.sessions.pages import PAGE_BYTES
from tests.service.conftest import EGO, TEAM, problem, serve

NONE = {"kind": "none"}


def moved(message, dx):
    pose = np.array(message.pose)
    pose[0, 3] += dx
    return Message(pose, message.tensors)


def altered(message):
    features = np.array(message.tensors["features"])
    features[0, 0, 0] += 1
    return dataclasses.replace(message, tensors={"features": features})


async def events(ego, kind):
    return [record for record in await ego.audit() if record["event"] == kind]


async def test_two_different_messages_for_a_frame_are_an_equivocation_and_neither_counts(served, messages):
    session = await served.open(gather_ms=20, defense=NONE)
    ego, token = served.ego(session), session.teammate_tokens["car-2"]
    first, second = (wire.pack_message(3, "car-2", m) for m in (messages["car-2"], altered(messages["car-2"])))
    assert (await served.post(session, "messages", first, token)).status_code == 202
    problem(await served.post(session, "messages", second, token), 409, "equivocation")
    answer = await ego.ask(3, messages[EGO])
    assert (answer.rejected["car-2"].reason, answer.rejected["car-2"].distrust) == ("distrusted", "equivocation")
    assert answer.named == ()
    (record,) = await events(ego, "equivocation")
    assert (record["vehicle_id"], record["frame"]) == ("car-2", 3)
    digests = [wire.content_digest(3, "car-2", m) for m in (messages["car-2"], altered(messages["car-2"]))]
    assert [record["first"]["digest"], record["second"]["digest"]] == digests


async def test_refusals_hide_no_equivocation(served, messages):
    session = await served.open(gather_ms=50)
    token = session.teammate_tokens["car-2"]
    for _ in range(20):
        await served.post(session, "messages", b"?", token)
    for message in (messages["car-2"], altered(messages["car-2"])):
        body = wire.pack_message(0, "car-2", message)
        answer = await served.post(session, "messages", body, token)
    problem(answer, 409, "equivocation")
    (record,) = await events(served.ego(session), "equivocation")
    assert record["vehicle_id"] == "car-2"
    for frame in range(1, 5):
        for message in (messages["car-2"], altered(messages["car-2"])):
            await served.post(session, "messages", wire.pack_message(frame, "car-2", message), token)
    assert [record["frame"] for record in await events(served.ego(session), "equivocation")] == [0, 1, 2, 3]


async def test_an_equivocation_is_found_after_the_frame_was_answered(served, messages, benign):
    session = await served.open(gather_ms=20, defense=NONE)
    ego, teammate = served.ego(session), served.teammate(session, "rsu")
    await teammate.send(3, messages["rsu"])
    assert (await ego.ask(3, messages[EGO])).accepted == ("rsu",)
    late = wire.pack_message(3, "rsu", altered(messages["rsu"]))
    problem(await served.post(session, "messages", late, session.teammate_tokens["rsu"]), 409, "equivocation")
    again = wire.pack_frame(3, altered(messages[EGO]), benign)
    problem(await served.post(session, "frames", again), 409, "stale-frame")
    assert [record["vehicle_id"] for record in await events(ego, "equivocation")] == ["rsu", EGO]


async def test_the_ego_cannot_leap(served, messages, benign):
    session = await served.open()
    ego = served.ego(session)
    await ego.post_frame(0, messages[EGO], benign)
    body = wire.pack_frame(1, moved(messages[EGO], 40.0), {})
    refusal = problem(await served.post(session, "frames", body), 422, "implausible-pose")
    assert refusal["field"] == "ego.pose"
    assert "16 m are possible" in refusal["detail"]
    assert (await ego.post_frame(2, moved(messages[EGO], 15.0), benign)).frame == 2
    (record,) = await events(ego, "message_refused")
    assert (record["reason"], record["field"]) == ("malformed", "ego.pose")


async def test_a_pose_that_cannot_be_is_told_by_its_place_in_the_body_that_was_sent(served, messages):
    session = await served.open(gather_ms=20, defense=NONE)
    ego, teammate = served.ego(session), served.teammate(session, "rsu")
    await teammate.send(0, messages["rsu"])
    assert (await ego.ask(0, messages[EGO])).accepted == ("rsu",)
    await teammate.send(1, moved(messages["rsu"], 25.0))
    assert (await ego.ask(1, messages[EGO])).rejected["rsu"].field == "pose"
    leap = wire.pack_message(2, EGO, moved(messages[EGO], 40.0))
    assert problem(await served.post(session, "messages", leap), 422, "implausible-pose")["field"] == "pose"


@pytest.mark.parametrize(("settings", "dx"), [({}, 25.0), ({"max_range_m": 60.0}, 100.0)])
async def test_a_teammate_that_cannot_be_where_it_says_is_left_out(settings, dx, messages, benign):
    async with serve(**settings) as served:
        session = await served.open(defense=NONE)
        ego = served.ego(session)
        assert (await ego.post_frame(0, messages[EGO], benign)).accepted == TEAM
        answer = await ego.post_frame(1, messages[EGO], {**benign, "rsu": moved(benign["rsu"], dx)})
        assert answer.rejected["rsu"].reason == "malformed"
        assert answer.rejected["rsu"].field == "teammates.rsu.pose"
        assert answer.accepted == TEAM[:-1]
        assert (await ego.post_frame(2, messages[EGO], benign)).accepted == TEAM


async def test_the_frame_period_decides_what_is_a_leap(served, messages, benign):
    session = await served.open(defense=NONE, frame_period_ms=1000.0)
    ego = served.ego(session)
    await ego.post_frame(0, messages[EGO], benign)
    assert (await ego.post_frame(1, moved(messages[EGO], 40.0), benign)).accepted == TEAM


async def test_vehicles_with_keys_must_sign(served, messages):
    keys = {name: Ed25519PrivateKey.generate() for name in (EGO, "rsu")}
    shown = {name: show_public_key(key) for name, key in keys.items()}
    session = await served.open(gather_ms=20, defense=NONE, public_keys=shown)
    token = session.teammate_tokens["rsu"]
    unsigned = wire.pack_message(0, "rsu", messages["rsu"])
    assert (
        problem(await served.post(session, "messages", unsigned, token), 401, "bad-signature")["field"] == "signature"
    )
    digest = wire.content_digest(0, "rsu", messages["rsu"])
    named = (session.session_id, "rsu", 0, digest)
    forged = [
        sign(keys[EGO], *named),
        *(sign(keys["rsu"], *named[:i], other, *named[i + 1 :]) for i, other in enumerate(("0" * 32, EGO, 1))),
        bytes(64),
    ]
    for signature in forged:
        body = wire.pack_message(0, "rsu", messages["rsu"], signature)
        problem(await served.post(session, "messages", body, token), 401, "bad-signature")
    unit = served.client.vehicle(session.session_id, "rsu", token, keys["rsu"])
    await unit.send(0, messages["rsu"])
    problem(await served.post(session, "messages", wire.pack_message(0, EGO, messages[EGO])), 401, "bad-signature")
    ego = served.client.vehicle(session.session_id, EGO, session.ego_token, keys[EGO])
    assert (await ego.ask(0, messages[EGO])).accepted == ("rsu",)
    (answered,) = await events(ego, "frame_answered")
    assert set(answered["messages"]) == {EGO, "rsu"}
    assert all(set(proof) == {"digest", "signature"} for proof in answered["messages"].values())
    assert [r["reason"] for r in await events(ego, "message_refused")] == ["unauthenticated"] * 7


async def test_vehicles_that_sign_may_send_their_maps_as_compressed_bytes(served, messages):
    keys = {name: Ed25519PrivateKey.generate() for name in (EGO, "rsu")}
    shown = {name: show_public_key(key) for name, key in keys.items()}
    (entry,) = await served.client.detectors()
    (dtype,) = entry["narrower"]["features"]
    packing = wire.Packing(dtype, compress=True)
    session = await served.open(gather_ms=20, defense=NONE, public_keys=shown)
    tokens = {EGO: session.ego_token, **session.teammate_tokens}
    unit, ego = (
        served.client.vehicle(session.session_id, name, tokens[name], keys[name], packing) for name in ("rsu", EGO)
    )
    await unit.send(0, messages["rsu"])
    asked = await ego.ask(0, messages[EGO])
    assert asked.accepted == ("rsu",)
    own, other = (rounded(messages[name], dtype) for name in (EGO, "rsu"))
    here = served.detector.prepare(own, {"rsu": other}).detect(["rsu"])
    np.testing.assert_allclose(asked.boxes, here, atol=1e-6)
    signed = {"rsu": unit.signature(1, other)}
    whole = await ego.post_frame(1, messages[EGO], {"rsu": other, "car-2": messages["car-2"]}, signed)
    assert whole.accepted == ("car-2", "rsu")
    assert len(await events(ego, "message_refused")) == 0


async def test_the_ego_cannot_put_words_into_the_mouth_of_a_teammate_that_signs(served, messages, benign):
    key = Ed25519PrivateKey.generate()
    session = await served.open(defense=NONE, public_keys={"rsu": show_public_key(key)})
    ego = served.ego(session)
    invented = await ego.post_frame(0, messages[EGO], benign)
    assert invented.rejected["rsu"].reason == "unauthenticated"
    assert invented.rejected["rsu"].field == "teammates.rsu.signature"
    signature = sign(key, session.session_id, "rsu", 1, wire.content_digest(1, "rsu", benign["rsu"]))
    assert (await ego.post_frame(1, messages[EGO], benign, {"rsu": signature})).accepted == TEAM


GOOD_KEY = show_public_key(Ed25519PrivateKey.generate())


@pytest.mark.parametrize(
    ("keys", "field"),
    [
        ({"rsu": "AAAA"}, "public_keys.rsu"),
        ({"car-9": GOOD_KEY}, "public_keys"),
        ({"rsu": "A" * 43 + "="}, "public_keys.rsu"),
    ],
)
async def test_bad_keys_are_refused(served, keys, field):
    body = {"ego_id": EGO, "teammates": ["rsu"], "public_keys": keys}
    response = await served.http.post("/v1/sessions", json=body)
    assert problem(response, 422, "invalid-request")["field"] == field


async def test_newcomers_may_bring_keys(served, messages):
    key = Ed25519PrivateKey.generate()
    session = await served.client.open_session(EGO, ["car-2"], defense=NONE, latency_budget_ms=20_000, gather_ms=20)
    ego = served.ego(session)
    tokens = await ego.enrol(["rsu"], {"rsu": show_public_key(key)})
    unsigned = wire.pack_message(0, "rsu", messages["rsu"])
    problem(await served.post(session, "messages", unsigned, tokens["rsu"]), 401, "bad-signature")
    await ego.dismiss("rsu")
    tokens = await ego.enrol(["rsu"])
    assert (await served.post(session, "messages", unsigned, tokens["rsu"])).status_code == 202


async def test_messages_that_wait_are_bounded_over_all_sessions(messages):
    async with serve(max_pending_bytes=2**20) as served:
        sessions = [await served.open() for _ in range(9)]
        body = wire.pack_message(0, "rsu", messages["rsu"])
        posted = [await served.post(s, "messages", body, s.teammate_tokens["rsu"]) for s in sessions]
        assert [response.status_code for response in posted[:8]] == [202] * 8
        assert posted[8].headers["retry-after"] == "1"
        problem(posted[8], 503, "overloaded")
        await served.ego(sessions[0]).close()
        assert served.gateway.sessions.backlog.nbytes == 7 * 2**17
        response = await served.post(sessions[8], "messages", body, sessions[8].teammate_tokens["rsu"])
        assert response.status_code == 202


async def test_messages_are_kept_for_replays_if_wanted(messages, benign):
    async with serve(keep_frames=2) as served:
        session = await served.open(defense=NONE)
        ego = served.ego(session)
        for frame in (0, 1, 2):
            await ego.post_frame(frame, messages[EGO], benign)
        kept = wire.read_frame(await ego.kept_messages(2))
        info = served.gateway.engine.detectors["intersection-mean"].info
        message = wire.check_message(kept.teammates["rsu"], info, "teammate")
        proof = (await ego.audit())[-1]["messages"]["rsu"]
        assert wire.content_digest(2, "rsu", message) == proof["digest"]
        headers = {"Authorization": f"Bearer {session.ego_token}"}
        url = f"/v1/sessions/{session.session_id}/frames/0/messages"
        problem(await served.http.get(url, headers=headers), 404, "messages-not-kept")


async def test_kept_messages_are_in_hand_until_they_are_read(messages, benign):
    async with serve(keep_frames=1, max_inflight_bytes=2**20) as served:
        session = await served.open(defense=NONE)
        await served.ego(session).post_frame(0, messages[EGO], benign)
        kept, room = await served.ego(session).kept_messages(0), served.gateway.bodies
        taken = []

        async def receive():
            await asyncio.Event().wait()

        async def send(message):
            taken.append(message)
            if message["type"] == "http.response.body":
                await asyncio.Event().wait()

        headers = [(b"authorization", f"Bearer {session.ego_token}".encode()), (b"host", b"gateway")]
        url = f"/v1/sessions/{session.session_id}/frames/0/messages"
        scope = {"type": "http", "method": "GET", "path": url, "query_string": b"", "headers": headers}
        unread = asyncio.create_task(served.http._transport.app({**scope, "client": ("127.0.0.1", 1)}, receive, send))
        while len(taken) < 2:
            await asyncio.sleep(0.005)
        assert dict(taken[0]["headers"])[b"content-length"] == str(len(kept)).encode()
        assert len(taken[1]["body"]) == PAGE_BYTES
        assert room.nbytes == len(kept)
        answer = await served.http.get(url, headers={"Authorization": f"Bearer {session.ego_token}"})
        problem(answer, 503, "overloaded")
        unread.cancel()
        await asyncio.gather(unread, return_exceptions=True)
        assert room.nbytes == 0
