"""What strangers can do to honest egos: ``robosac flood``.

Honest egos post frames at a fixed rate. Meanwhile strangers, without a credential or with a wrong one, send requests to
every call that takes a body, each as large as the gateway reads at all: once the headers alone, once the whole body.
Every stranger has to be refused, and the honest frames have to stay in their budget as they do without strangers.
"""

from __future__ import annotations

import asyncio
import multiprocessing
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from functools import partial
from itertools import cycle
from secrets import token_urlsafe
from typing import Annotated

import torch
import typer
from rich.console import Console
from rich.progress import track

from clients import trial
from clients.client import MSGPACK, GatewayClient
from clients.load_test import Bodies, prepare, run_load
from clients.measured import Figures, Load
from clients.raw_http import connected, post_head, read_response

REPORT = "flood.json"
BUDGET_MS = 200.0
HONEST_HZ = 5.0
BODY_BYTES = 32 * 2**20
"""The largest body that a gateway reads by default."""
PATIENCE_S = 15.0
"""How long a stranger goes on with one request."""
CHUNK = 2**18
REFUSALS = (401, 503)
"""Who asks for a frame while the gateway is at its limit is not even asked for a credential."""


@dataclass(frozen=True)
class Plan:
    """How many honest egos there are, and how many requests strangers send a second, for how long."""

    egos: int
    rate_hz: float
    seconds: float


class Strangers(StrEnum):
    """What strangers send."""

    NONE = "none"
    HEADERS = "headers only"
    BODIES = "whole bodies"


@dataclass
class Refusals:
    """What strangers were answered."""

    sent: int = 0
    """Requests."""
    taken_bytes: int = 0
    """Bytes of bodies that the gateway's side took."""
    refused_ms: list[float] = field(default_factory=list)
    """From a connection's beginning to its 401, or 503 where the gateway is busy."""
    hung_up: int = 0
    """Requests whose connection was closed while their bodies were on the way, before the answer was read."""
    others: dict[str, int] = field(default_factory=dict)
    """What came instead: a status, or what went wrong."""

    def answered(self, status: int, milliseconds: float) -> None:
        """Count an answer."""
        if status in REFUSALS:
            self.refused_ms.append(milliseconds)
        else:
            self.failed(str(status))

    def failed(self, what: str) -> None:
        """Count what was no refusal."""
        self.others[what] = self.others.get(what, 0) + 1


Results = dict[Strangers, tuple[Figures, Refusals]]


def requests_of(url: str, session_id: str, credential: str) -> list[bytes]:
    """Heads of requests with a large body to every call that takes one, without a credential and with a wrong one."""
    path, json = f"/v1/sessions/{session_id}", "application/json"
    calls = {
        "/v1/sessions": json,
        f"{path}/teammates": json,
        f"{path}/messages": MSGPACK,
        f"{path}/frames": MSGPACK,
        f"{path}/token": json,
    }
    return [
        post_head(url, path, BODY_BYTES, wrong, media_type)
        for path, media_type in calls.items()
        for wrong in (None, credential)
    ]


def send_all(url: str, heads: Sequence[bytes], plan: Plan, with_bodies: bool) -> Refusals:
    """Send the strangers' requests, each on a connection of its own; for a process of its own."""
    return asyncio.run(_send_all(url, heads, plan, with_bodies))


async def _send_all(url: str, heads: Sequence[bytes], plan: Plan, with_bodies: bool) -> Refusals:
    refusals, posts, started = Refusals(), [], time.perf_counter()
    for k, head in zip(range(max(1, int(plan.rate_hz * plan.seconds))), cycle(heads), strict=False):
        await asyncio.sleep(max(0.0, started + k / plan.rate_hz - time.perf_counter()))
        posts.append(asyncio.create_task(_send(url, head, with_bodies, refusals)))
    await asyncio.gather(*posts)
    return refusals


async def _send(url: str, head: bytes, with_body: bool, refusals: Refusals) -> None:
    """Send one request, whatever is answered meanwhile."""
    started = time.perf_counter()
    refusals.sent += 1
    try:
        async with asyncio.timeout(PATIENCE_S), connected(url) as (reader, writer):
            writer.write(head)
            sending = asyncio.create_task(_send_body(writer, refusals)) if with_body else None
            status, _ = await read_response(reader)
            refusals.answered(status, (time.perf_counter() - started) * 1e3)
            if sending is not None:
                await sending
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


