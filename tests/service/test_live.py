import asyncio
import gc
import json
import re
import threading
import time
from contextlib import suppress
from types import SimpleNamespace

import numpy as np
import pytest

from robosac.answers import Reason, RejectedTeammate
from robosac.boxes import pairwise_iou
from service.arriving.hanging_up import HangingUp
from service.errors import Refused, StoreUnavailable
from service.keeping.record import SessionRecord
from service.pages import API_FILES, STATIC
from service.sessions.viewers import ViewerTokens
from service.settings import Settings
from service.viewing import feed as feeding
from service.viewing.feed import Feed
from service.viewing.shown import Seen
from service.viewing.viewers import WAITING, Viewer
from service.viewing.words import of_rejection
from tests.service.conftest import TEAM, problem, serve
from tests.service.credentials import KEY, OTHER_KEY, bearer
from tests.test_site import Loaded

TOKEN = "a-viewers-token-0123"
PAGES = ("/", "/docs", "/redoc")


async def watched(served, sid, **query):
    """The events of a session until the feed ends, which it does at once."""
    asking = asyncio.create_task(served.http.get(f"/v1/live/{sid}", params=query))
    while not served.gateway.feed.sessions()[0]["viewers"]:
        await asyncio.sleep(0.001)
    served.gateway.feed.end()
    response = await asking
    assert response.status_code == 200
    assert response.headers["content-type"].startswith("text/event-stream")
    return events_of(response.text)


def events_of(text):
    events = []
    for block in text.strip().split("\n\n"):
        fields = dict(line.split(": ", 1) for line in block.splitlines())
        events.append((fields["event"], json.loads(fields["data"])))
    return events


def told_by(batch):
    return json.loads(batch.event.decode().removeprefix("event: frames\ndata: "))


async def test_a_log_is_put_into_words_off_the_event_loop(served, ego_message, benign, monkeypatch):
    session, threads = await served.open(), []

    def noting(line):
        threads.append(threading.current_thread())
        return "words"

    monkeypatch.setattr("service.viewing.feed.sentence", noting)
    await served.ego(session).post_frame(0, ego_message, benign)
    await watched(served, session.session_id)
    assert threads
    assert threading.current_thread() not in threads


async def test_what_is_watched_is_what_was_answered(served, ego_message, attacked):
    session = await served.open(defense={"kind": "group_testing"})
    answers = [await served.ego(session).post_frame(i, ego_message, attacked) for i in range(3)]
    (listed,) = (await served.http.get("/v1/live")).json()["sessions"]
    assert (listed["session_id"], listed["frame"], listed["ego_id"]) == (session.session_id, 2, "car-1")
    assert listed["named"] == ["car-2"]
    (_, about), (_, told), (last, _) = await watched(served, session.session_id, after=0)
    assert last == "end"
    assert about["latency_budget_ms"] == 20_000
    assert [frame["frame"] for frame in told["frames"]] == [1, 2]
    (opened,) = told["audit"]
    assert opened["text"].startswith("car-1 opened a session with car-2, car-3, car-4, car-5 and rsu; ")
    for frame, answer in zip(told["frames"], answers[1:], strict=True):
        np.testing.assert_allclose(frame["boxes"], answer.boxes, atol=1e-3)
        assert len(frame["boxes"]) > 5
        assert [one["status"] for one in frame["support"]] == [one.status for one in answer.support]
        assert frame["suspicion"] == answer.suspicion
        assert frame["seq"] == answer.receipt.seq
        assert [one["verdict"] for one in frame["hypotheses"]] == [one.verdict for one in answer.hypotheses]
        assert set(frame["timings_ms"]) == set(answer.timings_ms)
        assert frame["deadline_met"] == answer.deadline_met
        assert {mate["vehicle_id"] for mate in frame["teammates"]} == set(TEAM)
        here = np.linalg.inv(ego_message.pose) @ attacked["rsu"].pose
        (rsu,) = [mate for mate in frame["teammates"] if mate["vehicle_id"] == "rsu"]
        assert (rsu["x"], rsu["y"]) == pytest.approx(tuple(here[:2, 3]), abs=2e-3)
        assert rsu["range_m"] == pytest.approx(np.hypot(*here[:2, 3]), abs=0.01)
    (named,) = [entry for entry in told["frames"][-1]["rejected"] if entry["vehicle_id"] == "car-2"]
    assert named["why"].startswith("named as an attacker")
    assert re.search(r"vehicles? invented.* times more likely", " ".join(named["evidence"]))


