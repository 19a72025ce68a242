import asyncio
import base64
import itertools
import json
import time

import httpx
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from clients.errors import AccessDenied
from robosac.audit import verify
from robosac.possession import make_proof
from robosac.signatures import show_public_key
from service.settings import Settings
from tests.service.conftest import EGO, TEAM, problem, serve
from tests.service.credentials import bearer

KEYS = {name: Ed25519PrivateKey.generate() for name in (EGO, "rsu")}
SHOWN = {name: show_public_key(key) for name, key in KEYS.items()}
THIEF = Ed25519PrivateKey.generate()
NONE = {"kind": "none"}
CALLS = {
    "renew": ("POST", "/token", "rsu"),
    "renew as ego": ("POST", "/token", EGO),
    "enrol": ("POST", "/teammates", EGO),
    "dismiss": ("DELETE", "/teammates/rsu", EGO),
    "close": ("DELETE", "", EGO),
}


@pytest.fixture
async def session(served):
    return await served.open(defense=NONE, public_keys=SHOWN)


def token_of(session, vehicle):
    return session.ego_token if vehicle == EGO else session.teammate_tokens[vehicle]


async def call(served, session, name, *proofs, key=None, **changes):
    """A call with a token and some proofs; with a key, one more, that is good but for some changes."""
    method, end, vehicle = CALLS[name]
    token, path = token_of(session, vehicle), f"/v1/sessions/{session.session_id}{end}"
    if key is not None:
        about = {"method": method, "url": f"http://gateway{path}", "token": token, **changes}
        proofs = (*proofs, make_proof(key, **about))
    headers = [*bearer(token).items(), *(("DPoP", proof) for proof in proofs)]
    body = {"json": {"teammates": ["car-9"]}} if name == "enrol" else {}
    return await served.http.request(method, path, headers=headers, **body)


def refused(response, why):
    fields = problem(response, 401, "bad-proof")
    assert fields["field"] == "DPoP"
    assert why in fields["detail"]
    assert response.headers["www-authenticate"] == 'DPoP algs="EdDSA", error="invalid_dpop_proof"'


async def events(served, session, *kinds):
    ego = served.client.vehicle(session.session_id, EGO, session.ego_token, KEYS[EGO])
    lines = await ego.audit_lines()
    assert verify([line.encode() for line in lines]) == []
    return [record for record in map(json.loads, lines) if record["event"] in kinds]


@pytest.mark.parametrize("name", CALLS)
async def test_a_stolen_token_changes_nothing(served, session, name):
    vehicle = CALLS[name][2]
    before = await served.gateway.store.get(session.session_id)
    refused(await call(served, session, name), "there is none")
    refused(await call(served, session, name, "x"), "not a JWT")
    refused(await call(served, session, name, key=THIEF), "not the key that the vehicle registered")
    other = next(key for owner, key in KEYS.items() if owner != vehicle)
    refused(await call(served, session, name, key=other), "not the key that the vehicle registered")
    refused(await call(served, session, name, key=KEYS[vehicle], method="GET"), "htm must be")
    refused(await call(served, session, name, key=KEYS[vehicle], url="http://gateway/v1/sessions/x"), "htu must be")
    refused(await call(served, session, name, key=KEYS[vehicle], token="another"), "ath must be")
    refused(await call(served, session, name, key=KEYS[vehicle], made_at=time.time() - 3600), "iat is more than")
    twice = [make_proof(KEYS[vehicle], "POST", "http://gateway", "x") for _ in range(2)]
    refused(await call(served, session, name, *twice), "there are several")
    after = await served.gateway.store.get(session.session_id)
    assert (after.token_ids, after.teammates, after.ended_at) == (before.token_ids, before.teammates, None)
    assert {record["event"] for record in await events(served, session, "token_renewed", "team_changed")} == set()
    on_record = await events(served, session, "message_refused")
    assert [(r["vehicle_id"], r["field"], r["reason"]) for r in on_record] == [(vehicle, "DPoP", "unauthenticated")] * 9
    assert (await call(served, session, name, key=KEYS[vehicle])).is_success


@pytest.mark.parametrize("name", CALLS)
async def test_what_the_token_may_not_do_no_proof_allows(served, session, name):
    method, end, _ = CALLS[name]
    path = f"/v1/sessions/{session.session_id}{end}"
    for token in ("x", session.teammate_tokens["car-2"]):
        proof = make_proof(KEYS[EGO], method, f"http://gateway{path}", token)
        response = await served.http.request(method, path, headers={**bearer(token), "DPoP": proof})
        assert response.status_code == (401 if token == "x" else 201 if end == "/token" else 403)


