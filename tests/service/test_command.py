import json
import os
import re
import signal
import socket
import subprocess
import sys
import time

import httpx
import pytest
import typer
from typer.testing import CliRunner

from service.arriving.connections import HEAD_BYTES
from service.command import main

PROGRAM = "import typer; from service.command import main; typer.run(main)"


def test_serve_runs_the_gateway_where_it_is_told_until_it_is_terminated(tmp_path):
    command = [sys.executable, "-c", PROGRAM, "--host", "127.0.0.2", "--port", "0"]
    environment = os.environ | {"ROBOSAC_DATABASE_URL": f"sqlite:///{tmp_path}/robosac.db"}
    with (tmp_path / "log").open("wb") as log:
        process = subprocess.Popen(command, env=environment, stdout=log, stderr=log)
    try:
        end, found = time.monotonic() + 60, None
        while found is None:
            text = (tmp_path / "log").read_text()
            found = re.search(r"http://(127\.0\.0\.2):(\d+)", text)
            assert process.poll() is None, text
            assert time.monotonic() < end, text
            time.sleep(0.1)
        assert httpx.get(f"{found[0]}/readyz", trust_env=False).json() == {"status": "ready"}
        with socket.create_connection((found[1], int(found[2]))) as connection:
            connection.sendall(b"GET /healthz HTTP/1.1\r\nlong: " + b"x" * HEAD_BYTES)
            assert connection.recv(64).startswith(b"HTTP/1.1 431")
    finally:
        process.send_signal(signal.SIGTERM)
        assert process.wait(30) in (0, -signal.SIGTERM)
    events = [json.loads(line)["event"] for line in (tmp_path / "log").read_text().splitlines()]
    assert "gateway stopped" in events
    assert events[0].startswith("Started server process")
    assert events[-1].startswith("Finished server process")


def test_a_host_that_there_is_not_is_named_before_anything_starts():
    own = typer.Typer()
    own.command()(main)
    result = CliRunner().invoke(own, ["--host", "999.1.1.1"], env={"COLUMNS": "300"})
    assert result.exit_code == 2
    assert "Invalid value for --host: 999.1.1.1: " in result.output


def test_a_port_that_is_taken_is_named_before_anything_starts():
    own = typer.Typer()
    own.command()(main)
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        result = CliRunner().invoke(own, ["--port", str(port)], env={"COLUMNS": "300"})
    assert result.exit_code == 2
    assert f"Invalid value for --port: {port}: Address already in use" in result.output


@pytest.mark.parametrize(
    "option", [("--replicas", "2"), ("--most-replicas", "3"), ("--vehicles", "9"), ("--address", "auto")]
)
def test_options_of_a_cluster_are_not_passed_over_without_one(option):
    own = typer.Typer()
    own.command()(main)
    result = CliRunner().invoke(own, [*option, "--host", "999.1.1.1"], env={"COLUMNS": "300"})
    assert result.exit_code == 2
    assert f"Invalid value for {option[0]}: only with --cluster" in result.output


@pytest.mark.parametrize(
    ("variable", "value", "complaint"),
    [
        ("ROBOSAC_LATENCY_BUDGET_MS", "soon", "Error: ROBOSAC_LATENCY_BUDGET_MS: Input should be a valid number, "),
        ("ROBOSAC_DATABASE_URL", "sqlite://", "Error: ROBOSAC_DATABASE_URL: replicas need a database that they share"),
    ],
)
def test_a_setting_with_which_no_cluster_serves_is_told_before_one_starts(variable, value, complaint, monkeypatch):
    monkeypatch.setattr("service.cluster.run", None)
    own = typer.Typer()
    own.command()(main)
    result = CliRunner().invoke(own, ["--cluster"], env={variable: value})
    assert result.exit_code == 2
    assert result.output.startswith(complaint)


@pytest.mark.parametrize(
    ("variable", "value", "complaint"),
    [
        ("ROBOSAC_LATENCY_BUDGET_MS", "soon", "Error: ROBOSAC_LATENCY_BUDGET_MS: Input should be a valid number, "),
        ("WEB_CONCURRENCY", "2", "Error: WEB_CONCURRENCY: docs/scaling.md has how several gateways share the work; "),
        ("ROBOSAC_EXTRA_DETECTORS", "nonesuch:build", "ROBOSAC_EXTRA_DETECTORS: nonesuch:build: ModuleNotFoundError"),
    ],
)
def test_a_wrong_setting_ends_it_in_a_line_with_status_2(variable, value, complaint):
    environment = os.environ | {"ROBOSAC_DATABASE_URL": "sqlite://", variable: value}
    command = [sys.executable, "-c", PROGRAM, "--port", "0"]
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60, check=False)
    assert ended.returncode == 2
    assert ended.stderr.count(complaint) == 1
    assert "Traceback" not in ended.stderr
    assert all(line.startswith(("{", "Error: ")) for line in ended.stderr.splitlines())
