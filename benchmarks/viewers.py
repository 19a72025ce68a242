"""What those who watch cost a fleet: frames per second and the gateway's own processor time per frame, without viewers,
with viewers who read, and with viewers who have stopped to read. The three take turns within one run.

    python benchmarks/viewers.py --viewers 50 --seconds 5 --rounds 4
"""

from __future__ import annotations

import asyncio
import socket
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from statistics import median
from typing import Annotated

import typer
from rich.console import Console

from clients import trial
from clients.client import GatewayClient
from clients.local_gateway import GatewayProcess
from clients.trial import percentiles, shown
from robosac import IntersectionScene, load_detector

ARMS = ("nobody", "reading", "stopped")
READY = "all watch"


async def watch(host: str, port: int, session: str, viewers: int, mode: str) -> None:
    """Be so many viewers, until the process is ended."""
    request = f"GET /v1/live/{session} HTTP/1.1\r\nHost: {host}:{port}\r\n\r\n".encode()
    pairs = []
    for _ in range(viewers):
        plug = socket.socket()
        if mode == "stopped":
            plug.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)  # else it takes a minute until nothing fits in
        plug.connect((host, port))
        reader, writer = await asyncio.open_connection(sock=plug, limit=2**12)
        pairs.append((reader, writer))
        writer.write(request)
        assert b"200" in await reader.readline()
    print(READY, flush=True)
    if mode == "stopped":
        await asyncio.sleep(3600)
    await asyncio.gather(*(discard(reader) for reader, _ in pairs))


async def discard(reader: asyncio.StreamReader) -> None:
    while await reader.read(2**18):
        pass


async def measure(
    viewers: int, seconds: float, rounds: int, pause_s: float
) -> dict[str, list[tuple[float, float, float]]]:
    """Frames a second, milliseconds of processor time a frame, and the 99th percentile of latency, by arm and round."""
    detector, frame = load_detector(), IntersectionScene(seed=8).frame(0)
    messages = {name: detector.encode(view.points, view.pose) for name, view in frame.views.items()}
    own = messages.pop("car-1")
    measured = defaultdict(list)
    with tempfile.TemporaryDirectory() as folder:
        process = GatewayProcess(
            Path(folder) / "log", f"sqlite:///{folder}/db", settings={"ROBOSAC_MAX_VIEWERS": str(viewers)}
        )
        try:
            await process.ready()
            async with GatewayClient(process.url) as gateway:
                session = await gateway.open_session("car-1", list(messages), latency_budget_ms=20_000, gather_ms=0)
                ego = gateway.vehicle(session.session_id, "car-1", session.ego_token)
                number = 0

                async def drive(for_s: float) -> tuple[float, float, float]:
                    nonlocal number
                    began, cpu_s, latencies = time.perf_counter(), process.cpu_s(), []
                    while time.perf_counter() - began < for_s:
                        asked = time.perf_counter()
                        await ego.post_frame(number, own, messages)
                        number += 1
                        latencies.append((time.perf_counter() - asked) * 1e3)
                        if pause_s:
                            await asyncio.sleep(max(0.0, asked + pause_s - time.perf_counter()))
                    took, frames = time.perf_counter() - began, len(latencies)
                    return frames / took, (process.cpu_s() - cpu_s) * 1e3 / frames, percentiles(latencies)["p99"] or 0.0

                await drive(2.0)
                for turn in range(rounds):
                    for arm in ARMS if turn % 2 else ARMS[::-1]:
                        others = (
                            None if arm == "nobody" else start_viewers(process.port, session.session_id, viewers, arm)
                        )
                        await drive(4.0 if arm == "stopped" else 0.5)  # until their sockets are full
                        measured[arm].append(await drive(seconds))
                        if others is not None:
                            others.kill()
                            others.wait()
                        await drive(0.3)
        finally:
            await process.stop()
    return measured


def start_viewers(port: int, session: str, viewers: int, mode: str) -> subprocess.Popen[str]:
    command = [sys.executable, __file__, "--be", f"{port} {session} {viewers} {mode}"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    while READY not in process.stdout.readline():
        if process.poll() is not None:
            sys.exit("the viewers ended")
    return process


def main(
    viewers: Annotated[int, typer.Option(min=1)] = 50,
    seconds: Annotated[float, typer.Option(help="Of each turn.")] = 5.0,
    rounds: Annotated[int, typer.Option(min=1)] = 4,
    rate: Annotated[
        float, typer.Option(help="Frames a second that are asked for; 0: as fast as they are answered.")
    ] = 0,
    be: Annotated[str, typer.Option(hidden=True)] = "",
) -> None:
    if be:
        port, session, count, mode = be.split()
        asyncio.run(watch("127.0.0.1", int(port), session, int(count), mode))
        return
    measured = asyncio.run(measure(viewers, seconds, rounds, 1 / rate if rate else 0.0))
    table = trial.a_table(
        f"{viewers} viewers, {rounds} rounds", ("viewers", "FPS", "CPU ms a frame", "p99 ms", "FPS ratio", "CPU ratio")
    )
    for arm in ARMS:
        values = [median(column) for column in zip(*measured[arm], strict=True)]
        ratios = [median(a[i] / b[i] for a, b in zip(measured[arm], measured["nobody"], strict=True)) for i in range(2)]
        table.add_row(arm, *(shown(value, 2) for value in values), *(shown(ratio, 3) for ratio in ratios))
    Console().print(table)


if __name__ == "__main__":
    typer.run(main)
