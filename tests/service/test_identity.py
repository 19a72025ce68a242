import asyncio
import base64
import json
import time
from datetime import datetime

import httpx
import jwt
import pytest

from clients.errors import AccessDenied, InvalidRequest, SessionNotFound
from robosac import wire
from service.app import create_app
from service.arriving.doors import is_local
from service.sessions.identity import AUDIENCE, CLAIMS, ISSUER
from service.settings import Settings
from tests.service.conftest import EGO, TEAM, problem, serve

KEY, OTHER_KEY = "key-number-one-0123", "key-number-two-4567"
SECRET, OTHER_SECRET = "s" * 32, "t" * 40
OPENING = {"ego_id": "a", "teammates": ["b"]}
ANYBODY, KEY_HOLDER, ANY_VEHICLE, EGO_ONLY = "anybody", "key holder", "any vehicle", "ego only"
RULES = {
    "GET /openapi.json": ANYBODY,
    "GET /docs": ANYBODY,
    "GET /docs/oauth2-redirect": ANYBODY,
    "GET /redoc": ANYBODY,
    "GET /healthz": ANYBODY,
    "GET /readyz": ANYBODY,
    "GET /metrics": ANYBODY,
    "GET /v1/detectors": ANYBODY,
    "POST /v1/sessions": KEY_HOLDER,
    "POST /v1/sessions/{sid}/token": ANY_VEHICLE,
    "POST /v1/sessions/{sid}/messages": ANY_VEHICLE,
    "POST /v1/sessions/{sid}/frames": EGO_ONLY,
    "GET /v1/sessions/{sid}/frames/{frame}/messages": EGO_ONLY,
    "GET /v1/sessions/{sid}": EGO_ONLY,
    "DELETE /v1/sessions/{sid}": EGO_ONLY,
    "POST /v1/sessions/{sid}/teammates": EGO_ONLY,
    "DELETE /v1/sessions/{sid}/teammates/{vehicle_id}": EGO_ONLY,
    "GET /v1/sessions/{sid}/audit": EGO_ONLY,
}


def bearer(credential):
    return {} if credential is None else {"Authorization": f"Bearer {credential}"}


def claims_of(token):
    return jwt.decode(token, options={"verify_signature": False})


def forged(token, secret=SECRET, algorithm="HS256", headers=None, without=(), **changes):
    """A token that says the same but for the changes."""
    claims = {name: value for name, value in {**claims_of(token), **changes}.items() if name not in without}
    return jwt.encode(claims, secret, algorithm, headers)


def segment(content: bytes) -> str:
    return base64.urlsafe_b64encode(content).rstrip(b"=").decode()


def routes_of(router):
    for route in router.routes:
        inner = getattr(route, "original_router", route)
        if hasattr(inner, "routes"):
            yield from routes_of(inner)
        else:
            yield from (f"{method} {route.path}" for method in route.methods - {"HEAD"})


def test_every_route_has_a_rule():
    app = create_app(Settings())
    routes = list(routes_of(app))
    described = {f"{method.upper()} {path}" for path, item in app.openapi()["paths"].items() for method in item}
    assert sorted(routes) == sorted(RULES)
    assert described <= set(RULES)


@pytest.mark.parametrize("route", RULES)
async def test_every_route_keeps_its_rule(route):
    method, path = route.split()
    async with serve(api_key=KEY, api_keys=KEY) as served:
        session, other = await served.open(), await served.open()
        path = path.format(sid=session.session_id, vehicle_id="car-3", frame=0)

        async def call(credential):
            body = {"json": {"teammates": ["car-9"]}} if path.endswith("/teammates") else {}
            return await served.http.request(method, path, headers=bearer(credential), **body)

        if RULES[route] == ANYBODY:
            assert (await call(None)).status_code == 200
            return
        strangers = [None, "x", other.ego_token, other.teammate_tokens["car-2"]]
        if RULES[route] == KEY_HOLDER:
            for credential in [*strangers, session.ego_token, KEY[:-1], KEY + "4", OTHER_KEY]:
                problem(await call(credential), 401, "unauthenticated")
            problem(await call(KEY), 415, "unsupported-media-type")
            return
        for credential in [*strangers, KEY]:
            problem(await call(credential), 401, "unauthenticated")
        answer = await call(session.teammate_tokens["car-2"])
        if RULES[route] == EGO_ONLY:
            problem(answer, 403, "ego-only")
        else:
            assert answer.status_code not in (401, 403, 404)
        events = {record["event"] for record in await served.ego(session).audit()}
        allowed = {"token_renewed"} if RULES[route] == ANY_VEHICLE else set()
        assert events <= {"session_opened", "access_refused", "message_refused"} | allowed
        assert (await served.ego(session).state())["teammates"] == list(TEAM)
        assert (await call(session.ego_token)).status_code not in (401, 403)


