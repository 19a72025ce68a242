"""What strangers can do to honest egos: ``robosac flood``.

Honest egos post frames at a fixed rate. Meanwhile strangers, without a credential or with a wrong one, send requests to
every call that takes a body, each as large as the gateway reads at all: once the headers alone, once the whole body.
Every stranger has to be refused, and the honest frames have to stay in their budget as they do without strangers.
"""

from __future__ import annotations

import asyncio
import json
import math
import multiprocessing
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import AsyncExitStack
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from functools import partial
from itertools import cycle
from pathlib import Path
from secrets import token_urlsafe
from typing import Annotated
from urllib.parse import urlsplit

import numpy as np
import torch
import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import track
from rich.table import Table

from clients.client import API_KEY_VARIABLE, MSGPACK, GatewayClient
from clients.errors import GatewayError
from clients.load_test import Bodies, Figures, Load, prepare, run_load
from clients.local_gateway import local_gateway
from clients.raw_http import read_response
from clients.simulation import make_folder

BUDGET_MS = 200.0
HONEST_HZ = 5.0
BODY_BYTES = 32 * 2**20
"""The largest body that a gateway reads by default."""
PATIENCE_S = 15.0
"""How long a stranger goes on with one request."""
CHUNK = 2**18
REFUSALS = (401, 503)
"""Who asks for a frame while the gateway is at its limit is not even asked for a credential."""


class Strangers(StrEnum):
    """What strangers send."""

    NONE = "none"
    HEADERS = "headers only"
    BODIES = "whole bodies"


@dataclass
class Refusals:
    """What strangers were answered.

    Attributes
    ----------
    sent : int
        Requests.
    taken_bytes : int
        Of bodies, that the gateway's side took off the strangers' hands.
    refused_ms : list of float
        From a connection's beginning to its 401, or 503 where the gateway is busy.
    hung_up : int
        Requests whose connection was closed while their bodies were on the way, before the answer was read.
    others : mapping of str to int
        What came instead: a status, or what went wrong.
    """

    sent: int = 0
    taken_bytes: int = 0
    refused_ms: list[float] = field(default_factory=list)
    hung_up: int = 0
    others: dict[str, int] = field(default_factory=dict)

    def answered(self, status: int, milliseconds: float) -> None:
        """Count an answer."""
        if status in REFUSALS:
            self.refused_ms.append(milliseconds)
        else:
            self.failed(str(status))

    def failed(self, what: str) -> None:
        """Count what was no refusal."""
        self.others[what] = self.others.get(what, 0) + 1


def requests_of(host: str, session_id: str, credential: str) -> list[bytes]:
    """Heads of requests with a large body to every call that takes one, without a credential and with a wrong one."""
    path = f"/v1/sessions/{session_id}"
    calls = {
        "/v1/sessions": "application/json",
        f"{path}/teammates": "application/json",
        f"{path}/messages": MSGPACK,
        f"{path}/frames": MSGPACK,
        f"{path}/token": "application/json",
    }
    return [
        f"POST {path} HTTP/1.1\r\nHost: {host}\r\nContent-Type: {media_type}\r\nContent-Length: {BODY_BYTES}\r\n"
        f"{authorization}\r\n".encode()
        for path, media_type in calls.items()
        for authorization in ("", f"Authorization: Bearer {credential}\r\n")
    ]


def send_all(url: str, heads: Sequence[bytes], rate_hz: float, seconds: float, with_bodies: bool) -> Refusals:
    """Send requests at a rate for a time, each on a connection of its own; for a process of its own."""
    return asyncio.run(_send_all(url, heads, rate_hz, seconds, with_bodies))


async def _send_all(url: str, heads: Sequence[bytes], rate_hz: float, seconds: float, with_bodies: bool) -> Refusals:
    refusals, posts, started = Refusals(), [], time.perf_counter()
    for k, head in zip(range(max(1, int(rate_hz * seconds))), cycle(heads), strict=False):
        await asyncio.sleep(max(0.0, started + k / rate_hz - time.perf_counter()))
        posts.append(asyncio.create_task(_send(url, head, with_bodies, refusals)))
    await asyncio.gather(*posts)
    return refusals


async def _send(url: str, head: bytes, with_body: bool, refusals: Refusals) -> None:
    """Send one request, whatever is answered meanwhile."""
    parts, started = urlsplit(url), time.perf_counter()
    refusals.sent += 1
    try:
        async with asyncio.timeout(PATIENCE_S):
            reader, writer = await asyncio.open_connection(parts.hostname, parts.port or 80)
            try:
                writer.write(head)
                sending = asyncio.create_task(_send_body(writer, refusals)) if with_body else None
                status, _ = await read_response(reader)
                refusals.answered(status, (time.perf_counter() - started) * 1e3)
                if sending is not None:
                    await sending
            finally:
                writer.close()
    except (BrokenPipeError, ConnectionResetError) as error:
        if with_body:
            refusals.hung_up += 1
        else:
            refusals.failed(type(error).__name__)
    except (OSError, TimeoutError, asyncio.IncompleteReadError, ValueError) as error:
        refusals.failed(type(error).__name__)