async def run_flood(url: str | None, api_key: str | None, plan: Plan, bodies: Bodies, console: Console) -> Results:
    """Honest egos with each kind of strangers beside them."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        async with trial.gateway_to_try(url, api_key, token_urlsafe(32)) as (at, gateway):
            await asyncio.get_running_loop().run_in_executor(pool, time.time)  # it takes seconds to start
            parts = track(Strangers, "parts", console=console, transient=True)
            return {strangers: await _run_part(at, gateway, plan, strangers, bodies, pool) for strangers in parts}


async def _run_part(
    url: str, gateway: GatewayClient, plan: Plan, strangers: Strangers, bodies: Bodies, pool: ProcessPoolExecutor
) -> tuple[Figures, Refusals]:
    target = await gateway.open_session("target", ["teammate"])
    heads = requests_of(url, target.session_id, token_urlsafe(32))
    work = Load("open", plan.egos, True, HONEST_HZ)
    load = asyncio.create_task(run_load(gateway, work, bodies, plan.seconds, BUDGET_MS))
    refusals = Refusals()
    if strangers is not Strangers.NONE:
        send = partial(send_all, url, heads, plan, strangers is Strangers.BODIES)
        refusals = await asyncio.get_running_loop().run_in_executor(pool, send)
    figures = await load
    await gateway.vehicle(target.session_id, "target", target.ego_token).close()
    return figures, refusals


def show(console: Console, results: Results) -> None:
    """Print what came of it."""
    columns = []
    for figures, refusals in results.values():
        values, refused_ms = figures.as_dict(), trial.percentiles(refusals.refused_ms)
        latency = values["latency_ms"]
        columns.append(
            {
                "honest frames": str(values["frames"]),
                "of them in time": f"{values['within_budget_share']:.1%}",
                "of them cut short": str(values["degraded"]),
                "latency, ms: p50, p99": f"{trial.shown(latency['p50'], 0)}, {trial.shown(latency['p99'], 0)}",
                "strangers' requests": str(refusals.sent),
                "refused": str(len(refusals.refused_ms)),
                "refusal, ms: p50, p99": f"{trial.shown(refused_ms['p50'], 1)}, {trial.shown(refused_ms['p99'], 1)}",
                "hung up on": str(refusals.hung_up),
                "anything else": ", ".join(f"{name}: {n}" for name, n in refusals.others.items()) or "-",
            }
        )
    table = trial.a_table(f"Budget {BUDGET_MS:g} ms", ["strangers", *(strangers.value for strangers in results)])
    for name in columns[0]:
        table.add_row(name, *(column[name] for column in columns))
    trial.print_whole(console, table)


def main(
    out: trial.Out = None,
    force: trial.Force = False,
    url: trial.Url = None,
    egos: Annotated[int, typer.Option(min=1, help="Honest egos, each at five frames a second.")] = 2,
    rate: Annotated[float, typer.Option(min=0.1, max=10_000, help="Requests of strangers a second.")] = 20.0,
    seconds: trial.Seconds = 10.0,
    api_key: trial.ApiKey = None,
) -> None:
    """Flood a gateway with large requests that have no right to anything, and measure what honest egos notice.

    Exits with 1 if a stranger got anything but a refusal.
    """
    torch.set_num_threads(1)
    console = Console()
    trial.make_folder(out, "--out", REPORT, force)
    bodies, plan = prepare(True, 3, console), Plan(egos, rate, seconds)
    results = trial.run(run_flood(url, api_key, plan, bodies, console), console, "The flood test")
    show(console, results)
    report = {
        strangers.value: {"honest": figures.as_dict(), "strangers": asdict(refusals)}
        for strangers, (figures, refusals) in results.items()
    }
    trial.write(report, out, REPORT, console)
    if any(refusals.others for _, refusals in results.values()):
        sys.exit(1)


if __name__ == "__main__":
    typer.run(main)
