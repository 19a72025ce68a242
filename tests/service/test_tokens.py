import asyncio
import dataclasses
import json
import threading
import time
from datetime import datetime

import jwt
import pytest

from clients.errors import AccessDenied, InvalidRequest, SessionNotFound
from service.errors import StoreUnavailable
from service.sessions import identity, teams
from service.sessions.identity import AUDIENCE, CLAIMS, ISSUER
from tests.service.conftest import EGO, problem, serve, until
from tests.service.credentials import OTHER_SECRET, SECRET, bearer, claims_of, forged, segment


async def test_a_token_says_whose_it_is_and_until_when():
    async with serve(token_ttl_s=600) as served:
        session = await served.open()
        claims = claims_of(session.teammate_tokens["rsu"])
        assert jwt.get_unverified_header(session.ego_token)["alg"] == "HS256"
        assert (claims["sub"], claims["sid"], claims["role"]) == ("rsu", session.session_id, "teammate")
        assert (claims["iss"], claims["aud"]) == (ISSUER, AUDIENCE)
        assert claims["exp"] - claims["iat"] == 600
        assert datetime.fromisoformat(session.tokens_expire_at).timestamp() - claims["exp"] in (0, 1, -1)
        assert claims_of(session.ego_token)["role"] == "ego"
        every = [session.ego_token, *session.teammate_tokens.values()]
        assert len({claims_of(token)["jti"] for token in every}) == 6


async def test_neither_tokens_nor_teams_are_made_on_the_event_loop(served, monkeypatch):
    threads = []

    def noted(made):
        return lambda *args, **options: threads.append(threading.get_ident()) or made(*args, **options)

    monkeypatch.setattr(identity.jwt, "encode", noted(jwt.encode))
    monkeypatch.setattr(teams, "changed_team", noted(teams.changed_team))
    session = await served.open()
    await served.ego(session).enrol(["car-9"])
    await served.ego(session).dismiss("car-9")
    assert len(threads) == 6 + 2 + 1
    assert threading.get_ident() not in threads


FORGERIES = {
    "another secret": lambda token: forged(token, OTHER_SECRET),
    "no algorithm": lambda token: forged(token, "", "none"),
    "no signature": lambda token: token.rsplit(".", 1)[0] + ".",
    "another algorithm": lambda token: forged(token, SECRET * 2, "HS512"),
    "tampered": lambda token: ".".join(
        [token.split(".")[0], segment(json.dumps({**claims_of(token), "sub": "car-2"}).encode()), token.split(".")[2]]
    ),
    "another audience": lambda token: forged(token, aud="elsewhere"),
    "several audiences": lambda token: forged(token, aud=[AUDIENCE, "elsewhere"]),
    "another issuer": lambda token: forged(token, iss="elsewhere"),
    "another session": lambda token: forged(token, sid="0" * 32),
    "session of a wrong kind": lambda token: forged(token, sid=[1]),
    "another vehicle": lambda token: forged(token, sub="car-2"),
    "a vehicle of a wrong kind": lambda token: forged(token, sub=7),
    "a stranger": lambda token: forged(token, sub="car-99"),
    "another role": lambda token: forged(token, role="teammate"),
    "another id": lambda token: forged(token, jti="0" * 32),
    "issued in the future": lambda token: forged(token, iat=int(time.time()) + 3600),
    "expiry of a wrong kind": lambda token: forged(token, exp="never"),
    "expiry not a number": lambda token: forged(token, exp=float("nan")),
    "a critical extension": lambda token: forged(token, headers={"crit": ["x"], "x": 1}),
    "absurdly long": lambda token: forged(token, padding="x" * 4096),
    "deep nesting": lambda token: f"{segment(b'[' * 2000)}.{token.split('.')[1]}.{token.split('.')[2]}",
    "a number of 3000 digits": lambda token: f"{segment(b'1' * 3000)}.{segment(b'{}')}.",
    "no JSON": lambda token: "a.b.c",
    "no ASCII": lambda token: "\xff.\xff.\xff",
    **{f"no {name}": lambda token, name=name: forged(token, without=(name,)) for name in CLAIMS},
}


