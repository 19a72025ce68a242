from collections import Counter

import msgpack
import numpy as np
import pytest

from clients.errors import FrameConflict
from robosac import wire
from robosac.audit import verify
from robosac.detectors import Message
from tests.service.conftest import EGO, problem, serve


def altered(body, path, value):
    fields = msgpack.unpackb(body)
    *parents, last = path.split(".")
    target = fields
    for name in parents:
        target = target[name]
    target[last] = value
    return msgpack.packb(fields)


NAN = np.full((64, 32, 32), np.nan, dtype=np.float16).tobytes()
HUGE_CLAIM = b"\x83\xa5frame\x01\xa3ego\xc6\xff\xff\xff\xff"

# what is done to a message, and the status, type and field that must answer it
DAMAGE = {
    "truncated": (lambda body: body[:-100], 400, "malformed-msgpack", ""),
    "trailing": (lambda body: body + b"\x00", 400, "malformed-msgpack", ""),
    "empty": (lambda body: b"", 400, "malformed-msgpack", ""),
    "a claim of 4 GiB": (lambda body: HUGE_CLAIM, 400, "malformed-msgpack", ""),
    "no map": (lambda body: b"\x01", 422, "wrong-type", ""),
    "wrong type": (
        lambda body: altered(body, "tensors.features.data", "text"),
        422,
        "wrong-type",
        "tensors.features.data",
    ),
    "wrong dtype": (
        lambda body: altered(body, "tensors.features.dtype", "float32"),
        422,
        "wrong-dtype",
        "tensors.features.dtype",
    ),
    "wrong shape": (
        lambda body: altered(body, "tensors.features.shape", [64, 32, 33]),
        422,
        "wrong-shape",
        "tensors.features.shape",
    ),
    "a shape of 4 GiB": (
        lambda body: altered(body, "tensors.features.shape", [65536, 65536]),
        422,
        "wrong-shape",
        "tensors.features.shape",
    ),
    "wrong length": (
        lambda body: altered(body, "tensors.features.data", b"1234"),
        422,
        "wrong-length",
        "tensors.features.data",
    ),
    "NaN": (lambda body: altered(body, "tensors.features.data", NAN), 422, "non-finite", "tensors.features.data"),
    "bad pose": (lambda body: altered(body, "pose", [0.0] * 16), 422, "bad-pose", "pose"),
    "no frame": (lambda body: altered(body, "frame", None), 422, "wrong-type", "frame"),
}
damage = pytest.mark.parametrize(("spoil", "status", "slug", "field"), list(DAMAGE.values()), ids=list(DAMAGE))


@damage
async def test_a_bad_message_is_refused_recorded_and_costs_its_sender_only(
    served, messages, spoil, status, slug, field
):
    session = await served.open(gather_ms=20)
    ego = served.ego(session)
    body = spoil(wire.pack_message(0, "car-2", messages["car-2"]))
    token = session.teammate_tokens["car-2"]
    fields = problem(await served.post(session, "messages", body, token), status, slug)
    assert fields.get("field", "") == field
    for name in ("car-3", "car-4", "car-5", "rsu"):
        await served.teammate(session, name).send(0, messages[name])
    answer = await ego.ask(0, messages["car-1"])
    assert answer.source == "consensus"
    assert answer.rejected["car-2"].reason == "malformed"
    (refusal,) = [record for record in await ego.audit() if record["event"] == "message_refused"]
    assert (refusal["vehicle_id"], refusal["reason"], refusal["field"]) == ("car-2", "malformed", field)
    await served.teammate(session, "car-2").send(1, messages["car-2"])
    answer = await ego.ask(1, messages["car-1"])
    assert answer.accepted == ("car-2",)


@damage
async def test_a_bad_message_of_the_ego_is_refused_and_its_next_frame_is_answered(
    served, messages, good_frame, spoil, status, slug, field
):
    session = await served.open(gather_ms=0)
    body = spoil(wire.pack_message(0, "car-1", messages["car-1"]))
    problem(await served.post(session, "messages", body), status, slug)
    assert (await served.post(session, "frames", good_frame(0))).status_code == 200


