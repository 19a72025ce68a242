import threading
from http.server import BaseHTTPRequestHandler, HTTPServer

import httpx
import pytest
import typer
from typer.testing import CliRunner

from clients import fleet, flood, load_test
from clients.client import API_KEY_VARIABLE, GatewayClient
from clients.errors import ProtocolError


@pytest.fixture
def credentials():
    """Where a server listens that refuses everything, and what it was shown."""

    class Refusing(BaseHTTPRequestHandler):
        def do_POST(self):
            seen.append((self.path, self.headers["Authorization"]))
            self.send_error(401)

        def log_message(self, *_):
            pass

    seen = []
    with HTTPServer(("127.0.0.1", 0), Refusing) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}", seen
        server.shutdown()
        thread.join()


def command(function):
    app = typer.Typer()
    app.command()(function)
    return app


@pytest.mark.parametrize("by_option", [True, False])
def test_a_command_line_takes_a_key_from_the_option_or_the_environment(by_option, credentials, monkeypatch):
    url, seen = credentials
    if not by_option:
        monkeypatch.setenv("ROBOSAC_API_KEY", "a-key-of-the-fleet")
    arguments = ["--url", url, *(["--api-key", "a-key-of-the-fleet"] if by_option else [])]
    result = CliRunner().invoke(command(fleet.main), arguments)
    assert result.exit_code == 1
    assert seen == [("/v1/sessions", "Bearer a-key-of-the-fleet")]
    assert "a-key-of-the-fleet" not in result.output


@pytest.mark.parametrize("key", ["", "schl\u00fcssel", "two words", "line\n", "=a"])
def test_a_key_that_no_header_can_carry_is_refused_by_its_option(key):
    result = CliRunner().invoke(command(fleet.main), ["--url", "http://127.0.0.1:9", "--api-key", key])
    assert result.exit_code == 2
    assert "--api-key" in result.output
    assert "a key has only" in result.output


@pytest.mark.parametrize("module", [fleet, flood, load_test])
def test_every_command_that_opens_sessions_elsewhere_takes_a_key(module):
    (option,) = [one for one in typer.main.get_command(command(module.main)).params if one.name == "api_key"]
    assert option.envvar == API_KEY_VARIABLE


async def test_the_key_opens_sessions_and_goes_nowhere_else():
    seen = {}

    def answer(request):
        seen[request.url.path] = request.headers.get("authorization")
        return httpx.Response(200, json={"detectors": [], "token": "fresh", "expires_at": "2030-01-01T00:00:00Z"})

    async with GatewayClient("http://gateway", "the-key", transport=httpx.MockTransport(answer)) as client:
        await client.ready()
        await client.detectors()
        with pytest.raises(ProtocolError):
            await client.open_session("a", ["b"])
        vehicle = client.vehicle("s", "a", "stale")
        assert (await vehicle.renew()).token == "fresh"
        await vehicle.state()
    assert seen == {
        "/readyz": None,
        "/v1/detectors": None,
        "/v1/sessions": "Bearer the-key",
        "/v1/sessions/s/token": "Bearer stale",
        "/v1/sessions/s": "Bearer fresh",
    }
