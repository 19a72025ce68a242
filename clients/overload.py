"""What a gateway does with more frames than it can answer: ``robosac overload``.

First the capacity is found with egos that post one frame after the other. Then frames are due at a multiple of it,
whatever the gateway does. Each request asks with ``Expect: 100-continue`` whether its body is wanted, as a vehicle with
little bandwidth would, so that a refused frame costs neither side its bytes.
"""

from __future__ import annotations

import asyncio
import json
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import AsyncExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import urlsplit

import numpy as np
import torch
import typer
from rich.console import Console
from rich.progress import Progress

from clients.client import MSGPACK, GatewayClient, VehicleClient
from clients.errors import GatewayError
from clients.load_test import DEFENSE, Bodies, Load, prepare, run_load
from clients.local_gateway import local_gateway
from clients.raw_http import read_response
from clients.simulation import make_folder
from robosac import wire
from robosac.scenes import IntersectionScene

CAPACITY_EGOS = 8


@dataclass
class OverloadFigures:
    """What came of the frames that were due.

    Attributes
    ----------
    budget_ms : float
    capacity_fps : float
        Measured before, one frame after the other.
    offered, seconds : int, float
    answered_ms : list of float
        From the request's last byte, where the budget begins, to the answer's.
    refused_ms : list of float
        From the connection's beginning to the refusal.
    deadline_met : int
        Of the answered, by the gateway's own clock.
    others : Counter
        What was neither answered nor refused with 503.
    """

    budget_ms: float
    capacity_fps: float
    offered: int = 0
    seconds: float = 0.0
    answered_ms: list[float] = field(default_factory=list)
    refused_ms: list[float] = field(default_factory=list)
    deadline_met: int = 0
    others: Counter[str] = field(default_factory=Counter)

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        answered = len(self.answered_ms)
        return {
            "capacity_fps": self.capacity_fps,
            "offered_fps": self.offered / self.seconds,
            "answered_fps": answered / self.seconds,
            "answered": answered,
            "within_budget_share": float(np.mean(np.array(self.answered_ms) <= self.budget_ms)) if answered else None,
            "deadline_met_share": self.deadline_met / answered if answered else None,
            "answered_ms": _percentiles(self.answered_ms),
            "refused": len(self.refused_ms),
            "refused_ms": _percentiles(self.refused_ms),
            "others": dict(self.others),
        }


def _percentiles(values: Sequence[float]) -> dict[str, float | None]:
    found = np.percentile(values, [50, 95, 99]).tolist() if values else [None] * 3
    return dict(zip(("p50", "p95", "p99"), found, strict=True))


async def _ask(url: str, ego: VehicleClient, body: bytes, figures: OverloadFigures) -> None:
    """Post one whole frame on a connection of its own; the body goes out only if it is wanted."""
    parts = urlsplit(url)
    started = time.perf_counter()
    try:
        reader, writer = await asyncio.open_connection(parts.hostname, parts.port or 80)
    except OSError as error:
        figures.others[type(error).__name__] += 1
        return
    try:
        head = {
            "Host": parts.netloc,
            "Authorization": ego.bearer["Authorization"],
            "Content-Type": MSGPACK,
            "Accept": MSGPACK,
            "Content-Length": str(len(body)),
            "Expect": "100-continue",
            "Connection": "close",
        }
        lines = "".join(f"{name}: {value}\r\n" for name, value in head.items())
        writer.write(f"POST /v1/sessions/{ego.session_id}/frames HTTP/1.1\r\n{lines}\r\n".encode())
        status, answer = await read_response(reader)
        if status == 100:
            writer.write(body)
            await writer.drain()
            started = time.perf_counter()
            status, answer = await read_response(reader)
    except (OSError, asyncio.IncompleteReadError, ValueError) as error:
        figures.others[type(error).__name__] += 1
        return
    finally:
        writer.close()
    elapsed_ms = (time.perf_counter() - started) * 1e3
    if status == 200:
        figures.answered_ms.append(elapsed_ms)
        figures.deadline_met += bool(wire.unpack(answer, trusted=True)["deadline_met"])
    elif status == 503:
        figures.refused_ms.append(elapsed_ms)
    else:
        figures.others[str(status)] += 1


