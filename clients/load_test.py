"""How many frames a gateway answers, and how fast: ``robosac load-test``.

Frames are sensed, attacked and packed ahead, so that the load costs the client little. *Closed loop*: each ego posts
its next frame when the last is answered, which finds the capacity. *Open loop*: frames are due at a fixed rate
whatever the gateway does, and latency counts from the moment a frame was due, so that a stall shows in every frame it
delayed.
"""

from __future__ import annotations

import asyncio
import os
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import AsyncExitStack
from dataclasses import dataclass
from typing import Annotated, Any

import torch
import typer
from rich.console import Console
from rich.progress import track

from clients import trial
from clients.client import GatewayClient, VehicleClient
from clients.errors import GatewayError
from clients.machine import machine, pace
from clients.measured import Figures, Load
from clients.metering import CountingTransport, Meter
from clients.simulation import Fleet
from robosac import wire
from robosac.attacks import PGD
from robosac.detectors import load
from robosac.scenes import FRAME_PERIOD_S, IntersectionScene

REPORT = "load_test.json"
PREPARED_FRAMES = 20
WARM_UP_FRAMES = 3
REFUSED_WAIT_S = 0.05
"""How long an ego waits after a frame that was refused."""
DEFENSE: dict[str, Any] = {
    "kind": "sample_consensus",
    "attacker_ratio": 0.2,
    "sampling_budget": 7,
    "collaborators": 3,
}
EGO, *TEAM = IntersectionScene(0).agents


class Bodies:
    """Packed frames, or messages, of one vehicle, renumbered without packing them again; ``team`` are the ego's
    teammates.
    """

    def __init__(self, frames: Sequence[bytes], team: Sequence[str] = TEAM) -> None:
        self.team = team
        prefix = frames[0][:1] + wire.pack("frame")  # a map, the frame's number first
        if not all(body.startswith(prefix + wire.pack(0)) for body in frames):
            raise ValueError("a packed frame or message must begin with its number")
        self._prefix = prefix
        tails = [body[len(prefix) + 1 :] for body in frames]
        self._tails = tails + tails[-2:0:-1]  # there and back, as no vehicle leaps from the end to the beginning

    def numbered(self, index: int) -> bytes:
        """The body to send as frame ``index``; the prepared ones are sent in turn."""
        return b"".join((self._prefix, wire.pack(index), self._tails[index % len(self._tails)]))


def prepare(
    attacked: bool, scene_seed: int, console: Console, frames: int = PREPARED_FRAMES, teammates: int = len(TEAM)
) -> Bodies:
    """Sense, attack and pack the frames of one ego and so many of its five teammates, the attacker among them."""
    fleet = Fleet(IntersectionScene(scene_seed), load(), 1, int(attacked), PGD(), seed=0)
    team = sorted(TEAM, key=lambda name: name not in fleet.attackers)[:teammates]
    bodies = []
    label = f"preparing {'attacked' if attacked else 'benign'} frames"
    for index in track(range(frames), label, console=console, transient=True):
        (frame,) = fleet.sense(index)
        bodies.append(wire.pack_frame(0, frame.message, {name: frame.sent[name] for name in team}))
    return Bodies(bodies, team)


async def new_ego(
    gateway: GatewayClient, budget_ms: float, team: Sequence[str] = TEAM, defense: Mapping[str, Any] = DEFENSE
) -> VehicleClient:
    """The ego of a new session, of six vehicles by default."""
    session = await gateway.open_session(EGO, team, defense=defense, latency_budget_ms=budget_ms)
    return gateway.vehicle(session.session_id, EGO, session.ego_token)


