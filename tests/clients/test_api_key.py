import httpx
import pytest
import typer
from typer.testing import CliRunner

from clients import fleet, load_test
from clients.client import GatewayClient
from clients.errors import GatewayUnreachable, ProtocolError


@pytest.mark.parametrize("module", [fleet, load_test])
@pytest.mark.parametrize("by_option", [True, False])
def test_the_command_lines_take_a_key_from_the_option_or_the_environment(module, by_option, monkeypatch):
    seen = []

    class Recorder:
        def __init__(self, url, api_key):
            seen.append(api_key)
            raise GatewayUnreachable(url)

    monkeypatch.setattr(module, "GatewayClient", Recorder)
    monkeypatch.setattr(load_test, "prepare", lambda *_: None)
    if not by_option:
        monkeypatch.setenv("ROBOSAC_API_KEY", "a-key-of-the-fleet")
    app = typer.Typer()
    app.command()(module.main)
    arguments = ["--url", "http://gateway", *(["--api-key", "a-key-of-the-fleet"] if by_option else [])]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 1
    assert seen == ["a-key-of-the-fleet"]
    assert "a-key-of-the-fleet" not in result.output


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