@damage
async def test_a_malformed_ego_part_refuses_the_whole_frame(served, good_frame, spoil, status, slug, field):
    session = await served.open()
    if field in ("", "frame"):
        body = spoil(good_frame(0))
        expected = field
    else:
        frame = msgpack.unpackb(good_frame(0))
        frame["ego"] = msgpack.unpackb(spoil(msgpack.packb(frame["ego"])))
        body, expected = msgpack.packb(frame), f"ego.{field}"
    fields = problem(await served.post(session, "frames", body), status, slug)
    assert fields.get("field", "") == expected
    assert (await served.post(session, "frames", good_frame(0))).json()["source"] == "consensus"


@pytest.mark.parametrize(
    ("spoil", "status", "slug", "field"), [values for values in DAMAGE.values() if values[3] not in ("", "frame")]
)
async def test_a_malformed_teammate_in_a_whole_frame_is_rejected_and_the_frame_is_answered(
    served, good_frame, spoil, status, slug, field
):
    session = await served.open()
    frame = msgpack.unpackb(good_frame(0))
    frame["teammates"]["car-3"] = msgpack.unpackb(spoil(msgpack.packb(frame["teammates"]["car-3"])))
    result = (await served.post(session, "frames", msgpack.packb(frame))).json()
    assert result["source"] == "consensus"
    (entry,) = [entry for entry in result["rejected"] if entry["vehicle_id"] == "car-3"]
    assert entry["reason"] == "malformed"
    assert entry["field"] == f"teammates.car-3.{field}"
    assert entry["detail"]


async def test_a_teammate_of_the_wrong_kind_is_malformed_too(served, good_frame):
    session = await served.open()
    body = altered(good_frame(0), "teammates.rsu", None)
    result = (await served.post(session, "frames", body)).json()
    assert {e["vehicle_id"]: e["reason"] for e in result["rejected"]}["rsu"] == "malformed"


async def test_strangers_in_a_whole_frame_are_named_and_not_fused(served, good_frame, benign, ego_message):
    session = await served.open()
    body = wire.pack_frame(0, ego_message, {**benign, "stranger": benign["rsu"]})
    result = (await served.post(session, "frames", body)).json()
    assert {e["vehicle_id"]: e["reason"] for e in result["rejected"]}["stranger"] == "unauthenticated"
    assert all("stranger" not in h["teammates"] for h in result["hypotheses"])


async def test_a_vehicle_cannot_speak_for_another(served, messages):
    session = await served.open(gather_ms=20)
    ego = served.ego(session)
    thief = session.teammate_tokens["car-2"]
    for victim in ("car-3", "car-1", "nobody"):
        body = wire.pack_message(0, victim, messages["car-2"])
        fields = problem(await served.post(session, "messages", body, thief), 403, "wrong-vehicle")
        assert fields["field"] == "vehicle_id"
    body = wire.pack_message(0, "car-3", messages["car-3"])
    problem(await served.post(session, "messages", body, session.ego_token), 403, "wrong-vehicle")
    problem(await served.post(session, "frames", body, thief), 403, "ego-only")
    answer = await ego.ask(0, messages["car-1"])
    assert answer.rejected["car-2"].reason == "unauthenticated"
    assert answer.rejected["car-3"].reason == "missing"
    refused = [r for r in await ego.audit() if r["event"] == "message_refused"]
    assert [r["vehicle_id"] for r in refused] == ["car-2"] * 3 + ["car-1", "car-2"]
    assert {r["reason"] for r in refused} == {"unauthenticated"}


async def test_bodies_are_bounded_before_they_are_read(good_frame):
    async with serve(max_body_bytes=1_000_000) as served:
        session = await served.open()
        assert (await served.post(session, "frames", good_frame(0))).status_code == 200
        problem(await served.post(session, "frames", bytes(1_000_001)), 413, "too-large")

        async def endless():
            for _ in range(100):
                yield bytes(100_000)

        headers = {"Authorization": f"Bearer {session.ego_token}", "Content-Type": "application/vnd.msgpack"}
        path = f"/v1/sessions/{session.session_id}/frames"
        problem(await served.http.post(path, content=endless(), headers=headers), 413, "too-large")
        headers["Content-Length"] = str(4 * 2**30)
        problem(await served.http.post(path, content=b"x", headers=headers), 413, "too-large")
        problem(await served.http.post("/v1/sessions", content=bytes(1_000_001)), 413, "too-large")
        assert (await served.post(session, "frames", good_frame(1))).status_code == 200