async def run_load(
    gateway: GatewayClient,
    work: Load,
    bodies: Bodies,
    seconds: float,
    budget_ms: float,
    *,
    defense: Mapping[str, Any] = DEFENSE,
    meter: Meter | None = None,
) -> Figures:
    """Load the gateway for a time, after a few frames that do not count; with a meter also what the frames cost."""
    run = _Run(bodies, seconds, Figures(work, budget_ms))
    async with AsyncExitStack() as stack:
        egos: list[VehicleClient] = []
        while len(egos) < work.egos:
            egos.append(await new_ego(gateway, budget_ms, bodies.team, defense))
            stack.push_async_callback(egos[-1].close)
        cold = await meter.frames() if meter else []
        for index in range(WARM_UP_FRAMES):
            for ego in egos:
                await ego.post_frame_body(bodies.numbered(index))
        run.figures.placed = _placed(cold, await meter.frames(), len(egos)) if meter else None
        run.figures.pace = await asyncio.to_thread(pace) if meter else None
        records = [await _last_record(ego) for ego in egos] if meter else []
        before = await meter.read() if meter else None
        run.started = time.perf_counter()
        loop = run.closed if work.loop == "closed" else run.open
        await asyncio.gather(*(loop(ego, number) for number, ego in enumerate(egos)))
        run.figures.seconds = time.perf_counter() - run.started
        if meter and before:
            frames = len(run.figures.latencies_ms)
            run.figures.used = (await meter.read()).since(before, frames)
            logs = [await _log_bytes(ego, since) for ego, since in zip(egos, records, strict=True)]
            run.figures.used["audit_bytes"] = sum(logs) / frames if frames else None
    return run.figures