async def test_the_client_proves_by_itself_what_its_vehicle_has(served, session):
    ego = served.client.vehicle(session.session_id, EGO, session.ego_token, KEYS[EGO])
    unit = served.client.vehicle(session.session_id, "rsu", session.teammate_tokens["rsu"], KEYS["rsu"])
    await unit.renew()
    await unit.renew()
    await ego.renew()
    await ego.enrol(["car-9"])
    await ego.dismiss("rsu")
    with pytest.raises(AccessDenied, match="has left"):
        await unit.renew()
    assert len(await ego.close()) == 64


async def test_vehicles_without_a_key_need_no_proof(served, session):
    await served.teammate(session, "car-2").renew()
    with pytest.raises(AccessDenied, match="bad-proof"):
        await served.teammate(session, "rsu").renew()
    with pytest.raises(AccessDenied, match="bad-proof"):
        await served.ego(session).close()


async def test_a_proof_counts_once(served, session):
    ego = served.client.vehicle(session.session_id, EGO, session.ego_token, KEYS[EGO])
    proof = make_proof(KEYS[EGO], "DELETE", f"http://gateway/v1/sessions/{session.session_id}/teammates/rsu", ego.token)
    assert (await call(served, session, "dismiss", proof)).status_code == 204
    await ego.enrol(["rsu"])
    refused(await call(served, session, "dismiss", proof), "used before")
    answers = await asyncio.gather(*(call(served, session, "enrol", proof) for _ in range(4)))
    for answer in answers:
        refused(answer, "htm must be POST")


async def test_of_the_same_proof_at_once_one_counts(served, session):
    proof = make_proof(KEYS[EGO], "DELETE", f"http://gateway/v1/sessions/{session.session_id}", session.ego_token)
    answers = await asyncio.gather(*(call(served, session, "close", proof) for _ in range(6)))
    assert sorted(answer.status_code for answer in answers)[0] == 204
    assert sum(answer.status_code == 204 for answer in answers) == 1


async def test_a_used_proof_stays_used_after_a_restart_and_for_another_gateway(tmp_path):
    database = f"sqlite:///{tmp_path}/robosac.db"
    async with serve(database_url=database) as one, serve(database_url=database) as two:
        session = await one.open(defense=NONE, public_keys=SHOWN)
        url = f"http://gateway/v1/sessions/{session.session_id}/teammates/rsu"
        proof = make_proof(KEYS[EGO], "DELETE", url, session.ego_token)
        assert (await call(one, session, "dismiss", proof)).status_code == 204
        refused(await call(two, session, "dismiss", proof), "used before")
    async with serve(database_url=database) as again:
        refused(await call(again, session, "dismiss", proof), "used before")
        fresh = await call(again, session, "dismiss", key=KEYS[EGO])
        problem(fresh, 404, "unknown-teammate")


async def test_a_gateway_whose_clock_is_ahead_forgets_no_proof_that_counts_elsewhere(tmp_path):
    database = f"sqlite:///{tmp_path}/robosac.db"
    now = time.time()
    at = [now]  # by the first one's clock
    behind = serve(clock=lambda: at[0], database_url=database)
    ahead = serve(clock=lambda: at[0] + 55, database_url=database)
    async with behind as one, ahead as two:
        session = await one.open(defense=NONE, public_keys=SHOWN)
        path = f"/v1/sessions/{session.session_id}/teammates/rsu"
        used = make_proof(KEYS[EGO], "DELETE", f"http://gateway{path}", session.ego_token, at[0])
        assert (await call(one, session, "dismiss", used)).status_code == 204
        at[0] = now + 45
        other = await call(two, session, "dismiss", key=KEYS[EGO], made_at=at[0])
        problem(other, 404, "unknown-teammate")
        at[0] = now + 46
        refused(await call(one, session, "dismiss", used), "used before")


async def test_used_proofs_are_bounded_and_forgotten_once_they_would_not_count():
    late = [0.0]
    async with serve(clock=lambda: time.time() + late[0]) as served:
        session = await served.open(defense=NONE, public_keys=SHOWN)
        store, now = served.gateway.store, time.time()

        async def used(vehicle, count, now):
            return [await store.use_proof(session.session_id, vehicle, f"{n}", now + 80, now) for n in range(count)]

        assert all(await used(EGO, 256, now))
        full = await call(served, session, "close", key=KEYS[EGO])
        problem(full, 429, "too-many-proofs")
        assert full.headers["retry-after"] == "60"
        assert (await call(served, session, "renew", key=KEYS["rsu"])).status_code == 201
        late[0] = 100.0
        gone = await call(served, session, "close", key=KEYS[EGO], made_at=now + late[0])
        assert gone.status_code == 204