async def test_no_forged_token_has_any_effect(good_frame):
    async with serve(token_secrets=SECRET) as served:
        session = await served.open()
        token = session.ego_token
        assert (await served.post(session, "frames", good_frame(0), forged(token))).status_code == 200  # it can be done
        before = await served.ego(session).state()
        for number, (name, forge) in enumerate(FORGERIES.items(), 1):
            headers = {"Authorization": f"Bearer {forge(token)}".encode("latin-1")}
            for method, call in (("POST", "/frames"), ("DELETE", ""), ("POST", "/token"), ("GET", "/audit")):
                path = f"/v1/sessions/{session.session_id}{call}"
                response = await served.http.request(method, path, headers=headers)
                assert response.status_code == 401, (number, name, response.text)
                problem(response, 401, "unauthenticated")
        after = await served.ego(session).state()
        changed = {name for name in before if before[name] != after[name]}
        assert changed == {"audit_seq", "audit_head", "receipt"}
        assert after["audit_seq"] == before["audit_seq"] + 16


async def test_an_expired_token_is_told_so_and_reaches_nothing():
    async with serve(token_secrets=SECRET) as served:
        session = await served.open()
        expired = forged(session.teammate_tokens["rsu"], exp=int(time.time()) - 60)
        for path in ("messages", "token", "frames"):
            problem(await served.post(session, path, b"", expired), 401, "token-expired")
        (*_, record) = await served.ego(session).audit()
        assert (record["event"], record["vehicle_id"]) == ("access_refused", "rsu")
        just_now = forged(session.ego_token, exp=int(time.time()) - 1)  # within the leeway
        assert (await served.client.vehicle(session.session_id, EGO, just_now).state())["ego_id"] == EGO


async def test_a_fresh_token_replaces_the_one_before(messages):
    async with serve(token_ttl_s=600) as served:
        session = await served.open()
        unit, ego = served.teammate(session, "rsu"), served.ego(session)
        await unit.send(0, messages["rsu"])
        renewed = await unit.renew()
        assert claims_of(renewed.token)["exp"] == datetime.fromisoformat(renewed.expires_at).timestamp()
        assert claims_of(renewed.token)["role"] == "teammate"
        await unit.send(1, messages["rsu"])
        for call in (served.teammate(session, "rsu").send(2, messages["rsu"]), served.teammate(session, "rsu").renew()):
            with pytest.raises(AccessDenied):
                await call
        await ego.renew()
        (renewal,) = [r for r in await ego.audit() if r["event"] == "token_renewed" and r["vehicle_id"] == "rsu"]
        assert renewal["expires_at"] == renewed.expires_at
        with pytest.raises(AccessDenied):
            await served.ego(session).state()
        refused = [r["vehicle_id"] for r in await ego.audit() if r["event"] == "access_refused"]
        assert refused == ["rsu", "rsu", EGO]


async def test_of_two_renewals_with_one_token_only_one_is_granted(served):
    session = await served.open()
    unit = [served.teammate(session, "rsu"), served.teammate(session, "rsu")]
    answers = await asyncio.gather(*(client.renew() for client in unit), return_exceptions=True)
    assert sum(isinstance(answer, AccessDenied) for answer in answers) == 1


@pytest.mark.parametrize("kept", ["yes", "no", "nobody knows"])
async def test_a_token_of_which_the_store_does_not_say_that_it_is_kept_is_looked_for(served, kept, monkeypatch):
    session, store = await served.open(), served.gateway.store
    path = f"/v1/sessions/{session.session_id}/token"
    monkeypatch.setattr(teams, "FINDING_OUT_S", 0.3)
    with monkeypatch.context() as failing:
        keep, get, left = store.renew_token, store.get, [2 if kept == "yes" else 0]

        async def fail(*arguments):
            if kept != "no":
                await keep(*arguments)
            failing.setattr(store, "get", away)
            raise StoreUnavailable

        async def away(session_id):
            left[0] -= 1
            if left[0] >= 0 or kept == "nobody knows":
                raise StoreUnavailable
            return await get(session_id)

        failing.setattr(store, "renew_token", fail)
        answer = await served.http.post(path, headers=bearer(session.ego_token))
    if kept == "yes":
        session = dataclasses.replace(session, ego_token=answer.json()["token"])
    else:
        problem(answer, 503, "store-unavailable")
    if kept != "nobody knows":
        again = await served.http.post(path, headers=bearer(session.ego_token))
        session = dataclasses.replace(session, ego_token=again.json()["token"])
        events = [record["event"] for record in await served.ego(session).audit()]
        assert events.count("token_renewed") == 1 + (kept == "yes")