async def test_messages_of_absurd_size_break_nothing(served, ego_message, benign):
    loud = Message(benign["car-2"].pose, {"features": np.full((64, 32, 32), 65504, dtype=np.float16)})
    session = await served.open(defense={"kind": "sample_consensus", "sampling_budget": 7, "collaborators": 3})
    answer = await served.ego(session).post_frame(0, ego_message, {**benign, "car-2": loud})
    assert answer.source == "consensus"
    assert "car-2" not in answer.accepted
    assert np.isfinite(answer.boxes).all()


async def test_a_teammate_cannot_break_the_frame_that_carries_its_part(served, good_frame):
    session = await served.open()
    spoilers = [
        msgpack.ExtType(5, b"1234"),
        msgpack.Timestamp(3),
        {1: 2},
        {"pose": list(range(60)), "tensors": {"x" * 300: 1}},
        {"pose": "y" * 10_000},
    ]
    for index, spoiler in enumerate(spoilers):
        frame = msgpack.unpackb(good_frame(index))
        frame["teammates"]["car-3"] = spoiler
        frame["teammates"]["7"] = None
        response = await served.post(session, "frames", msgpack.packb(frame))
        assert response.status_code == 200, response.text
        reasons = {e["vehicle_id"]: e["reason"] for e in response.json()["rejected"]}
        assert (reasons["car-3"], reasons["7"]) == ("malformed", "unauthenticated")


def nested(depth):
    value = 0
    for _ in range(depth):
        value = [value]
    return value


BEYOND = {
    "a pose of 65 numbers": {"pose": [0.0] * 65},
    "a tensor as a list": {"tensors": {"features": {"data": [0] * 70_000}}},
    "a tensor as text": {"tensors": {"features": {"data": "0" * 131_072}}},
    "many names": {str(i): 0 for i in range(1025)},
    "many small containers": [[[]] * 64] * 64 * 20,
    "no text": {"pose": b"\xff\xfe".decode("latin-1")},
    "deep": nested(400),
}


@pytest.mark.parametrize("part", BEYOND.values(), ids=list(BEYOND))
async def test_a_teammates_part_beyond_the_limits_costs_that_teammate_only(served, good_frame, part):
    session = await served.open()
    frame = msgpack.unpackb(good_frame(0))
    frame["teammates"] |= {"car-3": part, "stranger": part}
    body = msgpack.packb(frame).replace("\xff\xfe".encode(), b"\xff\xfe\xff\xff")  # as long, and no UTF-8
    answered = await served.post(session, "frames", body)
    assert answered.status_code == 200, answered.text
    rejected = {entry["vehicle_id"]: entry for entry in answered.json()["rejected"]}
    assert (rejected["car-3"]["reason"], rejected["stranger"]["reason"]) == ("malformed", "unauthenticated")
    assert rejected["car-3"]["field"].startswith("teammates.car-3")
    assert {"car-2", "car-4", "car-5", "rsu"}.isdisjoint(
        name for name, entry in rejected.items() if entry["reason"] == "malformed"
    )


async def test_an_egos_part_beyond_the_limits_refuses_the_frame(served, good_frame):
    session = await served.open()
    body = altered(good_frame(0), "ego.pose", [0.0] * 65)
    problem(await served.post(session, "frames", body), 400, "malformed-msgpack")


async def test_only_strings_are_names(served, good_frame):
    session = await served.open()
    frame = msgpack.unpackb(good_frame(0))
    for name in (5, None, b"rsu", 2.5, True):
        frame["teammates"] = {"5": None, name: None}
        fields = problem(await served.post(session, "frames", msgpack.packb(frame)), 422, "wrong-type")
        assert (fields["field"], "must be a string" in fields["detail"]) == ("teammates", True)
    lines = [line.encode() for line in await served.ego(session).audit_lines()]
    assert verify(lines) == []


