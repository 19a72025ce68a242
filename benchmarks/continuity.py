"""Whether sessions go on behind HAProxy, or on Ray Serve, while processes and the database end and come back.

``python benchmarks/continuity.py --engine proxy --database-url URL [--restart-database 'pg_ctl restart ...']``

Vehicles post their own messages, teammates stand by. Phase by phase it is told what share of the frames was tested,
answered from all messages, and in time, the longest time from an answer of a session to its next, and the longest that
a session that asked waited for an answer. At the end every log is checked: what was acknowledged, its chain, and that
one process at a time decided. Exits with 1 if any is wrong.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import AsyncIterator, Awaitable, Callable
from functools import partial
from pathlib import Path

import torch

from clients.client import GatewayClient
from clients.continuity import Traffic, affinity, prepare
from clients.load_test import DEFENSE
from clients.local_gateway import free_port
from clients.proxied import proxied

CONFIG = Path(__file__).parents[1] / "deploy" / "haproxy.cfg"
KEY = "a-key-of-the-benchmark"
SERVE = "import typer; from service.command import main; typer.run(main)"
SETTLE_S = 2.0
Happening = Callable[[], Awaitable[None]]


@contextlib.asynccontextmanager
async def behind_proxy(
    folder: Path, url: str
) -> AsyncIterator[tuple[Callable[[], GatewayClient], dict[str, Happening]]]:
    async with proxied(CONFIG, folder, url, KEY, 2) as gateways:

        async def rolling() -> None:
            for number in range(2):
                await gateways.restart(number, gently=True)
                await asyncio.sleep(SETTLE_S)

        async def kill() -> None:
            await gateways.restart(0, gently=False)

        yield gateways.client, {"one process killed": kill, "rolling restart": rolling}


@contextlib.asynccontextmanager
async def on_ray(folder: Path, url: str) -> AsyncIterator[tuple[Callable[[], GatewayClient], dict[str, Happening]]]:
    port, log = free_port(), folder / "log"

    async def said(text: str) -> None:
        while text not in log.read_text():
            if process.poll() is not None:
                sys.exit(log.read_text())
            await asyncio.sleep(0.2)

    command = [sys.executable, "-c", SERVE, "--cluster", "--replicas", "2", "--port", str(port)]
    environment = os.environ | {"ROBOSAC_DATABASE_URL": url}
    with log.open("wb") as out:
        process = subprocess.Popen(command, env=environment, stdout=out, stderr=out)
    try:
        await said("version 0 at")
        connect = partial(GatewayClient, f"http://127.0.0.1:{port}")
        async with connect() as client:

            async def rolling() -> None:
                process.send_signal(signal.SIGHUP)
                await said("version 1 at")

            async def kill() -> None:
                opened = await client.open_session("a", ["b"])
                ego = client.vehicle(opened.session_id, "b", opened.teammate_tokens["b"])
                async for _, told in ego._events(f"{ego._path}/standby", ego.bearer):
                    os.kill(int(told["gateway"].split("-")[-2]), signal.SIGKILL)
                    break

            yield connect, {"one process killed": kill, "rolling restart": rolling}
    finally:
        process.terminate()
        process.wait(60)


async def main(given: argparse.Namespace) -> list[str]:
    torch.set_num_threads(1)
    engine = behind_proxy if given.engine == "proxy" else on_ray
    with tempfile.TemporaryDirectory(prefix="robosac-") as name:
        url = given.database_url or f"sqlite:///{name}/robosac.db"
        async with engine(Path(name), url) as (connect, happenings):
            traffic = Traffic(connect, prepare(4), given.rate, given.budget_ms)
            await traffic.open(given.sessions, DEFENSE)
            traffic.begin("warming up")
            await asyncio.sleep(given.seconds)
            traffic.begin("nothing")
            await asyncio.sleep(given.seconds)
            for what, happening in happenings.items():
                traffic.begin(what)
                await happening()
                await asyncio.sleep(given.seconds)
            if given.restart_database:
                traffic.begin("database restarted")
                await asyncio.to_thread(subprocess.run, given.restart_database, shell=True, check=True)
                await asyncio.sleep(given.seconds)
            await traffic.stop()
            wrong, writers = await traffic.check()
    print(f"{given.sessions} sessions, one frame of each in {1 / given.rate:g} s")
    for phase in traffic.phases:
        told = phase.as_dict()
        shares = ", ".join(
            f"{each.replace('_', ' ')} {told[f'{each}_share']:.1%}" for each in ("tested", "whole", "in_time")
        )
        rest = {each: told[each] for each in ("asked", "answered", "untold", "sent_again", "refused")}
        times = f"longest gap {phase.longest_gap_s:.1f} s, wait {phase.longest_wait_s:.2f} s"
        print(f"{phase.name}: {shares}, {times}, {rest}")
    print(f"processes that decided, one after another: {[len(names) for names in writers]}")
    moves = 8
    return wrong + affinity(writers, moves)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--engine", choices=["proxy", "ray"], default="proxy")
    parser.add_argument("--database-url")
    parser.add_argument("--restart-database", help="A command.")
    parser.add_argument("--sessions", type=int, default=20)
    parser.add_argument("--rate", type=float, default=1.0)
    parser.add_argument("--budget-ms", type=float, default=2000.0)
    parser.add_argument("--seconds", type=float, default=6.0)
    complaints = asyncio.run(main(parser.parse_args()))
    print("\n".join(complaints) or "nothing acknowledged was lost, every chain holds")
    sys.exit(bool(complaints))