async def test_a_vehicle_asks_again_for_a_token_whose_answer_was_lost_with_the_key_that_it_chose(served):
    session = await served.open()
    path, key, old = f"/v1/sessions/{session.session_id}/token", "chosen-at-random-1", bearer(session.ego_token)
    first = await renewed(served, path, old, key)
    assert await renewed(served, path, old, key) == first
    for headers in (old, {**old, "Idempotency-Key": "chosen-at-random-2"}):
        problem(await served.http.post(path, headers=headers), 401, "unauthenticated")
    mate = await renewed(served, path, bearer(session.teammate_tokens["rsu"]), key)
    assert mate[1] != first[1]
    problem(await served.http.get(path.removesuffix("/token"), headers=old), 401, "unauthenticated")
    second = await renewed(served, path, bearer(first[0]), key)
    assert second[1] != first[1]
    problem(await served.http.post(path, headers={**old, "Idempotency-Key": key}), 401, "unauthenticated")
    records = await served.client.vehicle(session.session_id, EGO, second[0]).audit()
    assert [r["vehicle_id"] for r in records if r["event"] == "token_renewed"] == [EGO, "rsu", EGO]


async def renewed(served, path, headers, key):
    """The token that a vehicle gets with a key of its choice, its id and its end."""
    answer = await served.http.post(path, headers={**headers, "Idempotency-Key": key})
    assert answer.status_code == 201, answer.text
    token = answer.json()["token"]
    return token, claims_of(token)["jti"], answer.json()["expires_at"]


@pytest.mark.parametrize("key", ["", "x" * 15, "x" * 257, "chosen at random, with spaces"])
async def test_a_key_of_a_renewal_that_could_be_guessed_is_refused(served, key):
    session = await served.open()
    headers = {**bearer(session.ego_token), "Idempotency-Key": key}
    refused = await served.http.post(f"/v1/sessions/{session.session_id}/token", headers=headers)
    assert problem(refused, 422, "invalid-request")["field"] == "header.Idempotency-Key"
    assert (await served.ego(session).state())["ego_id"] == EGO


async def test_of_a_team_that_is_larger_than_it_may_be_now_somebody_can_be_dismissed(tmp_path):
    database = {"database_url": f"sqlite:///{tmp_path}/robosac.db"}
    async with serve(**database) as served:
        session = await served.open()
    async with serve(**database, max_teammates=3) as served:
        ego = served.ego(session)
        await ego.dismiss("rsu")
        with pytest.raises(InvalidRequest, match="ROBOSAC_MAX_TEAMMATES allows at most 3 teammates, got 5"):
            await ego.enrol(["bus"])
        assert "rsu" not in (await ego.state())["teammates"]


def waiting_for(lock):
    return len(lock._waiters or ())


async def test_a_vehicle_that_leaves_while_it_waits_for_a_token_gets_none(served):
    session = await served.open()
    lock = (await served.gateway.sessions.authenticate(session.session_id, session.ego_token)).live.lock
    async with lock:
        leaving = asyncio.create_task(served.ego(session).dismiss("rsu"))
        await until(lambda: waiting_for(lock) == 1)
        waiting = asyncio.create_task(served.teammate(session, "rsu").renew())
        await until(lambda: waiting_for(lock) == 2)
    await leaving
    with pytest.raises(AccessDenied):
        await waiting
    assert "rsu" not in (await served.ego(session).state())["teammates"]


async def test_what_the_ego_asked_with_a_token_that_is_replaced_meanwhile_is_not_done(served, good_frame):
    session = await served.open()
    lock = (await served.gateway.sessions.authenticate(session.session_id, session.ego_token)).live.lock
    async with lock:
        renewing = asyncio.create_task(served.ego(session).renew())
        await until(lambda: waiting_for(lock) == 1)
        asking = asyncio.create_task(served.post(session, "frames", good_frame(0)))
        ending = asyncio.create_task(served.ego(session).close())
        await until(lambda: waiting_for(lock) == 3)
    session = dataclasses.replace(session, ego_token=(await renewing).token)
    problem(await asking, 401, "unauthenticated")
    with pytest.raises(AccessDenied):
        await ending
    assert (await served.post(session, "frames", good_frame(0))).status_code == 200


async def test_renewals_are_bounded_however_many_frames_there_are(served, ego_message, benign, monkeypatch):
    session = await served.open()
    unit, ego = served.teammate(session, "rsu"), served.ego(session)
    for _ in range(16):
        await unit.renew()
    with pytest.raises(InvalidRequest) as caught:
        await unit.renew()
    assert (caught.value.status, caught.value.type) == (429, "urn:robosac:problem:too-many-renewals")
    await ego.post_frame(0, ego_message, benign)
    with pytest.raises(InvalidRequest):
        await unit.renew()
    await ego.renew()
    monkeypatch.setattr(teams, "RENEWALS_WITHIN_S", 0.0)
    await unit.renew()