async def test_a_teammate_sends_as_itself_and_sees_no_more_than_a_receipt(served, messages):
    session = await served.open()
    token = session.teammate_tokens["car-2"]
    for speaker in (EGO, "car-3"):
        body = wire.pack_message(0, speaker, messages[speaker])
        problem(await served.post(session, "messages", body, token), 403, "wrong-vehicle")
    own = await served.post(session, "messages", wire.pack_message(0, "car-2", messages["car-2"]), token)
    assert (own.status_code, own.json()) == (202, {"frame": 0, "vehicle_id": "car-2", "status": "accepted"})
    assert (await served.ego(session).state())["frames_answered"] == 0


async def test_any_of_the_keys_opens_a_session_and_the_client_sends_its_own(tmp_path):
    file = tmp_path / "keys"
    file.write_text(f"{OTHER_KEY}\n\nkey-number-three-89  \n")
    async with serve(api_key=OTHER_KEY, api_keys=f" {KEY},key-of-last-month-0", api_keys_file=file) as served:
        for key in (KEY, "key-of-last-month-0", OTHER_KEY, "key-number-three-89"):
            response = await served.http.post("/v1/sessions", json=OPENING, headers={"Authorization": f"bearer {key}"})
            assert response.status_code == 201
        await served.open()
        response = await served.http.post("/v1/sessions", json=OPENING, headers={"Authorization": f"Basic {KEY}"})
        problem(response, 401, "unauthenticated")
        assert response.headers["www-authenticate"] == "Bearer"


async def test_a_retired_key_opens_nothing_while_its_sessions_live_on(tmp_path):
    database = f"sqlite:///{tmp_path}/robosac.db"
    async with serve(database_url=database, api_key=KEY, api_keys=KEY) as served:
        session = await served.open()
    async with serve(database_url=database, api_key=KEY, api_keys=OTHER_KEY) as served:
        with pytest.raises(AccessDenied):
            await served.open()
        assert (await served.ego(session).state())["session_id"] == session.session_id


async def test_the_key_is_asked_for_before_the_body_is_read():
    async with serve(api_keys=KEY) as served:
        junk = {"content": b"{", "headers": {"Content-Type": "application/json"}}
        problem(await served.http.post("/v1/sessions", **junk), 401, "unauthenticated")


@pytest.mark.parametrize(
    ("settings", "hint"),
    [
        ({"api_keys": f"{KEY},too-short-012345"[:-2]}, "ROBOSAC_API_KEYS: key 2 has fewer than 16"),
        ({"api_keys": "has a blank inside it"}, "ROBOSAC_API_KEYS: key 1 has characters"),
        ({"api_keys": "schlüssel-0123456789"}, "ROBOSAC_API_KEYS: key 1 has characters"),
        ({"token_secrets": SECRET + "," + "x" * 31}, "ROBOSAC_TOKEN_SECRETS: secret 2 has fewer than 32"),
        ({"api_keys_file": "/nonesuch/keys"}, "ROBOSAC_API_KEYS_FILE: /nonesuch/keys cannot be read"),
    ],
)
def test_a_weak_or_missing_secret_keeps_the_gateway_from_starting(settings, hint):
    with pytest.raises(ValueError, match=hint) as caught:
        create_app(Settings(**settings))
    given = settings.get("api_keys") or settings.get("token_secrets", "")
    assert not any(secret in str(caught.value) for secret in given.split(",") if secret)


@pytest.mark.parametrize(("content", "hint"), [("\n \n", "holds no key"), (f"{KEY}\nshort\n", "line 2 has fewer")])
def test_a_key_file_without_good_keys_keeps_the_gateway_from_starting(tmp_path, content, hint):
    (tmp_path / "keys").write_text(content)
    with pytest.raises(ValueError, match=hint):
        create_app(Settings(api_keys_file=tmp_path / "keys"))