@pytest.mark.parametrize(
    ("evidence", "said"),
    [({"misplaced_m": 0.91}, "out of place by 0.9 m"), ({"ego_astray": True}, "the ego itself is not where it says")],
)
def test_a_message_out_of_place_and_an_ego_astray_are_told(evidence, said):
    assert said in of_rejection(RejectedTeammate(vehicle_id="car-2", reason=Reason.NOT_SAMPLED, **evidence))


async def test_names_of_strangers_turn_no_words_round(served, ego_message, benign):
    session = await served.open()
    stranger = "\u202e.enif si lla\x1b[2J\r\n\0"
    await served.ego(session).post_frame(0, ego_message, {**benign, stranger: benign["rsu"]})
    (_, _), (_, told), _ = await watched(served, session.session_id, after=-1)
    (frame,) = told["frames"]
    (entry,) = [entry for entry in frame["rejected"] if entry["reason"] == "unauthenticated"]
    assert entry["vehicle_id"] == "\\u202e.enif si lla\\x1b[2J\\r\\n\\x00"
    for words in (frame["sentence"], *(line["text"] for line in told["audit"])):
        assert words.isprintable()
    assert entry["vehicle_id"] in frame["sentence"]


async def test_a_rejected_fusion_shows_what_was_not_answered(served, ego_message, attacked):
    session = await served.open(defense={"kind": "sample_consensus", "sampling_budget": 12, "collaborators": 1})
    for frame in range(40):
        await served.ego(session).post_frame(frame, ego_message, attacked)
        seen = served.gateway.feed._sessions[session.session_id].frames[-1]
        fused = json.loads(seen.as_json(0.25))["averted"]
        if fused:
            break
    averted = fused[-1]  # the same subset may be drawn twice
    assert {seen.answer.hypotheses[each["hypothesis"]].teammates for each in fused} == {("car-2",)}
    assert len(averted["boxes"]) > 20
    for box in averted["boxes"]:
        assert box[5] >= 0.25
        assert pairwise_iou(np.array([box]), seen.answer.boxes).max() < 0.31


async def test_without_anybody_who_watches_nothing_is_made_and_no_tensor_is_kept(served, ego_message, benign):
    session = await served.open()
    await served.ego(session).post_frame(0, ego_message, benign)
    known = served.gateway.feed._sessions[session.session_id]
    assert known.teller is None
    assert known.frames[0].text is None
    held, todo, kept = set(), [known.frames[0]], 0
    while todo:
        thing = todo.pop()
        if id(thing) in held or isinstance(thing, type) or callable(thing):
            continue
        held.add(id(thing))
        kept += thing.nbytes if isinstance(thing, np.ndarray) else 0
        todo += gc.get_referents(thing)
    assert 0 < kept < 100_000  # one message has 131 kB


async def test_all_who_watch_share_one_text_and_it_ends_with_the_last(served, ego_message, benign):
    session = await served.open()
    ego, feed = served.ego(session), served.gateway.feed
    await ego.post_frame(0, ego_message, benign)
    with feed.watching(session.session_id) as one:
        with feed.watching(session.session_id) as other:
            known = feed._sessions[session.session_id]
            await ego.post_frame(1, ego_message, benign)
            (first, _), (second, _) = [await anext(viewer.batches()) for viewer in (one, other)]
            assert first is second
            assert [frame["frame"] for frame in told_by(first)["frames"]] == [1]
            teller = known.teller
        assert known.teller is teller
    with suppress(asyncio.CancelledError):
        await teller
    assert known.teller is None


async def test_refusals_are_told_with_the_next_frame_each_once(served, ego_message, benign):
    session = await served.open()
    ego, feed = served.ego(session), served.gateway.feed
    await ego.post_frame(0, ego_message, benign)
    with feed.watching(session.session_id) as viewer:
        await feed.latest(session.session_id)
        await served.post(session, "messages", b"\xc1" + b'"event":"frame_answered"', session.teammate_tokens["rsu"])
        await feed.latest(session.session_id)
        await ego.post_frame(1, ego_message, benign)
        batch, dropped = await anext(viewer.batches())
    texts = [entry["text"] for entry in told_by(batch)["audit"]]
    assert dropped == 0
    assert len(texts) == 2
    assert texts[1].startswith("A message of rsu was refused (malformed): ")