async def test_changes_of_a_team_are_bounded_between_two_frames(served, ego_message, benign, monkeypatch):
    monkeypatch.setattr("service.sessions.teams.MAX_CHANGES", 4)
    session = await served.open()
    mine, path = {"Authorization": f"Bearer {session.ego_token}"}, f"/v1/sessions/{session.session_id}/teammates"

    async def leave_and_join():
        left = await served.http.delete(f"{path}/rsu", headers=mine)
        return left, await served.http.post(path, json={"teammates": ["rsu"]}, headers=mine)

    for _ in range(2):
        assert [answer.status_code for answer in await leave_and_join()] == [204, 201]
    left, joined = await leave_and_join()
    problem(left, 429, "too-many-changes")
    problem(joined, 409, "already-enrolled")
    await served.ego(session).post_frame(0, ego_message, benign)
    assert (await leave_and_join())[0].status_code == 204


async def test_the_token_of_a_vehicle_that_left_stays_dead_when_it_comes_back(served, messages):
    session = await served.open()
    ego = served.ego(session)
    await ego.dismiss("rsu")
    with pytest.raises(AccessDenied):
        await served.teammate(session, "rsu").send(0, messages["rsu"])
    tokens = await ego.enrol(["rsu"])
    with pytest.raises(AccessDenied):
        await served.teammate(session, "rsu").send(0, messages["rsu"])
    await served.client.vehicle(session.session_id, "rsu", tokens["rsu"]).send(0, messages["rsu"])


async def test_refused_access_is_recorded_without_belief_in_what_it_claims(good_frame):
    async with serve(token_secrets=SECRET) as served:
        session = await served.open()
        liar = forged(session.ego_token, OTHER_SECRET)
        for _ in range(40):
            problem(await served.post(session, "frames", good_frame(0), liar), 401, "unauthenticated")
        answer = await served.post(session, "frames", good_frame(0))
        assert answer.status_code == 200
        records = await served.ego(session).audit()
        refused = [record for record in records if record["event"] == "access_refused"]
        assert len(refused) == 16
        assert {(record["vehicle_id"], record["reason"]) for record in refused} == {(None, "unauthenticated")}
        assert records[-1]["unlogged_refusals"] == {"?": 24}
        assert 'robosac_refused_messages_total{reason="unauthenticated"} 40' in (await served.http.get("/metrics")).text


async def test_refused_access_does_not_keep_a_session_from_expiring():
    async with serve(session_idle_s=0.3) as served:
        session = await served.open()
        for _ in range(30):
            await served.http.get(f"/v1/sessions/{session.session_id}", headers=bearer("x"))
            await asyncio.sleep(0.05)
        with pytest.raises(SessionNotFound):
            await served.ego(session).state()


@pytest.mark.parametrize("secrets", [("", ""), (SECRET, SECRET), (SECRET, f"{OTHER_SECRET},{SECRET}")])
async def test_tokens_outlive_a_restart_and_a_rotation_of_secrets(secrets, good_frame, tmp_path):
    database = f"sqlite:///{tmp_path}/robosac.db"
    async with serve(database_url=database, token_secrets=secrets[0]) as served:
        session = await served.open()
        mate = await served.teammate(session, "rsu").renew()
        path, key = f"/v1/sessions/{session.session_id}/token", "chosen-at-random-1"
        own = await renewed(served, path, bearer(session.teammate_tokens["car-2"]), key)
    async with serve(database_url=database, token_secrets=secrets[1]) as served:
        again = await renewed(served, path, bearer(session.teammate_tokens["car-2"]), key)
        assert again[1:] == own[1:]
        assert (await served.post(session, "frames", good_frame(0))).status_code == 200
        with pytest.raises(AccessDenied):
            await served.teammate(session, "rsu").renew()
        unit = served.client.vehicle(session.session_id, "rsu", mate.token)
        fresh = (await unit.renew()).token
    if secrets[1].startswith(OTHER_SECRET):
        async with serve(database_url=database, token_secrets=OTHER_SECRET) as served:
            await served.client.vehicle(session.session_id, "rsu", fresh).renew()
            with pytest.raises(AccessDenied):
                await served.ego(session).state()