async def test_the_scheme_of_the_standard_carries_a_token_as_well(served, session):
    path = f"/v1/sessions/{session.session_id}/token"
    token = session.teammate_tokens["rsu"]
    proof = make_proof(KEYS["rsu"], "POST", f"http://gateway{path}", token)
    headers = {"Authorization": f"DPoP {token}", "DPoP": proof}
    assert (await served.http.post(path, headers=headers)).status_code == 201
    headers = {"Authorization": f"Basic {session.teammate_tokens['car-2']}"}
    problem(await served.http.post(path, headers=headers), 401, "unauthenticated")


async def test_a_gateway_that_knows_its_address_takes_no_proof_for_another():
    async with serve(public_url="https://gateway.example/fleet") as served:
        session = await served.open(defense=NONE, public_keys=SHOWN)
        path = f"/v1/sessions/{session.session_id}/token"
        refused(await call(served, session, "renew", key=KEYS["rsu"]), "htu must be https://gateway.example/fleet/v1")
        good = await call(served, session, "renew", key=KEYS["rsu"], url=f"https://gateway.example/fleet{path}")
        assert good.status_code == 201


@pytest.mark.parametrize(
    "url", ["gateway.example", "ftp://gateway.example", "https://", "https://a/?b", "https://a/#b"]
)
def test_a_public_url_that_is_none_is_refused(url):
    with pytest.raises(ValueError, match="public_url"):
        Settings(public_url=url)


def torsion():
    """All encodings of points of small order, worked out from the curve: eight points, and what decodes to them."""
    p = 2**255 - 19
    d = -121665 * pow(121666, -1, p) % p
    root = pow(2, (p - 1) // 4, p)

    def x_of(y):
        square = (y * y - 1) * pow(d * y * y + 1, -1, p) % p
        x = pow(square, (p + 3) // 8, p)
        x = x if x * x % p == square else x * root % p
        return x if x * x % p == square else None

    def add(a, b):
        k = d * a[0] * b[0] * a[1] * b[1] % p
        x = (a[0] * b[1] + a[1] * b[0]) * pow(1 + k, -1, p) % p
        return x, (a[1] * b[1] + a[0] * b[0]) * pow(1 - k, -1, p) % p

    def times(n, point):
        total = (0, 1)
        for bit in bin(n)[2:]:
            total = add(total, total)
            total = add(total, point) if bit == "1" else total
        return total

    order = 2**252 + 27742317777372353535851937790883648493
    points = set()
    for y in itertools.count(2):
        if x_of(y) is not None:
            small = times(order, (x_of(y), y))
            points |= {times(n, small) for n in range(8)}
        if len(points) == 8:
            break
    heights = {y for _, y in points}
    encoded = {y + k * p for y in heights for k in (0, 1) if y + k * p < 2**255}
    return sorted({(y | sign << 255).to_bytes(32, "little") for y in encoded for sign in (0, 1)})


SMALL = torsion()


def test_there_are_fourteen_encodings_of_small_order():
    assert len(SMALL) == 14


async def test_no_session_takes_a_key_of_small_order_or_in_another_form(served, session):
    others = [(y + 2**255 - 19 | sign << 255).to_bytes(32, "little") for y in range(2, 19) for sign in (0, 1)]
    for raw in (*SMALL, *others):
        keys = {"car-9": base64.b64encode(raw).decode()}
        opening = {"ego_id": EGO, "teammates": ["car-9"], "public_keys": keys}
        opened = await served.http.post("/v1/sessions", json=opening)
        assert problem(opened, 422, "invalid-request")["field"] == "public_keys.car-9"
    plain = await served.open(defense=NONE)
    enrolling = {"teammates": ["car-9"], "public_keys": keys}
    path = f"/v1/sessions/{plain.session_id}/teammates"
    enrolled = await served.http.post(path, json=enrolling, headers=bearer(plain.ego_token))
    assert problem(enrolled, 422, "invalid-request")["field"] == "public_keys.car-9"


async def test_a_proof_is_looked_at_before_a_body_is(served, session):
    async def endless():
        raise AssertionError("the body was read")
        yield b""

    path = f"/v1/sessions/{session.session_id}/teammates"
    headers = {**bearer(session.ego_token), "Content-Type": "application/json"}
    async with httpx.AsyncClient(base_url="http://gateway", transport=served.http._transport) as http:
        refused(await http.post(path, content=endless(), headers=headers), "there is none")
    assert tuple((await served.ego(session).state())["teammates"]) == TEAM
