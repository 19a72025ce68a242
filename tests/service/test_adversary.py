"""What an adversary may try, one test each: refused or contained, with the reason on record, and nobody else harmed."""

import asyncio
import gzip
import json
import struct
import time

import numpy as np
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from robosac import wire
from robosac.audit import verify
from robosac.detectors import Message
from robosac.detectors.decoding import MAX_PEAKS
from robosac.signatures import show_public_key, sign
from service.watching.logs import LINES
from tests.service.conftest import EGO, TEAM, problem, serve

NONE = {"kind": "none"}


async def refusals(served, session):
    """Reasons and details on record, and that the session still answers."""
    records = await served.ego(session).audit()
    return [(r.get("vehicle_id"), r.get("reason", r["event"])) for r in records if r["event"] in _REFUSALS]


_REFUSALS = ("message_refused", "equivocation")


@pytest.fixture
async def session(served):
    return await served.open(defense=NONE, gather_ms=20)


async def still_serves(served, session, messages, benign, frame=1000):
    assert (await served.ego(session).post_frame(frame, messages[EGO], benign)).accepted == TEAM


async def test_a_stolen_token_does_not_let_another_vehicle_speak(served, session, messages, benign):
    body = wire.pack_message(0, "car-3", messages["car-3"])
    problem(await served.post(session, "messages", body, session.teammate_tokens["car-2"]), 403, "wrong-vehicle")
    assert await refusals(served, session) == [("car-2", "unauthenticated")]
    await still_serves(served, session, messages, benign)


async def test_a_stolen_token_is_not_enough_where_the_owner_signs(served, messages):
    owner, thief = Ed25519PrivateKey.generate(), Ed25519PrivateKey.generate()
    session = await served.open(defense=NONE, public_keys={"rsu": show_public_key(owner)})
    signature = sign(thief, session.session_id, "rsu", 0, wire.content_digest(0, "rsu", messages["rsu"]))
    body = wire.pack_message(0, "rsu", messages["rsu"], signature)
    problem(await served.post(session, "messages", body, session.teammate_tokens["rsu"]), 401, "bad-signature")
    assert await refusals(served, session) == [("rsu", "unauthenticated")]


async def test_a_teammate_cannot_pose_as_the_ego(served, session, messages, benign):
    token = session.teammate_tokens["car-2"]
    problem(await served.post(session, "frames", wire.pack_frame(0, messages[EGO], benign), token), 403, "ego-only")
    body = wire.pack_message(0, EGO, messages[EGO])
    problem(await served.post(session, "messages", body, token), 403, "wrong-vehicle")
    headers = {"Authorization": f"Bearer {token}"}
    for method, path in (("GET", ""), ("GET", "/audit"), ("DELETE", ""), ("DELETE", "/teammates/car-3")):
        url = f"/v1/sessions/{session.session_id}{path}"
        problem(await served.http.request(method, url, headers=headers), 403, "ego-only")
    assert await refusals(served, session) == [("car-2", "unauthenticated")] * 6
    await still_serves(served, session, messages, benign, 0)


async def test_an_expired_token_is_worth_nothing(messages, benign):
    late = [0.0]
    async with serve(clock=lambda: time.time() + late[0]) as served:
        session = await served.open(defense=NONE)
        await still_serves(served, session, messages, benign, 0)
        late[0] = 2 * 86_400
        body = wire.pack_message(1, "rsu", messages["rsu"])
        refused = await served.post(session, "messages", body, session.teammate_tokens["rsu"])
        problem(refused, 401, "token-expired")
        problem(await served.post(session, "frames", wire.pack_frame(1, messages[EGO], benign)), 401, "token-expired")
        late[0] = 0.0
        refused = [r for r in await served.ego(session).audit() if r["event"] == "access_refused"]
    assert [(r["vehicle_id"], r["detail"]) for r in refused] == [(v, "the token has expired") for v in ("rsu", EGO)]


async def test_a_replayed_frame_is_answered_once(served, session, good_frame):
    assert (await served.post(session, "frames", good_frame(4))).status_code == 200
    problem(await served.post(session, "frames", good_frame(4)), 409, "stale-frame")
    assert await refusals(served, session) == [(EGO, "replayed")]


