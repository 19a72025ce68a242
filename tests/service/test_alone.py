"""Several processes on one listening socket are no gateway: each would have a part of the messages."""

import os
import re
import signal
import socket
import subprocess
import sys
import time
from contextlib import contextmanager

import httpx
import pytest

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells whose a listening socket is")
UVICORN = [sys.executable, "-m", "uvicorn", "service.app:app"]
CHECKS = """
import sys
from service.alone import SharedSocket, check_alone
try:
    check_alone()
except SharedSocket as shared:
    sys.exit(f"refused: {shared}")
print("alone", flush=True)
sys.stdin.read()
"""


@contextmanager
def running(command, tmp_path, *sockets, **environment):
    environment = os.environ | {"ROBOSAC_DATABASE_URL": f"sqlite:///{tmp_path}/robosac.db", **environment}
    log = tmp_path / "log"
    with log.open("ab") as out:
        process = subprocess.Popen(
            command, env=environment, stdout=out, stderr=out, pass_fds=[s.fileno() for s in sockets],
            stdin=subprocess.PIPE, start_new_session=True,
        )  # fmt: skip
    try:
        yield process, log
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGTERM)
        process.communicate(timeout=60)


def wait_for(pattern, log, process):
    end = time.monotonic() + 120
    while not (found := re.search(pattern, log.read_text())):
        assert process.poll() is None, log.read_text()
        assert time.monotonic() < end, log.read_text()
        time.sleep(0.05)
    return found


@pytest.fixture(params=["bound", "listening"])
def listening(request):
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        if request.param == "listening":
            listening.listen()
        yield listening


def check(tmp_path, *sockets):
    """Another process of the group: what it says of the sockets that it is given."""
    done = subprocess.run(
        [sys.executable, "-c", CHECKS], check=False, capture_output=True, text=True, input="",
        pass_fds=[s.fileno() for s in sockets],
    )  # fmt: skip
    return done.returncode, done.stdout + done.stderr


def test_two_workers_of_a_server_are_refused_with_a_word_on_what_to_do(tmp_path):
    with running([*UVICORN, "--port", "0"], tmp_path, WEB_CONCURRENCY="2") as (process, log):
        process.wait(120)
        said = log.read_text()
        assert "Another worker serves 127.0.0.1:" in said
        assert "start one worker (no --workers, no WEB_CONCURRENCY)" in said
        assert "stopping the parent process" in said


def test_one_worker_of_a_server_that_reloads_is_none_too_many(tmp_path):
    (tmp_path / "watched").mkdir()
    reload = ["--port", "0", "--reload", "--reload-dir", str(tmp_path / "watched")]
    with running([*UVICORN, *reload], tmp_path, WEB_CONCURRENCY="2") as (process, log):
        url = wait_for(r"http://127\.0\.0\.1:\d+", log, process)[0]
        wait_for("Application startup complete", log, process)
        assert httpx.get(f"{url}/healthz", trust_env=False).status_code == 200


def test_a_socket_is_free_again_when_its_worker_has_gone(tmp_path, listening):
    with running([sys.executable, "-c", CHECKS], tmp_path, listening) as (process, log):
        wait_for("alone", log, process)
        for _ in range(2):  # to be refused does not free it
            code, said = check(tmp_path, listening)
            assert code == 1
            assert f"127.0.0.1:{listening.getsockname()[1]}" in said
    assert check(tmp_path, listening) == (0, "alone\n")


def test_a_unix_socket_is_shared_no_more_than_another(tmp_path):
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(tmp_path / "socket"))
        listening.listen()
        with running([sys.executable, "-c", CHECKS], tmp_path, listening) as (process, log):
            wait_for("alone", log, process)
            code, said = check(tmp_path, listening)
            assert (code, str(tmp_path / "socket") in said) == (1, True)


def test_gateways_on_sockets_of_their_own_are_in_nobodys_way(tmp_path, listening):
    """Whatever else they were given together."""
    one, other = socket.socketpair()
    with (
        one,
        other,
        socket.socket() as unbound,
        socket.create_server(("127.0.0.1", 0)) as second,
        socket.create_connection(second.getsockname()) as connected,
        running([sys.executable, "-c", CHECKS], tmp_path, listening, one, unbound, connected) as (process, log),
    ):
        wait_for("alone", log, process)
        assert check(tmp_path, second, one, unbound, connected) == (0, "alone\n")
