"""A log that nobody reads."""

import fcntl
import json
import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import closing

import httpx
import pytest

from service.watching import lines
from service.watching.lines import Lines
from tests.service.test_command import PROGRAM

PIPE_BYTES = 4096
HEARS_SIGHUP = "import signal; signal.signal(signal.SIGHUP, signal.SIG_DFL); "
"""Also where the tests run under nohup."""


@pytest.fixture
def pipe():
    """The end that is read, which does not wait, and the one that is written, of a pipe that holds little."""
    read, write = os.pipe()
    fcntl.fcntl(write, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
    os.set_blocking(read, False)
    with os.fdopen(read, "rb", buffering=0) as reader, os.fdopen(write, "w") as writer:
        yield reader, writer


def read_all(reader, until):
    """What comes, up to a line that ends so."""
    text, end = b"", time.monotonic() + 30
    while not text.endswith(until):
        assert time.monotonic() < end, text
        text += reader.read() or b""
    return text.decode().splitlines()


def test_nobody_waits_for_a_reader_and_what_is_lost_is_told(pipe, monkeypatch):
    monkeypatch.setattr(lines, "MOST", 50)
    (reader, writer), written = pipe, Lines()

    def put(text):
        written.put(writer, f"{text}\n", lambda number: f"{number} lost\n")

    put("x" * PIPE_BYTES)
    written.flush(0.05)  # it is being written now, and stands
    began = time.monotonic()
    for number in range(80):
        put(number)
    written.flush(60)
    assert time.monotonic() - began < 30
    assert read_all(reader, b"49\n") == ["x" * PIPE_BYTES, *map(str, range(50))]
    written.flush(30)
    put("there again")
    assert read_all(reader, b"again\n") == ["30 lost", "there again"]


def test_a_stream_that_does_not_wait_is_waited_for(pipe):
    (reader, writer), written = pipe, Lines()
    os.set_blocking(writer.fileno(), False)
    many = [f"{number:0100}" for number in range(200)]
    for text in many:
        written.put(writer, f"{text}\n", str)
    assert read_all(reader, f"{many[-1]}\n".encode()) == many


def test_a_stream_that_takes_nothing_keeps_no_other_from_it(capsys, tmp_path):
    written, closed = Lines(), (tmp_path / "log").open("w")
    closed.close()
    for stream in (closed, object(), sys.stderr):
        written.put(stream, "a line\n", str)
    written.flush(30)
    assert capsys.readouterr().err == "a line\n"


def test_a_gateway_whose_log_is_not_read_serves_and_ends(pipe, tmp_path):
    reader, writer = pipe
    with closing(socket.create_server(("127.0.0.1", 0))) as server:
        port = server.getsockname()[1]
    environment = os.environ | {"ROBOSAC_DATABASE_URL": f"sqlite:///{tmp_path}/robosac.db"}
    command = [sys.executable, "-c", HEARS_SIGHUP + PROGRAM, "--port", str(port)]
    process = subprocess.Popen(command, env=environment, stderr=writer)
    with httpx.Client(base_url=f"http://127.0.0.1:{port}", trust_env=False) as http:
        try:
            end = time.monotonic() + 60
            while True:
                assert process.poll() is None
                assert time.monotonic() < end
                try:
                    http.get("/healthz")
                    break
                except httpx.ConnectError:
                    time.sleep(0.1)
            for _ in range(200):  # each of which has its line
                assert http.get("/nonesuch").status_code == 404
        finally:
            process.send_signal(signal.SIGHUP)
            ended = process.wait(30)
    assert ended in (0, -signal.SIGTERM)
    first, *_ = (reader.read() or b"").splitlines()
    assert json.loads(first)["event"].startswith("Started server process")
