"""How trials of a gateway begin and end."""

import io
import os
import signal
import subprocess
import sys

import pytest
import typer
from rich.console import Console

from clients import trial
from clients.errors import AccessDenied, GatewayUnreachable


@pytest.mark.parametrize("url", ["http://127.0.0.1:8000", "HTTPS://gateway.example/gw/", "http://[::1]:8000", None])
def test_a_url_is_taken(url):
    assert trial.checked_url(url) == url


@pytest.mark.parametrize(
    ("url", "complaint"),
    [
        ("gateway:8000", "must begin with http"),
        ("http://[::1", "is no URL"),
        ("http://gateway\n", "is no URL"),
        ("http://gateway:99999", "names no port"),
        ("http://", "names no host"),
    ],
)
def test_what_is_no_url_is_refused_before_any_work(url, complaint):
    with pytest.raises(typer.BadParameter, match=complaint):
        trial.checked_url(url)


def test_what_a_gateway_said_is_shown_as_it_is_and_obeyed_by_nobody():
    async def fails():
        raise GatewayUnreachable("[red]a[/red] [/b] \x1b[2J")

    console = Console(file=io.StringIO(), width=100)
    with pytest.raises(SystemExit, match="1"):
        trial.run(fails(), console, "The trial")
    assert console.file.getvalue() == "The trial stopped: [red]a[/red] [/b] \\x1b[2J\n"


def test_a_key_that_is_missing_is_said_to_be_an_option():
    async def refused():
        raise AccessDenied(401, "urn:robosac:problem:unauthenticated", "an API key is needed as a bearer token")

    console = Console(file=io.StringIO(), width=200)
    with pytest.raises(SystemExit):
        trial.run(refused(), console, "The trial")
    assert console.file.getvalue().endswith(
        "an API key is needed as a bearer token (by ROBOSAC_API_KEY or --api-key)\n"
    )


def test_a_report_is_told_of_by_its_name_as_it_is(tmp_path):
    console = Console(file=io.StringIO(), width=20)
    folder = tmp_path / "[bold]run[1]"
    folder.mkdir()
    trial.write({}, folder, "[a].json", console)
    assert console.file.getvalue() == f"Written: {folder / '[a].json'}\n"
    assert (folder / "[a].json").exists()


PROGRAM = """
import asyncio
from rich.console import Console
from clients import trial

async def lasts():
    print("it runs \N{HORIZONTAL ELLIPSIS}", flush=True)
    try:
        await asyncio.sleep(60)
    finally:
        print("it is tidied up", flush=True)

trial.run(lasts(), Console(), "The trial")
"""


@pytest.mark.skipif(sys.platform == "win32", reason="no such signal")
def test_a_trial_that_is_terminated_tidies_up_whatever_the_terminal_can_spell():
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    with subprocess.Popen(
        [sys.executable, "-c", PROGRAM], stdout=subprocess.PIPE, text=True, env=environment
    ) as process:
        assert process.stdout.readline() == "it runs ?\n"
        process.send_signal(signal.SIGTERM)
        told = process.stdout.read()
        assert process.wait(20) == 143
    assert told.splitlines() == ["it is tidied up", "The trial was ended."]