async def test_two_versions_of_a_message_are_an_equivocation(served, session, messages, benign):
    token = session.teammate_tokens["rsu"]
    other = Message(messages["rsu"].pose, {"features": messages["rsu"].tensors["features"] * 0})
    for message, status in ((messages["rsu"], 202), (other, 409)):
        body = wire.pack_message(0, "rsu", message)
        assert (await served.post(session, "messages", body, token)).status_code == status
    assert (await served.ego(session).ask(0, messages[EGO])).rejected["rsu"].reason == "distrusted"
    assert await refusals(served, session) == [("rsu", "equivocation")]
    await still_serves(served, session, messages, benign)


@pytest.mark.parametrize("name", ["a" * 65, "a" * 64 + "/", EGO, "", "?", "\x00", "é" * 100])
async def test_a_stranger_is_never_taken_for_somebody_of_the_session(name, served, messages, benign):
    team = ("a" * 64, "rsu")
    session = await served.client.open_session(EGO, team, latency_budget_ms=20_000, defense=NONE)
    sent = {team[0]: benign["car-2"], "rsu": benign["rsu"], name: benign["car-3"]}
    answer = await served.ego(session).post_frame(0, messages[EGO], sent)
    assert answer.accepted == team
    assert not {EGO, *team} & set(answer.rejected)
    assert [why.reason for why in answer.rejected.values()] == ["unauthenticated"] * (name != EGO)
    bearer = {"Authorization": f"Bearer {session.ego_token}"}
    log = await served.http.get(f"/v1/sessions/{session.session_id}/audit", headers=bearer)
    assert verify(log.content.splitlines(keepends=True)) == []


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
async def test_what_is_no_number_goes_into_no_fusion(value, served, session, messages, benign):
    features = np.array(benign["rsu"].tensors["features"])
    features[1, 2, 3] = value
    poisoned = {**benign, "rsu": Message(benign["rsu"].pose, {"features": features})}
    answer = await served.ego(session).post_frame(0, messages[EGO], poisoned)
    assert answer.accepted == TEAM[:-1]
    assert answer.rejected["rsu"].field == "teammates.rsu.tensors.features.data"
    pose = np.array(benign["rsu"].pose)
    pose[0, 3] = value
    body = wire.pack_message(1, "rsu", Message(pose, benign["rsu"].tensors))
    problem(await served.post(session, "messages", body, session.teammate_tokens["rsu"]), 422, "non-finite")
    assert await refusals(served, session) == [("rsu", "malformed")]


async def test_a_claim_of_four_gibibytes_costs_nothing(served, session, messages, benign):
    token = session.teammate_tokens["rsu"]
    announced = await served.post(session, "messages", b"x", token, **{"Content-Length": str(4 * 2**30)})
    problem(announced, 413, "too-large")
    claim = b"\x81" + wire.pack("tensors") + b"\xc6" + struct.pack(">I", 2**32 - 1) + b"xx"
    problem(await served.post(session, "messages", claim, token), 400, "malformed-msgpack")
    array = b"\x81" + wire.pack("pose") + b"\xdd" + struct.pack(">I", 2**32 - 1)
    problem(await served.post(session, "messages", array, token), 400, "malformed-msgpack")
    assert {reason for _, reason in await refusals(served, session)} == {"malformed"}
    await still_serves(served, session, messages, benign)


async def test_compressed_bodies_are_not_taken(served, session, messages, benign):
    bomb = gzip.compress(bytes(2**26))
    refused = await served.post(session, "frames", bomb, **{"Content-Encoding": "gzip"})
    problem(refused, 415, "unsupported-encoding")
    assert await refusals(served, session) == [(EGO, "malformed")]
    await still_serves(served, session, messages, benign)


async def test_a_vehicle_that_teleports_is_left_out(served, session, messages, benign):
    await still_serves(served, session, messages, benign, 0)
    pose = np.array(benign["rsu"].pose)
    pose[:2, 3] += 100.0
    moved = {**benign, "rsu": Message(pose, benign["rsu"].tensors)}
    answer = await served.ego(session).post_frame(1, messages[EGO], moved)
    assert answer.accepted == TEAM[:-1]
    assert "possible" in answer.rejected["rsu"].detail
    assert (await served.ego(session).audit())[-1]["rejected"][-1]["detail"] == answer.rejected["rsu"].detail