async def run_overload(
    url: str, bodies: Bodies, egos: int, factor: float, seconds: float, budget_ms: float, progress: Progress
) -> OverloadFigures:
    """Find the capacity, then offer a multiple of it."""
    agents = IntersectionScene(0).agents
    async with AsyncExitStack() as stack:
        gateway = await stack.enter_async_context(GatewayClient(url))
        task = progress.add_task("capacity", total=None)
        capacity = await run_load(gateway, Load("closed", CAPACITY_EGOS, True), bodies, seconds, budget_ms)
        fps = len(capacity.latencies_ms) / capacity.seconds
        figures = OverloadFigures(budget_ms, fps)
        vehicles = []
        for _ in range(egos):
            session = await gateway.open_session(agents[0], agents[1:], defense=DEFENSE, latency_budget_ms=budget_ms)
            vehicles.append(gateway.vehicle(session.session_id, agents[0], session.ego_token))
        total = int(factor * fps * seconds)
        progress.update(task, description=f"{factor:g} times {fps:.0f} frames a second", total=total)
        started = time.perf_counter()
        posts = []
        for k in range(total):
            await asyncio.sleep(max(0.0, started + k / (factor * fps) - time.perf_counter()))
            ego = vehicles[k % egos]
            posts.append(asyncio.create_task(_ask(url, ego, bodies.numbered(k // egos), figures)))
            progress.advance(task)
        figures.offered, figures.seconds = total, time.perf_counter() - started
        await asyncio.gather(*posts)
        for ego in vehicles:
            await ego.close()
    return figures


def main(
    out: Annotated[Path | None, typer.Option(help="Folder for overload.json.")] = None,
    url: Annotated[str | None, typer.Option(help="The gateway; by default one is started for the test.")] = None,
    egos: Annotated[int, typer.Option(min=1, help="Sessions that the frames are spread over.")] = 100,
    factor: Annotated[float, typer.Option(min=1, help="Multiple of the capacity.")] = 10.0,
    seconds: Annotated[float, typer.Option(min=0.5, help="Length of each part.")] = 10.0,
    budget_ms: Annotated[float, typer.Option(min=1, help="Latency budget.")] = 200.0,
) -> None:
    """Offer a gateway more than it can answer, and measure what it answers in time and how fast it refuses the rest."""
    torch.set_num_threads(1)
    console = Console()
    if out is not None:
        make_folder(out, "--out")
    bodies = prepare(True, 3, console)
    try:
        figures = asyncio.run(_run(url, bodies, egos, factor, seconds, budget_ms, console))
    except (GatewayError, OSError) as error:
        console.print(f"[red]The test stopped:[/red] {error}")
        sys.exit(1)
    values = figures.as_dict()
    console.print(
        f"Capacity {values['capacity_fps']:.0f} frames a second; offered {values['offered_fps']:.0f}, answered "
        f"{values['answered_fps']:.0f}, refused {values['refused']}, neither {sum(figures.others.values())} "
        f"{values['others'] or ''}"
    )
    if figures.answered_ms:
        console.print(
            f"Answered: {values['within_budget_share']:.2%} within {budget_ms:g} ms of the request's last byte, "
            f"{values['deadline_met_share']:.2%} by the gateway's clock; "
            f"median {values['answered_ms']['p50']:.0f} ms, 99 % {values['answered_ms']['p99']:.0f} ms."
        )
    if figures.refused_ms:
        console.print(
            f"Refused: median {values['refused_ms']['p50']:.1f} ms, 95 % {values['refused_ms']['p95']:.1f} ms, "
            f"99 % {values['refused_ms']['p99']:.1f} ms."
        )
    if out is not None:
        (out / "overload.json").write_text(json.dumps(values, indent=2) + "\n")
        console.print(f"Written: {out / 'overload.json'}")


async def _run(
    url: str | None,
    bodies: Bodies,
    egos: int,
    factor: float,
    seconds: float,
    budget_ms: float,
    console: Console,
) -> OverloadFigures:
    async with AsyncExitStack() as stack:
        if url is None:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            url = await stack.enter_async_context(local_gateway(folder / "gateway.log"))
        progress = stack.enter_context(Progress(console=console, transient=True))
        return await run_overload(url, bodies, egos, factor, seconds, budget_ms, progress)


if __name__ == "__main__":
    typer.run(main)