async def test_who_may_watch(ego_message):
    async with serve(api_keys=KEY, api_key=KEY) as served:
        told = problem(await served.http.get("/v1/live"), 401, "unauthenticated")
        assert "ROBOSAC_VIEWER_TOKENS" in told["detail"]
        problem(await served.http.get("/v1/live", headers=bearer(KEY)), 401, "unauthenticated")
    async with serve(api_keys=KEY, api_key=KEY, viewer_tokens=f"{OTHER_KEY}, {TOKEN}") as served:
        sid = (await served.open()).session_id
        for credential in (None, KEY, TOKEN + "x", ""):
            for path in ("/v1/live", f"/v1/live/{sid}", "/v1/live/nonesuch"):
                refused = await served.http.get(path, headers=bearer(credential))
                assert TOKEN not in problem(refused, 401, "unauthenticated")["detail"]
                assert refused.headers["www-authenticate"] == "Bearer"
        for credential in (TOKEN, OTHER_KEY):
            assert (await served.http.get("/v1/live", headers=bearer(credential))).json() == {"sessions": []}
        problem(await served.http.get(f"/v1/live/{sid}", headers=bearer(TOKEN)), 404, "unknown-session")
        problem(await served.http.post("/v1/sessions", json={}, headers=bearer(TOKEN)), 401, "unauthenticated")
    async with serve(viewer_tokens=TOKEN) as served:
        problem(await served.http.get("/v1/live"), 401, "unauthenticated")
    async with serve() as served:
        assert (await served.http.get("/v1/live")).status_code == 200
        for path in ("/v1/live", "/"):
            problem(await served.http.get(path, headers={"X-Forwarded-For": "9.9.9.9"}), 403, "loopback-only")


@pytest.mark.parametrize(
    ("tokens", "complaint"), [(f"{TOKEN},short", "token 2 has fewer than 16"), ("schlüssel-0123456789", "characters")]
)
def test_a_token_that_would_not_do_is_refused_unseen(tokens, complaint):
    settings = Settings(viewer_tokens=tokens)
    assert "short" not in repr(settings)
    with pytest.raises(ValueError, match=f"ROBOSAC_VIEWER_TOKENS.*{complaint}") as refused:
        ViewerTokens(settings, open_to_all=True)
    assert tokens not in str(refused.value)


async def test_only_so_many_watch_at_a_time(ego_message, benign):
    async with serve(max_viewers=1) as served:
        session = await served.open()
        await served.ego(session).post_frame(0, ego_message, benign)
        with served.gateway.feed.watching(session.session_id):
            refused = await served.http.get(f"/v1/live/{session.session_id}")
            assert "ROBOSAC_MAX_VIEWERS" in problem(refused, 503, "too-many-viewers")["detail"]
            assert refused.headers["retry-after"] == "10"
        assert len(await watched(served, session.session_id)) == 3
        problem(await served.http.get(f"/v1/live/{session.session_id}"), 503, "too-many-viewers")  # it has ended


# ---- the feed by itself


def an_answer(frame):
    rejected, receipt = {}, SimpleNamespace(seq=frame + 1)
    return SimpleNamespace(frame=frame, named=(), accepted=("b",), rejected=rejected, receipt=receipt)


def note(feed, sid, frame):
    record = SessionRecord(sid, "a", ("b",), "d", {"kind": "none"}, 200.0, 100.0, 200.0, {}, "then", "00")
    feed.note(record, an_answer(frame), SimpleNamespace(hypotheses=()), np.eye(4), {}, 0.25)


async def no_log(*_):
    return []


def test_what_is_kept_is_bounded_and_the_longest_unused_goes_first():
    feed = Feed(no_log, 1)
    for frame in range(feeding.FRAMES + 5):
        note(feed, "long", frame)
    assert len(feed._sessions["long"].frames) == feeding.FRAMES
    for number in range(feeding.SESSIONS + 10):
        note(feed, str(number), 0)
    assert len(feed.sessions()) == feeding.SESSIONS
    assert {"long", "0", "9"}.isdisjoint(feed._sessions)
    for number in range(40):
        for frame in range(feeding.FRAMES):
            note(feed, f"many {number}", frame)
    assert sum(len(known.frames) for known in feed._sessions.values()) == feed._frames <= feeding.ALL_FRAMES


async def test_a_viewer_who_does_not_read_loses_the_oldest_and_is_told_how_many():
    viewer = Viewer()
    batches = [SimpleNamespace(frames=2, number=number) for number in range(WAITING + 3)]
    for batch in batches:
        viewer.offer(batch)
    reading = viewer.batches()
    first, dropped = await anext(reading)
    assert (first.number, dropped) == (3, 6)
    assert (await anext(reading))[1] == 0
    viewer.end()
    assert [batch async for batch in reading] == []


