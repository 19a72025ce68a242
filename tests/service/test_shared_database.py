"""Gateways that come after one another, or run side by side, on one database."""

import asyncio
import contextlib
import dataclasses
import shutil
import sys
import types

import pytest
from sqlalchemy import update

from clients.errors import AccessDenied, FrameConflict, SessionNotFound
from robosac import wire
from robosac.detectors.base import calibration_beside
from robosac.detectors.embedded import SHIPPED_WEIGHTS, EmbeddedDetector
from service.keeping.tables import sessions
from service.sessions.idle import Idle
from tests.service.conftest import EGO, HOOKED, TEAM, problem, serve
from tests.service.credentials import bearer, claims_of


@pytest.fixture
def url(tmp_path):
    return f"sqlite:///{tmp_path}/robosac.db"


@pytest.fixture
async def two(url):
    hooked = {"database_url": url, "extra_detectors": HOOKED}
    async with serve(**hooked) as one, serve(**hooked) as other:
        yield one, other


def answered(records):
    return [record["frame"] for record in records if record["event"] == "frame_answered"]


async def test_a_gateway_goes_on_where_the_one_before_was(url, messages, benign):
    async with serve(database_url=url) as served:
        session = await served.open(defense={"kind": "static_team"}, gather_ms=20)
        first = await served.ego(session).post_frame(4, messages[EGO], benign)
        before = await served.ego(session).state()
    async with serve(database_url=url) as served:
        ego = served.ego(session)
        assert await ego.state() == before
        assert "robosac_sessions 1.0" in (await served.http.get("/metrics")).text
        with pytest.raises(FrameConflict):
            await ego.post_frame(4, messages[EGO], benign)
        again = await ego.post_frame(5, messages[EGO], benign)
        assert first.source == "consensus"
        assert (again.source, again.accepted, again.sampling_steps) == ("trusted", first.accepted, 0)
        await served.teammate(session, "rsu").send(6, messages["rsu"])
        assert (await ego.ask(6, messages[EGO])).frame == 6
        assert answered(await ego.audit()) == [4, 5, 6]
        await ego.close()


async def test_a_token_that_another_process_renewed_ends_no_session(two):
    one, other = two
    session = await one.open()
    path = f"/v1/sessions/{session.session_id}"
    old = {"Authorization": f"Bearer {session.ego_token}"}
    async with one.gateway.sessions.in_use(session.session_id).lock:  # as that of a frame in hand
        ending = asyncio.create_task(one.http.delete(path, headers=old))
        await asyncio.sleep(0.2)
        renewed = await other.http.post(f"{path}/token", headers=old)
        assert renewed.status_code == 201
    problem(await ending, 401, "unauthenticated")
    new = {"Authorization": f"Bearer {renewed.json()['token']}"}
    for served in two:
        assert (await served.http.get(path, headers=new)).status_code == 200
    assert (await one.http.delete(path, headers=new)).status_code == 204


async def test_two_gateways_take_turns(two, messages, benign):
    one, other = two
    session = await one.open()
    for frame in range(4):
        answer = await two[frame % 2].ego(session).post_frame(frame, messages[EGO], benign)
        assert answer.source == "consensus"
    for served in two:
        with pytest.raises(FrameConflict):
            await served.ego(session).post_frame(3, messages[EGO], benign)
        assert answered(await served.ego(session).audit()) == [0, 1, 2, 3]
    assert (await one.ego(session).state()) == (await other.ego(session).state())


async def test_who_left_at_one_gateway_is_a_stranger_at_the_other(two, messages, benign):
    one, other = two
    session = await one.open(defense={"kind": "none"}, gather_ms=20)
    assert (await other.ego(session).post_frame(0, messages[EGO], benign)).accepted == TEAM
    await one.ego(session).dismiss("rsu")
    with pytest.raises(AccessDenied):
        await other.teammate(session, "rsu").send(1, messages["rsu"])
    answer = await other.ego(session).post_frame(1, messages[EGO], benign)
    assert answer.accepted == TEAM[:-1]
    assert answer.rejected["rsu"].reason == "unauthenticated"
    tokens = await one.ego(session).enrol(["rsu"])
    await other.client.vehicle(session.session_id, "rsu", tokens["rsu"]).send(2, messages["rsu"])
    assert (await other.ego(session).ask(2, messages[EGO])).accepted == ("rsu",)


