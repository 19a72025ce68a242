import asyncio

import httpx
import pytest

from clients.errors import AccessDenied
from robosac import wire
from service.app import create_app
from service.arriving.doors import is_local
from service.settings import Settings
from tests.service.conftest import EGO, TEAM, problem, serve
from tests.service.credentials import KEY, OPENING, OTHER_KEY, SECRET, bearer

ANYBODY, KEY_HOLDER, ANY_VEHICLE, EGO_ONLY, VIEWER = "anybody", "key holder", "any vehicle", "ego only", "viewer"
TOKEN = "a-viewers-token-0123"
RULES = {
    "GET /openapi.json": ANYBODY,
    "GET /docs": ANYBODY,
    "GET /": ANYBODY,
    "GET /live/{name}": ANYBODY,
    "GET /v1/live": VIEWER,
    "GET /v1/live/{sid}": VIEWER,
    "GET /redoc": ANYBODY,
    "GET /healthz": ANYBODY,
    "GET /readyz": ANYBODY,
    "GET /metrics": ANYBODY,
    "GET /v1/detectors": ANYBODY,
    "GET /v1/keys": ANYBODY,
    "POST /v1/sessions": KEY_HOLDER,
    "POST /v1/sessions/{sid}/token": ANY_VEHICLE,
    "POST /v1/sessions/{sid}/messages": ANY_VEHICLE,
    "POST /v1/sessions/{sid}/frames": EGO_ONLY,
    "GET /v1/sessions/{sid}/standby": ANY_VEHICLE,
    "GET /v1/sessions/{sid}/frames/{frame}/messages": EGO_ONLY,
    "GET /v1/sessions/{sid}": EGO_ONLY,
    "DELETE /v1/sessions/{sid}": EGO_ONLY,
    "POST /v1/sessions/{sid}/teammates": EGO_ONLY,
    "DELETE /v1/sessions/{sid}/teammates/{vehicle_id}": EGO_ONLY,
    "GET /v1/sessions/{sid}/audit": EGO_ONLY,
}


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
    async with serve(api_key=KEY, api_keys=KEY, viewer_tokens=TOKEN) as served:
        session, other = await served.open(), await served.open()
        path = path.format(sid=session.session_id, vehicle_id="car-3", frame=0, name="live.js")

        async def call(credential):
            body = {"json": {"teammates": ["car-9"]}} if path.endswith("/teammates") else {}
            asking = asyncio.create_task(served.http.request(method, path, headers=bearer(credential), **body))
            while not asking.done():
                live.send_away()  # or the stream of who stands by would not end
                await asyncio.sleep(0.001)
            return await asking

        live = served.gateway.sessions.in_use(session.session_id)
        if RULES[route] == ANYBODY:
            assert (await call(None)).status_code == 200
            return
        strangers = [None, "x", other.ego_token, other.teammate_tokens["car-2"], TOKEN]
        if RULES[route] == VIEWER:
            for credential in [*strangers[:-1], session.ego_token, KEY, TOKEN[:-1]]:
                problem(await call(credential), 401, "unauthenticated")
            assert (await call(TOKEN)).status_code in (200, 404)  # nothing was answered yet
            return
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
    told = own.json()
    assert set(told.pop("receipt")) == {"session", "seq", "head", "key_id", "signature"}
    assert (own.status_code, told) == (202, {"frame": 0, "vehicle_id": "car-2", "status": "accepted"})
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
        (
            {"api_keys_file": "/nonesuch/keys"},
            "ROBOSAC_API_KEYS_FILE: /nonesuch/keys cannot be read: No such file",
        ),
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