async def _send_body(writer: asyncio.StreamWriter, refusals: Refusals) -> None:
    chunk = b"[],[]," * (CHUNK // 6)
    left = BODY_BYTES
    try:
        while left > 0:
            writer.write(chunk[:left])
            await writer.drain()
            refusals.taken_bytes += len(chunk[:left])
            left -= len(chunk)
    except OSError:  # the gateway has hung up
        return


async def run_flood(
    gateway: GatewayClient,
    url: str,
    egos: int,
    strangers: Strangers,
    bodies: Bodies,
    seconds: float,
    rate_hz: float,
    pool: ProcessPoolExecutor,
) -> tuple[Figures, Refusals]:
    """Honest egos at five frames a second, with strangers beside them."""
    target = await gateway.open_session("target", ["teammate"])
    heads = requests_of(urlsplit(url).netloc, target.session_id, token_urlsafe(32))
    load = asyncio.create_task(run_load(gateway, Load("open", egos, True, HONEST_HZ), bodies, seconds, BUDGET_MS))
    refusals = Refusals()
    if strangers is not Strangers.NONE:
        send = partial(send_all, url, heads, rate_hz, seconds, strangers is Strangers.BODIES)
        refusals = await asyncio.get_running_loop().run_in_executor(pool, send)
    figures = await load
    await gateway.vehicle(target.session_id, "target", target.ego_token).close()
    return figures, refusals


def show(console: Console, results: dict[Strangers, tuple[Figures, Refusals]]) -> None:
    """Print what came of it."""
    table = Table(title=f"Budget {BUDGET_MS:g} ms", title_justify="left", box=SIMPLE_HEAD)
    table.add_column("strangers")
    columns = []
    for strangers, (figures, refusals) in results.items():
        table.add_column(strangers.value, justify="right")
        values = figures.as_dict()
        latency = values["latency_ms"] if values["frames"] else {"p50": math.nan, "p99": math.nan}
        p50, p99 = np.percentile(refusals.refused_ms or [math.nan], [50, 99])
        columns.append(
            {
                "honest frames": str(values["frames"]),
                "of them in time": f"{values['within_budget_share']:.1%}",
                "of them cut short": str(values["degraded"]),
                "latency, ms: p50, p99": f"{latency['p50']:.0f}, {latency['p99']:.0f}",
                "strangers' requests": str(refusals.sent),
                "refused": str(len(refusals.refused_ms)),
                "refusal, ms: p50, p99": f"{p50:.1f}, {p99:.1f}" if refusals.refused_ms else "-",
                "hung up on": str(refusals.hung_up),
                "anything else": ", ".join(f"{name}: {n}" for name, n in refusals.others.items()) or "-",
            }
        )
    for name in columns[0]:
        table.add_row(name, *(column[name] for column in columns))
    console.print(table)


def main(
    out: Annotated[Path | None, typer.Option(help="Folder for flood.json.")] = None,
    url: Annotated[str | None, typer.Option(help="The gateway; by default one is started for the test.")] = None,
    egos: Annotated[int, typer.Option(min=1, help="Honest egos, each at five frames a second.")] = 2,
    rate: Annotated[float, typer.Option(min=0.1, help="Requests of strangers a second.")] = 20.0,
    seconds: Annotated[float, typer.Option(min=0.5, help="Length of each part.")] = 10.0,
    api_key: Annotated[
        str | None, typer.Option(envvar=API_KEY_VARIABLE, help="Opens the honest sessions, with --url.")
    ] = None,
) -> None:
    """Flood a gateway with large requests that have no right to anything, and measure what honest egos notice.

    Exits with 1 if a stranger got anything but a refusal.
    """
    torch.set_num_threads(1)
    console = Console()
    if out is not None:
        make_folder(out, "--out")
    bodies = prepare(True, 3, console)
    try:
        results = asyncio.run(_run(url, api_key, egos, bodies, seconds, rate, console))
    except (GatewayError, OSError) as error:
        console.print(f"[red]The test stopped:[/red] {error}")
        sys.exit(1)
    show(console, results)
    if out is not None:
        report = {
            strangers.value: {"honest": figures.as_dict(), "strangers": asdict(refusals)}
            for strangers, (figures, refusals) in results.items()
        }
        (out / "flood.json").write_text(json.dumps(report, indent=2) + "\n")
        console.print(f"Written: {out / 'flood.json'}")
    if any(refusals.others for _, refusals in results.values()):
        sys.exit(1)


async def _run(
    url: str | None, api_key: str | None, egos: int, bodies: Bodies, seconds: float, rate: float, console: Console
) -> dict[Strangers, tuple[Figures, Refusals]]:
    async with AsyncExitStack() as stack:
        if url is None:
            folder, api_key = Path(stack.enter_context(tempfile.TemporaryDirectory())), token_urlsafe(32)
            url = await stack.enter_async_context(local_gateway(folder / "gateway.log", api_key))
        gateway = await stack.enter_async_context(GatewayClient(url, api_key))
        pool = stack.enter_context(ProcessPoolExecutor(1, multiprocessing.get_context("spawn")))
        await asyncio.get_running_loop().run_in_executor(pool, time.time)  # it takes seconds to start
        return {
            strangers: await run_flood(gateway, url, egos, strangers, bodies, seconds, rate, pool)
            for strangers in track(Strangers, "parts", console=console, transient=True)
        }


if __name__ == "__main__":
    typer.run(main)