async def test_what_an_earlier_member_sent_to_the_other_gateway_does_not_count(two, messages, benign):
    one, other = two
    session = await one.open(defense={"kind": "none"}, gather_ms=20)
    await other.teammate(session, TEAM[-1]).send(1, messages["car-2"])  # by whoever stole its token
    await other.teammate(session, TEAM[-1]).send(2, messages[TEAM[-1]])
    await one.ego(session).dismiss(TEAM[-1])
    session.teammate_tokens.update(await one.ego(session).enrol([TEAM[-1]]))
    await other.teammate(session, TEAM[-1]).send(1, messages[TEAM[-1]])
    assert (await other.ego(session).ask(1, messages[EGO])).accepted == (TEAM[-1],)
    silent = await other.ego(session).ask(2, messages[EGO])
    assert silent.rejected[TEAM[-1]].reason == "missing"
    assert "equivocation" not in {record["event"] for record in await one.ego(session).audit()}


async def test_what_waits_still_counts_where_its_sender_takes_a_fresh_token(two, messages):
    one, _ = two
    session = await one.open(defense={"kind": "none"}, gather_ms=20)
    await one.teammate(session, "rsu").send(1, messages["rsu"])
    session.teammate_tokens["rsu"] = (await one.teammate(session, "rsu").renew()).token
    await one.teammate(session, "rsu").send(2, messages["rsu"])
    for frame in (1, 2):
        assert (await one.ego(session).ask(frame, messages[EGO])).accepted == ("rsu",)


@contextlib.contextmanager
def meanwhile(served, *happenings):
    """Let something happen in each of the next fusions, before the decision is kept."""
    loop, left = asyncio.get_running_loop(), list(happenings)

    def interrupted(*_):
        if left:
            asyncio.run_coroutine_threadsafe(left.pop(0)(), loop).result()

    served.detector.before_prepare = interrupted
    yield
    assert not left


async def test_a_decision_is_worked_out_again_if_the_team_changed_elsewhere(two, messages, benign):
    one, other = two
    session = await one.open(defense={"kind": "none"})
    ego = other.ego(session)
    with meanwhile(other, lambda: one.ego(session).dismiss("rsu")):
        answer = await ego.post_frame(0, messages[EGO], benign)
    assert answer.accepted == TEAM[:-1]
    records = await ego.audit()
    assert [record["event"] for record in records] == ["session_opened", "team_changed", "frame_answered"]


async def test_a_decision_that_is_worked_out_again_forgets_nothing(two, messages, benign):
    one, other = two
    session = await one.open(defense={"kind": "none"}, gather_ms=20)
    liar, rsu, path = (
        other.teammate(session, "car-2"),
        other.teammate(session, "rsu"),
        f"/v1/sessions/{session.session_id}",
    )
    await liar.send(0, messages["car-2"])
    with pytest.raises(FrameConflict, match="equivocation"):
        await liar.send(0, messages["car-3"])
    for _ in range(20):
        problem(await other.post(session, "messages", b"", session.teammate_tokens["rsu"]), 400, "malformed-msgpack")
        problem(await other.http.get(path), 401, "unauthenticated")
    with meanwhile(other, lambda: one.ego(session).dismiss("car-5")):
        answer = await other.ego(session).ask(0, messages[EGO])
    reasons = {name: entry.reason for name, entry in answer.rejected.items()}
    assert reasons == {"car-2": "distrusted", "car-3": "missing", "car-4": "missing", "rsu": "malformed"}
    assert (await one.ego(session).audit())[-1]["unlogged_refusals"] == {"rsu": 4, "?": 4}
    await rsu.send(1, messages["rsu"])
    await other.ego(session).ask(1, messages[EGO])
    assert (await one.ego(session).audit())[-1]["unlogged_refusals"] == {}