async def test_a_flood_of_boxes_costs_little_more_than_a_usual_frame(served, detector, messages, benign):
    rng = np.random.default_rng(0)
    shape = benign["rsu"].tensors["features"].shape
    loud = Message(benign["rsu"].pose, {"features": rng.normal(0, 100, shape).astype(np.float16)})
    prepared = detector.prepare(messages[EGO], {"rsu": loud})
    flooded = prepared.detect(("rsu",))
    assert 100 < len(flooded) <= MAX_PEAKS
    session = await served.open(defense={"kind": "sample_consensus", "sampling_budget": 31, "collaborators": 1})
    answer = await served.ego(session).post_frame(0, messages[EGO], {**benign, "rsu": loud})
    assert answer.source == "consensus"
    assert "rsu" not in answer.accepted


async def test_a_slow_body_holds_neither_session_nor_ego(messages, benign):
    async with serve(body_timeout_s=0.5) as served:
        session = await served.open(defense=NONE)
        released = asyncio.Event()

        async def stalled():
            yield b"\x83"
            await released.wait()

        token = session.teammate_tokens["rsu"]
        stalling = asyncio.create_task(served.post(session, "messages", stalled(), token))
        await asyncio.sleep(0.05)
        await still_serves(served, session, messages, benign)
        problem(await stalling, 408, "slow-body")
        released.set()
        assert await refusals(served, session) == [("rsu", "malformed")]


async def test_hundreds_of_sessions_cost_little_and_the_next_is_refused(messages, benign):
    async with serve(max_sessions=800) as served:
        session = await served.open(defense=NONE)
        bodies = [json.dumps({"ego_id": f"car-{n}", "teammates": ["rsu"]}).encode() for n in range(800)]
        headers = {"Content-Type": "application/json"}
        statuses = [(await served.http.post("/v1/sessions", content=b, headers=headers)).status_code for b in bodies]
        assert statuses == [201] * 799 + [503]
        started = time.perf_counter()
        await still_serves(served, session, messages, benign)
        assert (await served.http.get("/readyz")).status_code == 200
        assert time.perf_counter() - started < 20  # not a measure of speed: it must not hang


@pytest.mark.parametrize("name", ['x"\n{"event":"forged"}', "x\r\ny", "x\x1b[2J", "x\u2028y", "{jndi:ldap://x}"])
async def test_ids_cannot_write_log_lines(name, served, session, messages, capsys):
    refused = await served.http.post("/v1/sessions", json={"ego_id": name, "teammates": ["rsu"]})
    assert problem(refused, 422, "invalid-request")["field"] == "ego_id"
    body = wire.pack_message(0, name, messages["rsu"])
    problem(await served.post(session, "messages", body, session.teammate_tokens["rsu"]), 403, "wrong-vehicle")
    answer = await served.ego(session).post_frame(0, messages[EGO], {name: messages["rsu"]})
    assert answer.rejected[name].reason == "unauthenticated"
    lines = (await served.http.get(
        f"/v1/sessions/{session.session_id}/audit", headers={"Authorization": f"Bearer {session.ego_token}"}
    )).content.split(b"\n")  # fmt: skip
    assert [json.loads(line)["event"] for line in lines if line] == [
        "session_opened", "message_refused", "frame_answered",
    ]  # fmt: skip
    LINES.flush(10)
    logged = [json.loads(line)["event"] for line in capsys.readouterr().err.splitlines() if line.startswith("{")]
    assert "forged" not in logged


@pytest.mark.parametrize("name", ["../../etc/passwd", "..", "/etc/passwd", "a/b", "%2e%2e%2f", "a\x00b", ".hidden"])
async def test_ids_are_no_paths(name, served, session):
    refused = await served.http.post("/v1/sessions", json={"ego_id": EGO, "teammates": [name]})
    assert problem(refused, 422, "invalid-request")["field"].startswith("teammates")
    response = await served.http.get("/v1/sessions/" + name.replace("\x00", "%00") + "/audit")
    problem(response, response.status_code, response.json()["type"].rsplit(":", 1)[1])
    assert response.status_code in (401, 404)
