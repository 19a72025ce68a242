import typer
import uvicorn
from typer.testing import CliRunner

from service.command import main


def test_serve_runs_the_gateway_where_it_is_told(monkeypatch):
    runs = []
    monkeypatch.setattr(uvicorn, "run", lambda *given, **options: runs.append((given, options)))
    command = typer.Typer()
    command.command()(main)
    result = CliRunner().invoke(command, ["--host", "0.0.0.0", "--port", "9000"])
    assert result.exit_code == 0, result.output
    (((place,), options),) = runs
    assert place == "service.app:app"
    assert (options["host"], options["port"]) == ("0.0.0.0", 9000)
    assert options["timeout_graceful_shutdown"] == 5
