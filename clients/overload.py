"""What a gateway does with more frames than it can answer: ``robosac overload``.

First the capacity is found with egos that post one frame after the other. Then frames are due at a multiple of it,
whatever the gateway does. Each request asks with ``Expect: 100-continue`` whether its body is wanted, as a vehicle with
little bandwidth would, so that a refused frame costs neither side its bytes.
"""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
import torch
import typer
from rich.console import Console
from rich.progress import Progress

from clients import trial
from clients.client import MSGPACK, VehicleClient
from clients.load_test import Bodies, new_ego, prepare, run_load
from clients.measured import Load
from clients.raw_http import connected, post_head, read_response
from robosac import wire

REPORT = "overload.json"
CAPACITY_EGOS = 8


@dataclass(frozen=True)
class Plan:
    """How much is offered: a multiple of the capacity, spread over so many egos, for so long."""

    egos: int
    factor: float
    seconds: float
    budget_ms: float


@dataclass
class OverloadFigures:
    """What came of the frames that were due."""

    budget_ms: float
    capacity_fps: float
    """Measured before, one frame after the other."""
    offered: int = 0
    seconds: float = 0.0
    answered_ms: list[float] = field(default_factory=list)
    """From the request's last byte to the answer's. (The budget begins before, with the request's head.)"""
    refused_ms: list[float] = field(default_factory=list)
    """From the connection's beginning to the refusal."""
    deadline_met: int = 0
    """Answers that were in time by the gateway's own clock."""
    others: Counter[str] = field(default_factory=Counter)
    """What was neither answered nor refused with 503."""

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
            "answered_ms": trial.percentiles(self.answered_ms),
            "refused": len(self.refused_ms),
            "refused_ms": trial.percentiles(self.refused_ms),
            "others": dict(self.others),
        }


async def _ask(url: str, ego: VehicleClient, body: bytes, figures: OverloadFigures) -> None:
    """Post one whole frame on a connection of its own; the body goes out only if it is wanted."""
    path = f"/v1/sessions/{ego.session_id}/frames"
    head = post_head(url, path, len(body), ego.token, Accept=MSGPACK, Expect="100-continue", Connection="close")
    started = time.perf_counter()
    try:
        async with connected(url) as (reader, writer):
            writer.write(head)
            status, answer = await read_response(reader)
            if status == 100:
                writer.write(body)
                await writer.drain()
                started = time.perf_counter()
                status, answer = await read_response(reader)
    except (OSError, asyncio.IncompleteReadError, ValueError) as error:
        figures.others[type(error).__name__] += 1
        return
    elapsed_ms = (time.perf_counter() - started) * 1e3
    if status == 200:
        figures.answered_ms.append(elapsed_ms)
        figures.deadline_met += bool(wire.unpack(answer, trusted=True)["deadline_met"])
    elif status == 503:
        figures.refused_ms.append(elapsed_ms)
    else:
        figures.others[str(status)] += 1


async def run_overload(url: str | None, plan: Plan, bodies: Bodies, progress: Progress) -> OverloadFigures:
    """Find the capacity, then offer a multiple of it."""
    async with trial.gateway_to_try(url) as (at, gateway):
        task = progress.add_task("capacity", total=None)
        work = Load("closed", CAPACITY_EGOS, True)
        capacity = await run_load(gateway, work, bodies, plan.seconds, plan.budget_ms)
        fps = len(capacity.latencies_ms) / capacity.seconds
        figures = OverloadFigures(plan.budget_ms, fps)
        vehicles = [await new_ego(gateway, plan.budget_ms) for _ in range(plan.egos)]
        total = int(plan.factor * fps * plan.seconds)
        progress.update(task, description=f"{plan.factor:g} times {fps:.0f} frames a second", total=total)
        started = time.perf_counter()
        posts = []
        for k in range(total):
            await asyncio.sleep(max(0.0, started + k / (plan.factor * fps) - time.perf_counter()))
            ego, body = vehicles[k % plan.egos], bodies.numbered(k // plan.egos)
            posts.append(asyncio.create_task(_ask(at, ego, body, figures)))
            progress.advance(task)
        figures.offered, figures.seconds = total, time.perf_counter() - started
        await asyncio.gather(*posts)
        for ego in vehicles:
            await ego.close()
    return figures


def show(console: Console, figures: OverloadFigures) -> None:
    """Print what came of it."""
    values = figures.as_dict()
    console.print(
        f"Capacity {values['capacity_fps']:.0f} frames a second; offered {values['offered_fps']:.0f}, answered "
        f"{values['answered_fps']:.0f}, refused {values['refused']}, neither {sum(figures.others.values())} "
        f"{values['others'] or ''}"
    )
    if figures.answered_ms:
        console.print(
            f"Answered: {values['within_budget_share']:.2%} within {figures.budget_ms:g} ms of the request's last "
            f"byte, {values['deadline_met_share']:.2%} by the gateway's clock; "
            f"median {values['answered_ms']['p50']:.0f} ms, 99 % {values['answered_ms']['p99']:.0f} ms."
        )
    if figures.refused_ms:
        console.print(
            f"Refused: median {values['refused_ms']['p50']:.1f} ms, 95 % {values['refused_ms']['p95']:.1f} ms, "
            f"99 % {values['refused_ms']['p99']:.1f} ms."
        )


def main(
    out: trial.Out = None,
    force: trial.Force = False,
    url: trial.Url = None,
    egos: Annotated[int, typer.Option(min=1, help="Sessions that the frames are spread over.")] = 100,
    factor: Annotated[float, typer.Option(min=1, max=1000, help="Multiple of the capacity.")] = 10.0,
    seconds: trial.Seconds = 10.0,
    budget_ms: trial.Budget = 200.0,
) -> None:
    """Offer a gateway more than it can answer, and measure what it answers in time and how fast it refuses the rest."""
    torch.set_num_threads(1)
    console = Console()
    trial.make_folder(out, "--out", REPORT, force)
    bodies, plan = prepare(True, 3, console), Plan(egos, factor, seconds, budget_ms)
    with Progress(console=console, transient=True) as progress:
        figures = trial.run(run_overload(url, plan, bodies, progress), console, "The overload test")
    show(console, figures)
    trial.write(figures.as_dict(), out, REPORT, console)


if __name__ == "__main__":
    typer.run(main)