async def test_a_frame_that_is_decided_elsewhere_meanwhile_is_stale(two, messages, benign):
    one, other = two
    session = await one.open()
    with (
        meanwhile(other, lambda: one.ego(session).post_frame(0, messages[EGO], benign)),
        pytest.raises(FrameConflict),
    ):
        await other.ego(session).post_frame(0, messages[EGO], benign)
    assert answered(await one.ego(session).audit()) == [0]
    seeds = [r["seed"] for r in await one.ego(session).audit() if r["event"] == "frame_answered"]
    await other.ego(session).post_frame(1, messages[EGO], benign)
    (_, second) = [r for r in await one.ego(session).audit() if r["event"] == "frame_answered"]
    assert second["seed"] not in seeds


async def test_a_session_that_keeps_changing_is_a_conflict(two, messages, benign):
    one, other = two
    session = await one.open(defense={"kind": "none"})
    changes = [lambda name=name: one.ego(session).dismiss(name) for name in TEAM[:3]]
    with meanwhile(other, *changes), pytest.raises(FrameConflict, match="session-changed"):
        await other.ego(session).post_frame(0, messages[EGO], benign)
    remaining = {name: benign[name] for name in TEAM[3:]}
    assert (await other.ego(session).post_frame(0, messages[EGO], remaining)).accepted == TEAM[3:]


async def test_a_session_that_ended_at_one_gateway_is_over_at_the_other(two, messages, benign):
    one, other = two
    session = await one.open()
    await other.ego(session).post_frame(0, messages[EGO], benign)
    await one.ego(session).close()
    with pytest.raises(SessionNotFound):
        await other.ego(session).post_frame(1, messages[EGO], benign)
    assert session.session_id not in other.gateway.sessions._live
    assert (await other.ego(session).audit())[-1]["event"] == "session_ended"


async def test_a_session_that_is_only_read_at_one_gateway_is_not_ended_by_the_other(url):
    async with serve(database_url=url, session_idle_s=0.6) as one, serve(database_url=url, session_idle_s=0.6):
        session = await one.open()
        for _ in range(40):
            await asyncio.sleep(0.05)
            await one.ego(session).state()
        await asyncio.sleep(1.5)
        with pytest.raises(SessionNotFound):
            await one.ego(session).state()


async def test_a_session_that_wakes_while_unused_ones_are_ended_goes_on(two, monkeypatch, messages, benign):
    one, other = two
    session = await other.open()
    monkeypatch.setattr(Idle, "unused", lambda _: asyncio.sleep(0, [session.session_id]))
    await other.ego(session).post_frame(0, messages[EGO], benign)
    await one.gateway.sessions.sweep()  # it knows of the frame from the database alone
    long_ago = update(sessions).values(touched_at=0.0)
    await other.gateway.store._database.write(lambda connection: connection.execute(long_ago))
    await other.gateway.sessions.sweep()  # it alone knows of the frame
    await other.ego(session).post_frame(1, messages[EGO], benign)
    assert answered(await other.ego(session).audit()) == [0, 1]


async def test_teams_that_change_at_both_gateways_at_once(two):
    one, other = two
    session = await one.open(defense={"kind": "none"})
    await other.ego(session).state()
    async with other.gateway.sessions._live[session.session_id].lock:
        dismissing = asyncio.create_task(other.ego(session).dismiss("car-2"))
        await asyncio.sleep(0.2)  # it knows the session by now, and waits for the lock
        await one.ego(session).dismiss("rsu")
    with pytest.raises(FrameConflict, match="session-changed"):
        await dismissing
    await other.ego(session).dismiss("car-2")
    assert (await one.ego(session).state())["teammates"] == ["car-3", "car-4", "car-5"]


async def test_a_token_is_renewed_at_one_gateway_only(two):
    session = await two[0].open()
    for _ in range(5):
        calls = [served.teammate(session, "rsu").renew() for served in two]
        outcomes = await asyncio.gather(*calls, return_exceptions=True)
        assert [isinstance(outcome, AccessDenied) for outcome in outcomes].count(True) == 1
        (renewed,) = [outcome for outcome in outcomes if not isinstance(outcome, AccessDenied)]
        session.teammate_tokens["rsu"] = renewed.token
    await two[1].teammate(session, "rsu").renew()