def _placed(before: Sequence[int], after: Sequence[int], egos: int) -> list[int] | None:
    """Egos of each gateway, by how many frames it answered while they warmed up; None if others sent some, too."""
    placed = [(b - a) // WARM_UP_FRAMES for a, b in zip(before, after, strict=True)]
    return placed if sum(placed) == egos else None


async def _last_record(ego: VehicleClient) -> int:
    return int((await ego.state())["audit_seq"])


async def _log_bytes(ego: VehicleClient, after: int) -> int:
    """Of a session's log, the bytes after a record."""
    return sum([len(line.encode()) + 1 async for line in ego.stream_audit(after)])


@dataclass
class _Run:
    """A load on its way; ``started`` is a time of `time.perf_counter`."""

    bodies: Bodies
    seconds: float
    figures: Figures
    started: float = 0.0

    async def closed(self, ego: VehicleClient, _: int) -> None:
        index = WARM_UP_FRAMES
        while time.perf_counter() - self.started < self.seconds:
            await self._post(ego, index, time.perf_counter())
            index += 1

    async def open(self, ego: VehicleClient, number: int) -> None:
        rate = self.figures.load.rate_hz or 1 / FRAME_PERIOD_S
        offset = number / self.figures.load.egos / rate  # egos are not in step
        posts = []
        for k in range(max(1, int(self.seconds * rate))):
            due = self.started + offset + k / rate
            await asyncio.sleep(max(0.0, due - time.perf_counter()))
            posts.append(asyncio.create_task(self._post(ego, WARM_UP_FRAMES + k, due)))
        await asyncio.gather(*posts)

    async def _post(self, ego: VehicleClient, index: int, due: float) -> None:
        try:
            answer = await ego.post_frame_body(self.bodies.numbered(index))
        except GatewayError as error:
            self.figures.errors[type(error).__name__] += 1
            await asyncio.sleep(REFUSED_WAIT_S)
        else:
            self.figures.add(answer, (time.perf_counter() - due) * 1e3)


def show(console: Console, results: Sequence[Figures], bytes_a_frame: int, budget_ms: float) -> None:
    """Print the figures and the gateway's own timings by stage."""
    teams = len({figures.load.teammates for figures in results}) > 1
    what = ("loop", *(["team"] if teams else []), "egos", "attack")
    title = (
        f"An ego and its team, {bytes_a_frame / 1e3:.0f} kB a frame; latencies and CPU in ms, budget {budget_ms:.0f} ms"
    )
    table = trial.a_table(title, [*what, "FPS", "p50", "p95", "p99", "in time", "steps", "CPU", "errors"])
    names = list(dict.fromkeys(stage for figures in results for stage in figures.stages))
    headings = [_HEADINGS.get(name, name) for name in names]
    stages = trial.a_table("The gateway's own median timings, ms", [*what, *headings])
    for figures in results:
        values, work = figures.as_dict(), figures.load
        loop = work.loop if work.rate_hz is None else f"{work.loop} {work.rate_hz:g} Hz"
        label = (loop, *([str(work.teammates)] if teams else []), str(work.egos), "PGD" if work.attacked else "none")
        table.add_row(
            *label,
            f"{values['fps']:.1f}",
            *(trial.shown(value, 0) for value in values["latency_ms"].values()),
            f"{values['within_budget_share']:.1%}",
            trial.shown(values["sampling_steps_mean"], 2),
            trial.shown(figures.used.get("gateway_cpu_ms"), 1),
            str(sum(figures.errors.values())),
        )
        stages.add_row(*label, *(trial.shown(values["stages_ms"].get(name), 1) for name in names))
    trial.print_whole(console, table)
    trial.print_whole(console, stages)


_HEADINGS = {"receive": "recv", "prepare": "prep", "ego_only": "ego", "hypotheses": "fused", "consensus": "match"}


def main(  # the options of a command line
    url: trial.Url = None,
    process: Annotated[
        list[str] | None,
        typer.Option(
            callback=trial.checked_urls,
            help="Behind a proxy: address of each gateway, for its metrics; give it several times.",
        ),
    ] = None,
    seconds: trial.Seconds = 10.0,
    egos: Annotated[
        list[int] | None, typer.Option(min=1, help="Egos at a time, by default 1 and 8; give it several times.")
    ] = None,
    teammates: Annotated[
        list[int] | None,
        typer.Option(min=1, max=len(TEAM), help="Teammates of an ego, by default all; give it several times."),
    ] = None,
    rate: Annotated[float, typer.Option(min=0.1, max=10_000, help="Open loop: frames a second of each ego.")] = 5.0,
    budget_ms: trial.Budget = 200.0,
    defense: Annotated[str, typer.Option(help="Kind of the sessions' defence.")] = str(DEFENSE["kind"]),
    scene: Annotated[int, typer.Option(min=0, help="Seed of the scene whose frames are sent.")] = 3,
    out: trial.Out = None,
    force: trial.Force = False,
    api_key: trial.ApiKey = None,
) -> None:
    """Measure a gateway's capacity, latency and costs, with and without attackers, for one ego and for several."""
    torch.set_num_threads(1)
    console = Console()
    trial.make_folder(out, "--out", REPORT, force)
    teams = teammates or [len(TEAM)]
    bodies = {(at, n): prepare(at, scene, console, teammates=n) for at in (False, True) for n in teams}
    loads = [
        Load(loop, count, attacked, rate if loop == "open" else None, team)
        for team in teams
        for count in egos or [1, 8]
        for loop in ("closed", "open")
        for attacked in (False, True)
    ]

    async def run_all(folder: str) -> list[Figures]:
        database_url = os.environ.get("ROBOSAC_DATABASE_URL", f"sqlite:///{folder}/robosac.db")
        transport = CountingTransport()
        async with trial.gateway_to_try(url, api_key, database_url=database_url, transport=transport) as (at, gateway):
            meter = Meter(process or [at], database_url, transport)
            progress = track(loads, "loads", console=console, transient=True)
            return [
                await run_load(
                    gateway,
                    work,
                    bodies[work.attacked, work.teammates],
                    seconds,
                    budget_ms,
                    defense=_defense(defense, work.teammates),
                    meter=meter,
                )
                for work in progress
            ]

    with tempfile.TemporaryDirectory(prefix="robosac-") as folder:
        results = trial.run(run_all(folder), console, "The load test")
    sizes = {team: len(bodies[False, team].numbered(0)) for team in teams}
    show(console, results, sizes[teams[0]], budget_ms)
    report: Mapping[str, Any] = {
        "machine": machine(),
        "processes": len(process or [url]),
        "bytes_a_frame": sizes[teams[0]],
        "body_bytes": {str(team): size for team, size in sizes.items()},
        "budget_ms": budget_ms,
        "defense": _defense(defense, teams[0]),
        "loads": [figures.as_dict() for figures in results],
    }
    trial.write(report, out, REPORT, console)
    if any(not figures.latencies_ms for figures in results):
        console.print("[red]A load got no answer at all.[/red]")
        sys.exit(1)


def _defense(kind: str, teammates: int) -> Mapping[str, Any]:
    """As a session asks for it: sampling as in the paper, for teams of other sizes too, or another kind as it comes."""
    if kind != DEFENSE["kind"]:
        return {"kind": kind}
    return {**DEFENSE, "collaborators": max(1, DEFENSE["collaborators"] - len(TEAM) + teammates)}


if __name__ == "__main__":
    typer.run(main)