async def test_secrets_come_from_the_environment_and_show_nowhere(monkeypatch, caplog):
    caplog.set_level("DEBUG")
    monkeypatch.setenv("ROBOSAC_API_KEYS", f"{KEY},{OTHER_KEY}")
    monkeypatch.setenv("ROBOSAC_TOKEN_SECRETS", SECRET)
    monkeypatch.setenv("ROBOSAC_TOKEN_TTL_S", "0")
    with pytest.raises(ValueError, match="token_ttl_s") as caught:
        Settings()
    monkeypatch.setenv("ROBOSAC_TOKEN_TTL_S", "60")
    async with serve(api_key=KEY) as served:
        session = await served.open()
        lines = await served.ego(session).audit_lines()
        shown = [str(caught.value), repr(Settings()), caplog.text, *lines, (await served.http.get("/metrics")).text]
        for secret in (KEY, OTHER_KEY, SECRET, session.ego_token):
            assert not any(secret in text for text in shown)


def scope(client, server=("0.0.0.0", 8000), headers=(), **more):
    return {"type": "http", "client": client, "server": server, "headers": list(headers), **more}


@pytest.mark.parametrize(
    ("peer", "local"),
    [
        ("127.0.0.1", True),
        ("127.8.0.1", True),
        ("::1", True),
        ("::ffff:127.0.0.1", True),
        ("::ffff:10.0.0.1", False),
        ("10.0.0.1", False),
        ("0.0.0.0", False),
        ("fe80::1%eth0", False),
        ("localhost", False),
        ("", False),
    ],
)
def test_loopback_is_told_from_the_rest(peer, local):
    assert is_local(scope((peer, 5))) is local
    for name in (b"x-forwarded-for", b"forwarded"):
        assert not is_local(scope((peer, 5), headers=[(name, b"127.0.0.1")]))


def test_a_unix_socket_is_local_and_a_peer_without_address_is_not():
    assert is_local(scope(None, ("/run/gateway.sock", None)))
    assert not is_local(scope(None, ("127.0.0.1", 8000)))
    assert not is_local(scope(None, None))


@pytest.mark.parametrize("keys", ["", KEY])
async def test_without_a_key_other_machines_are_not_served(keys, caplog):
    app = create_app(Settings(api_keys=keys))
    transport = httpx.ASGITransport(app, client=("10.1.2.3", 40000))
    async with (
        app.router.lifespan_context(app),
        httpx.AsyncClient(base_url="http://gateway", transport=transport) as http,
    ):
        assert (await http.get("/healthz")).status_code == 200
        for method, path in (route.split() for route in RULES if route != "GET /healthz"):
            response = await http.request(method, path, headers=bearer(KEY))
            if keys:
                assert response.status_code != 403
            else:
                problem(response, 403, "loopback-only")
        problem(await http.get("/nowhere"), *((404, "not-found") if keys else (403, "loopback-only")))
    said = [record.getMessage() for record in caplog.records if "API key" in record.getMessage()]
    assert len(said) == (0 if keys else 1)


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
        assert changed == {"audit_seq", "audit_head"}
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


async def test_a_vehicle_that_leaves_while_it_waits_for_a_token_gets_none(served):
    session = await served.open()
    async with (await served.gateway.sessions.authenticate(session.session_id, session.ego_token)).live.lock:
        leaving = asyncio.create_task(served.ego(session).dismiss("rsu"))
        await asyncio.sleep(0.05)
        waiting = asyncio.create_task(served.teammate(session, "rsu").renew())
        await asyncio.sleep(0.05)
    await leaving
    with pytest.raises(AccessDenied):
        await waiting
    assert "rsu" not in (await served.ego(session).state())["teammates"]


async def test_renewals_are_bounded_between_two_frames(served, ego_message, benign):
    session = await served.open()
    unit, ego = served.teammate(session, "rsu"), served.ego(session)
    for _ in range(16):
        await unit.renew()
    with pytest.raises(InvalidRequest) as caught:
        await unit.renew()
    assert (caught.value.status, caught.value.type) == (429, "urn:robosac:problem:too-many-renewals")
    await ego.post_frame(0, ego_message, benign)
    await unit.renew()


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
        renewed = await served.teammate(session, "rsu").renew()
    async with serve(database_url=database, token_secrets=secrets[1]) as served:
        assert (await served.post(session, "frames", good_frame(0))).status_code == 200
        with pytest.raises(AccessDenied):
            await served.teammate(session, "rsu").renew()
        unit = served.client.vehicle(session.session_id, "rsu", renewed.token)
        fresh = (await unit.renew()).token
    if secrets[1].startswith(OTHER_SECRET):
        async with serve(database_url=database, token_secrets=OTHER_SECRET) as served:
            await served.client.vehicle(session.session_id, "rsu", fresh).renew()
            with pytest.raises(AccessDenied):
                await served.ego(session).state()