async def test_two_gateways_that_are_asked_for_one_fresh_token_give_the_same(two):
    session = await two[0].open()
    path, headers = f"/v1/sessions/{session.session_id}/token", bearer(session.teammate_tokens["rsu"])
    for turn in range(5):
        asked = {**headers, "Idempotency-Key": f"chosen-at-random-{turn}"}
        answers = await asyncio.gather(*(served.http.post(path, headers=asked) for served in two))
        fresh = [answer.json()["token"] for answer in answers]
        assert len({claims_of(token)["jti"] for token in fresh}) == 1
        headers = bearer(fresh[0])


async def test_who_is_dismissed_at_one_gateway_gets_no_fresh_token_at_the_other(two):
    one, other = two
    session = await one.open()
    await other.ego(session).state()
    async with other.gateway.sessions._live[session.session_id].lock:
        renewing = asyncio.create_task(other.teammate(session, "rsu").renew())
        await asyncio.sleep(0.2)  # it knows the session by now, and waits for the lock
        await one.ego(session).dismiss("rsu")
    with pytest.raises(AccessDenied):
        await renewing
    assert "rsu" not in (await one.gateway.store.get(session.session_id)).token_ids
    assert (await one.ego(session).audit())[-1]["event"] == "team_changed"


@pytest.fixture
def own(tmp_path, monkeypatch):
    """The shipped detector under the name "own", with weights and calibration that a test may take away."""
    weights = tmp_path / "own.safetensors"
    shutil.copy(SHIPPED_WEIGHTS, weights)
    shutil.copy(calibration_beside(SHIPPED_WEIGHTS), weights.with_suffix(".calibration.json"))

    def build():
        detector = EmbeddedDetector(weights)
        detector.info = dataclasses.replace(detector.info, name="own")
        return detector

    module = types.ModuleType("own")
    module.build = build
    monkeypatch.setitem(sys.modules, "own", module)
    return weights


@pytest.mark.parametrize("extra", ["", "own:build"])
async def test_a_session_whose_detector_is_gone_is_told_so_and_costs_no_other(extra, own, url, messages, benign):
    async with serve(database_url=url, extra_detectors="own:build") as served:
        lost = await served.open(detector="own", defense={"kind": "group_testing"})
        other = await served.open()
        await served.ego(lost).post_frame(0, messages[EGO], benign)
        own.with_suffix(".calibration.json").unlink()
        request = {"ego_id": "a", "teammates": ["b"], "detector": "own", "defense": {"kind": "group_testing"}}
        problem(await served.http.post("/v1/sessions", json=request), 422, "impossible-defense")
    async with serve(database_url=url, extra_detectors=extra) as served:
        ego = {"Authorization": f"Bearer {lost.ego_token}"}
        path = f"/v1/sessions/{lost.session_id}"
        whole = wire.pack_frame(1, messages[EGO], benign)
        mine = wire.pack_message(1, "rsu", messages["rsu"])
        for refused in (
            await served.post(lost, "frames", whole),
            await served.post(lost, "messages", mine, lost.teammate_tokens["rsu"]),
            await served.http.get(path, headers=ego),
            await served.http.post(f"{path}/token", headers=ego),
            await served.http.delete(path, headers=ego),
        ):
            assert "own" in problem(refused, 503, "detector-unavailable")["detail"]
        problem(await served.http.get(path), 401, "unauthenticated")
        problem(await served.http.get(f"{path}/audit"), 401, "unauthenticated")
        rsu = {"Authorization": f"Bearer {lost.teammate_tokens['rsu']}"}
        problem(await served.http.get(f"{path}/audit", headers=rsu), 403, "ego-only")
        assert answered(await served.ego(lost).audit()) == [0]
        assert (await served.ego(other).post_frame(0, messages[EGO], benign)).source == "consensus"