async def test_a_viewer_for_whom_there_is_nothing_is_told_so_now_and_then():
    viewer = Viewer()
    reading = viewer.batches(silence_s=0.01)
    assert [await anext(reading), await anext(reading)] == [(None, 0)] * 2
    viewer.offer(SimpleNamespace(frames=1, number=7))
    assert (await anext(reading))[0].number == 7


async def test_frames_that_come_too_fast_are_skipped_and_counted(detector):
    feed = Feed(no_log, 1)
    note(feed, "s", 0)
    feed._sessions["s"].frames[0].text = "0"
    with feed.watching("s") as viewer:
        for frame in range(1, 8):
            note(feed, "s", frame)
            feed._sessions["s"].frames[-1].text = str(frame)
        batch, _ = await anext(viewer.batches())
    assert told_by(batch) == {"frames": [5, 6, 7], "skipped": 4, "audit": []}  # 12 a second


async def test_a_frame_that_cannot_be_shown_and_a_database_that_fails_end_nothing(caplog):
    async def failing(*_):
        raise StoreUnavailable

    feed = Feed(failing, 1)
    note(feed, "s", 0)
    with feed.watching("s") as viewer:
        note(feed, "s", 1)  # of which there is nothing to show
        waiting = asyncio.create_task(anext(viewer.batches()))
        while "cannot be shown" not in caplog.text:
            await asyncio.sleep(0.001)
        note(feed, "s", 2)
        feed._sessions["s"].frames[-1].text = "2"
        batch, _ = await waiting
    assert told_by(batch)["frames"] == [2]


async def test_whoever_takes_nothing_is_hung_up_on_and_nobody_else():
    async def endless(scope, receive, send):
        while True:
            await send({"type": "http.response.body", "body": b"x", "more_body": True})

    async def stuck(_):
        await asyncio.sleep(60)

    began = time.perf_counter()
    for path in ("/v1/live/s", "/v1/sessions/s/audit", "/v1/sessions/s/standby"):
        await HangingUp(endless, 0.05)({"type": "http", "path": path}, None, stuck)
    assert time.perf_counter() - began < 10
    with pytest.raises(TimeoutError):
        async with asyncio.timeout(0.2):
            await HangingUp(endless, 0.05)({"type": "http", "path": "/v1/sessions"}, None, stuck)

    async def broken(_):
        raise OSError("gone")

    with pytest.raises(OSError, match="gone"):
        await HangingUp(endless, 0.05)({"type": "http", "path": "/v1/live/s"}, None, broken)


def test_nobody_watches_what_is_not_there():
    with pytest.raises(Refused, match="no frame"), Feed(no_log, 1).watching("s"):
        pytest.fail("it was watched")


def test_a_frame_of_the_ego_alone_shows_its_own_boxes():
    answer = SimpleNamespace(accepted=())
    boxes = np.ones((2, 6))
    result = SimpleNamespace(hypotheses=(), boxes=boxes)
    assert Seen.of(answer, result, np.eye(4), {}).own is boxes


# ---- the pages


async def test_the_pages_load_nothing_from_elsewhere(served):
    for path in PAGES:
        page = await served.http.get(path)
        assert page.status_code == 200
        assert "default-src 'none'" in page.headers["content-security-policy"]
        loaded = Loaded()
        loaded.feed(page.text)
        assert len(loaded.addresses) >= 2
        for address in loaded.addresses:
            assert not re.match(r"(https?:)?//", address), f"{path} loads {address}"
            assert (await served.http.get("/" + address.lstrip("/"))).status_code == 200, address
        assert ("'unsafe-inline'" in page.headers["content-security-policy"]) == (path != "/")
    assert "<script>" not in (await served.http.get("/")).text
    for name in ("live.js", "panels.js", "scene.js", "stream.js"):
        file = await served.http.get(f"/live/{name}")
        assert file.headers["content-type"].startswith("text/javascript")
        assert "innerHTML" not in file.text
        assert set(re.findall(r"https?://[\w.]+", file.text)) <= {"http://www.w3.org"}
    for path in ("/live/nonesuch", "/live/..%2ffeed.py", "/live/%2e%2e/feed.py", f"{API_FILES}/..%2fcore.py"):
        problem(await served.http.get(path), 404, "not-found")


def test_every_file_of_the_page_is_installed():
    import tomllib

    project = tomllib.loads((STATIC.parents[2] / "pyproject.toml").read_text())
    patterns = project["tool"]["setuptools"]["package-data"]["service.viewing"]
    assert {path for pattern in patterns for path in STATIC.parent.glob(pattern)} == set(STATIC.iterdir())
