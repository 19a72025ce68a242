"""A web page must not reach a gateway of the same machine, whatever name it resolves to loopback."""

import httpx
import pytest

from service.settings import Settings
from tests.service.conftest import problem, serve
from tests.service.test_identity import KEY, bearer

OPENING = {"ego_id": "a", "teammates": ["b"]}
OURS = ("localhost", "LocalHost:8000", "localhost.", "127.0.0.1", "127.8.0.9:80", "[::1]", "[::1]:8000",
        "[::ffff:127.0.0.1]")  # fmt: skip
FOREIGN = ("evil.example", "evil.example:8000", "localhost.evil.example", "127.0.0.1.evil.example", "0.0.0.0",
           "10.1.2.3:8000", "[::]", "[2001:db8::1]", "", ":8000", "localhost:8000:80", "evil@localhost",
           "localhost/", "[localhost", "gateway.example.evil")  # fmt: skip


async def opened(served, **headers):
    return await served.http.post("/v1/sessions", json=OPENING, headers=headers)


@pytest.fixture
async def local():
    async with serve(allowed_hosts="") as served:
        yield served


async def test_loopback_may_be_called_by_any_of_its_names(local):
    for host in OURS:
        assert (await opened(local, Host=host)).status_code == 201, host
        for origin in (f"http://{host}", f"https://{host}"):
            assert (await opened(local, Host="127.0.0.1:8000", Origin=origin)).status_code == 201, origin


async def test_other_names_are_refused_before_anything_else_is_looked_at(local):
    for host in FOREIGN:
        refused = await opened(local, Host=host)
        assert problem(refused, 421, "foreign-host")["field"] == "Host", host
        assert refused.headers["connection"] == "close"
        for path in ("/readyz", "/metrics", "/docs", "/v1/detectors", "/nowhere"):
            problem(await local.http.get(path, headers={"Host": host}), 421, "foreign-host")
        assert (await local.http.get("/healthz", headers={"Host": host})).status_code == 200
    assert not await local.gateway.store.count()


async def test_two_names_or_none_are_no_name(local):
    transport = local.http._transport
    for hosts in ([], [("Host", "localhost"), ("Host", "evil.example")], [("Host", "localhost")] * 2):
        request = httpx.Request("GET", "http://localhost/readyz")
        request.headers = httpx.Headers(hosts)
        response = await transport.handle_async_request(request)
        assert response.status_code == 421


async def test_a_request_names_its_host_once_where_keys_are_set_too():
    async with serve(allowed_hosts="", api_keys=KEY) as served:
        request = httpx.Request("GET", "http://localhost/readyz")
        for hosts, status in ((["localhost"], 200), (["any.example"], 200), (["localhost", "any.example"], 421)):
            request.headers = httpx.Headers([("Host", host) for host in hosts])
            assert (await served.http._transport.handle_async_request(request)).status_code == status


async def test_pages_of_other_hosts_are_refused(local):
    for origin in ("null", "", "http://[", *(f"http://{host}" for host in FOREIGN if host[-1:] != "/")):
        refused = await opened(local, Host="localhost:8000", Origin=origin)
        assert problem(refused, 403, "foreign-origin")["field"] == "Origin", origin
    assert not await local.gateway.store.count()


@pytest.mark.parametrize("keys", ["", KEY])
async def test_the_operator_names_others(keys):
    names = "Gateway.example, 10.1.2.3, [2001:db8::1]"
    async with serve(allowed_hosts=names, api_keys=keys, public_url="https://Public.example/v") as served:
        for host in (
            "public.example",
            "gateway.example:8000",
            "GATEWAY.example",
            "10.1.2.3:8000",
            "[2001:db8::1]",
            "localhost",
        ):
            assert (await opened(served, Host=host, **bearer(KEY))).status_code == 201, host
        problem(await opened(served, Host="evil.example", **bearer(KEY)), 421, "foreign-host")
        origin = {"Host": "localhost", "Origin": "http://evil.example"}
        problem(await opened(served, **origin, **bearer(KEY)), 403, "foreign-origin")


async def test_with_a_key_and_no_names_every_name_is_good():
    async with serve(allowed_hosts="", api_keys=KEY) as served:
        headers = {"Host": "gateway.example", "Origin": "http://gateway.example", **bearer(KEY)}
        assert (await opened(served, **headers)).status_code == 201


@pytest.mark.parametrize("name", ["http://gateway.example", "gateway.example:8000", "*", "::1", "a b"])
def test_what_is_no_name_is_refused_at_the_start(name):
    with pytest.raises(ValueError, match="allowed_hosts"):
        Settings(allowed_hosts=f"localhost,{name}")