async def test_a_message_may_be_no_larger_than_its_detector_needs(served, messages):
    session = await served.open(gather_ms=20)
    token = session.teammate_tokens["car-2"]
    problem(await served.post(session, "messages", bytes(300_000), token), 413, "too-large")
    problem(
        await served.post(session, "messages", b"x", token, **{"Content-Type": "text/plain"}),
        415,
        "unsupported-media-type",
    )
    answer = await served.ego(session).ask(0, messages["car-1"])
    assert answer.rejected["car-2"].reason == "malformed"
    refused = [r["detail"] for r in await served.ego(session).audit() if r["event"] == "message_refused"]
    assert len(refused) == 2


async def test_many_small_containers_are_refused_before_they_cost_anything(served):
    import time

    bomb = b"\xde\x04\x00" + b"".join(msgpack.packb(str(i)) + b"\xdc\x00\x40" + b"\x80" * 64 for i in range(1024))
    session = await served.open()
    started = time.process_time()
    problem(await served.post(session, "messages", bomb, session.teammate_tokens["car-2"]), 400, "malformed-msgpack")
    assert time.process_time() - started < 1.0


async def test_a_flood_of_refused_messages_is_counted_not_recorded(served, messages, good_frame):
    session = await served.open()
    for _ in range(40):
        await served.post(session, "messages", b"junk", session.teammate_tokens["car-2"])
    await served.post(session, "frames", good_frame(0))
    records = await served.ego(session).audit()
    assert sum(record["event"] == "message_refused" for record in records) == 16
    assert records[-1]["unlogged_refusals"] == {"car-2": 24}


async def test_whoever_is_refused_on_and_on_gets_one_record_a_frame(served, messages):
    """Each record is a transaction, which the session's own decisions wait for."""
    session = await served.open(gather_ms=20)
    told = []
    for frame in range(4):
        before = len(await served.ego(session).audit())
        for _ in range(20):
            await served.post(session, "messages", b"junk", session.teammate_tokens["car-2"])
        await served.teammate(session, "car-3").send(frame, messages["car-3"])
        for _ in range(20):
            with pytest.raises(FrameConflict, match="equivocation"):
                await served.teammate(session, "car-3").send(frame, messages["car-4"])
        await served.ego(session).ask(frame, messages[EGO])
        records = (await served.ego(session).audit())[before:]
        events = Counter(f"{record['event']} {record['vehicle_id']}" for record in records[:-1])
        told.append((events, records[-1]["unlogged_refusals"]))
    refused, proven = "message_refused car-2", "equivocation car-3"
    assert told == [
        ({refused: 16, proven: 20}, {"car-2": 4}),
        *[({refused: 1, proven: 2}, {"car-2": 19, "car-3": 18})] * 3,
    ]


async def test_a_client_that_goes_away_in_mid_body_is_no_error_of_the_gateway(caplog):
    from service.app import create_app
    from service.settings import Settings

    app = create_app(Settings(database_url="sqlite://"))
    async with app.router.lifespan_context(app):
        sent = []
        session = None

        async def call(method, path, headers, messages):
            queue = list(messages)

            async def receive():
                return queue.pop(0)

            async def send(message):
                sent.append(message)

            scope = {
                "type": "http", "method": method, "path": path, "raw_path": path.encode(), "query_string": b"",
                "headers": headers, "http_version": "1.1", "scheme": "http", "server": ("x", 1),
                "client": ("127.0.0.1", 2), "root_path": "", "asgi": {"version": "3.0"},
            }  # fmt: skip
            await app(scope, receive, send)

        body = b'{"ego_id": "a", "teammates": ["b"]}'
        json_type = [(b"host", b"localhost"), (b"content-type", b"application/json")]
        await call("POST", "/v1/sessions", json_type, [{"type": "http.request", "body": body, "more_body": False}])
        import json

        session = json.loads(sent[1]["body"])
        sent.clear()
        headers = [
            (b"content-type", b"application/msgpack"),
            (b"host", b"localhost"),
            (b"authorization", b"Bearer " + session["ego_token"].encode()),
            (b"content-length", b"50000"),
        ]
        half = [{"type": "http.request", "body": b"\x83", "more_body": True}, {"type": "http.disconnect"}]
        await call("POST", f"/v1/sessions/{session['session_id']}/frames", headers, half)
    assert sent[0]["status"] == 400
    assert not [record for record in caplog.records if record.levelname == "ERROR"]
