"""How many frames a gateway answers, and how fast: ``robosac load-test``.

Frames are sensed, attacked and packed ahead, so that the load costs the client little. *Closed loop*: each ego posts
its next frame when the last is answered, which finds the capacity. *Open loop*: frames are due at a fixed rate
whatever the gateway does, and latency counts from the moment a frame was due, so that a stall shows in every frame it
delayed.
"""

from __future__ import annotations

import asyncio
import platform
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from contextlib import AsyncExitStack
from dataclasses import asdict, dataclass, field
from typing import Annotated, Any

import numpy as np
import torch
import typer
from rich.console import Console
from rich.progress import track

from clients import trial
from clients.client import GatewayClient, VehicleClient
from clients.errors import GatewayError
from clients.simulation import Fleet
from robosac import wire
from robosac.answers import FrameAnswer
from robosac.attacks import PGD
from robosac.detectors import load
from robosac.scenes import FRAME_PERIOD_S, IntersectionScene

REPORT = "load_test.json"
PREPARED_FRAMES = 20
WARM_UP_FRAMES = 3
REFUSED_WAIT_S = 0.05
"""How long an ego waits after a frame that was refused."""
DEFENSE = {"kind": "sample_consensus", "attacker_ratio": 0.2, "sampling_budget": 7, "collaborators": 3}
EGO, *TEAM = IntersectionScene(0).agents


@dataclass(frozen=True)
class Load:
    """One way of loading the gateway."""

    loop: str
    """``closed`` or ``open``."""
    egos: int
    attacked: bool
    """Whether one of the five teammates is a PGD attacker."""
    rate_hz: float | None = None
    """Frames a second of each ego, open loop only."""


@dataclass
class Figures:
    """What one load measured; ``budget_ms`` is the latency budget."""

    load: Load
    budget_ms: float
    seconds: float = 0.0
    latencies_ms: list[float] = field(default_factory=list)
    steps: list[int] = field(default_factory=list)
    within_budget: int = 0
    deadline_met: int = 0
    degraded: int = 0
    errors: Counter[str] = field(default_factory=Counter)
    stages: defaultdict[str, list[float]] = field(default_factory=lambda: defaultdict(list))

    def add(self, answer: FrameAnswer, latency_ms: float) -> None:
        """Count an answer."""
        self.latencies_ms.append(latency_ms)
        self.steps.append(answer.sampling_steps)
        self.within_budget += latency_ms <= self.budget_ms
        self.deadline_met += answer.deadline_met
        self.degraded += answer.degraded_by is not None
        for stage, milliseconds in answer.timings_ms.items():
            self.stages[stage].append(milliseconds)

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON; shares are of the frames sent, so a refused frame counts as not answered in time."""
        answered = len(self.latencies_ms)
        sent = answered + sum(self.errors.values())
        return {
            **asdict(self.load),
            "seconds": self.seconds,
            "frames": answered,
            "fps": answered / self.seconds,
            "latency_ms": trial.percentiles(self.latencies_ms),
            "within_budget_share": self.within_budget / max(sent, 1),
            "deadline_met_share": self.deadline_met / max(sent, 1),
            "degraded": self.degraded,
            "sampling_steps_mean": float(np.mean(self.steps)) if answered else None,
            "errors": dict(self.errors),
            "stages_ms": {stage: float(np.median(values)) for stage, values in self.stages.items()},
        }


class Bodies:
    """Packed frames of one fleet, renumbered without packing them again."""

    def __init__(self, frames: Sequence[bytes]) -> None:
        prefix = b"\x83" + wire.pack("frame")  # a map of three entries, the frame's number first
        if not all(body.startswith(prefix + wire.pack(0)) for body in frames):
            raise ValueError("a packed frame must begin with its number")
        self._prefix = prefix
        tails = [body[len(prefix) + 1 :] for body in frames]
        self._tails = tails + tails[-2:0:-1]  # there and back, as no vehicle leaps from the end to the beginning

    def numbered(self, index: int) -> bytes:
        """The body to send as frame ``index``; the prepared ones are sent in turn."""
        return b"".join((self._prefix, wire.pack(index), self._tails[index % len(self._tails)]))


def prepare(attacked: bool, scene_seed: int, console: Console, frames: int = PREPARED_FRAMES) -> Bodies:
    """Sense, attack and pack the frames of one ego and its five teammates."""
    fleet = Fleet(IntersectionScene(scene_seed), load(), 1, int(attacked), PGD(), seed=0)
    bodies = []
    label = f"preparing {'attacked' if attacked else 'benign'} frames"
    for index in track(range(frames), label, console=console, transient=True):
        (frame,) = fleet.sense(index)
        bodies.append(wire.pack_frame(0, frame.message, frame.sent))
    return Bodies(bodies)


async def new_ego(gateway: GatewayClient, budget_ms: float) -> VehicleClient:
    """The ego of a new session of six vehicles."""
    session = await gateway.open_session(EGO, TEAM, defense=DEFENSE, latency_budget_ms=budget_ms)
    return gateway.vehicle(session.session_id, EGO, session.ego_token)


async def run_load(gateway: GatewayClient, work: Load, bodies: Bodies, seconds: float, budget_ms: float) -> Figures:
    """Load the gateway for a time, after a few frames that do not count."""
    run = _Run(bodies, seconds, Figures(work, budget_ms))
    async with AsyncExitStack() as stack:
        egos: list[VehicleClient] = []
        while len(egos) < work.egos:
            egos.append(await new_ego(gateway, budget_ms))
            stack.push_async_callback(egos[-1].close)
        for index in range(WARM_UP_FRAMES):
            for ego in egos:
                await ego.post_frame_body(bodies.numbered(index))
        run.started = time.perf_counter()
        loop = run.closed if work.loop == "closed" else run.open
        await asyncio.gather(*(loop(ego, number) for number, ego in enumerate(egos)))
        run.figures.seconds = time.perf_counter() - run.started
    return run.figures


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
    what = ("loop", "egos", "attack")
    title = f"Six vehicles, {bytes_a_frame / 1e3:.0f} kB a frame; latencies in ms, budget {budget_ms:.0f} ms"
    table = trial.a_table(title, [*what, "FPS", "p50", "p95", "p99", "in time", "steps", "errors"])
    names = list(dict.fromkeys(stage for figures in results for stage in figures.stages))
    headings = [_HEADINGS.get(name, name) for name in names]
    stages = trial.a_table("The gateway's own median timings, ms", [*what, *headings])
    for figures in results:
        values, work = figures.as_dict(), figures.load
        loop = work.loop if work.rate_hz is None else f"{work.loop} {work.rate_hz:g} Hz"
        label = (loop, str(work.egos), "PGD" if work.attacked else "none")
        table.add_row(
            *label,
            f"{values['fps']:.1f}",
            *(trial.shown(value, 0) for value in values["latency_ms"].values()),
            f"{values['within_budget_share']:.1%}",
            trial.shown(values["sampling_steps_mean"], 2),
            str(sum(figures.errors.values())),
        )
        stages.add_row(*label, *(trial.shown(values["stages_ms"].get(name), 1) for name in names))
    console.print(table)
    console.print(stages)


_HEADINGS = {"receive": "recv", "prepare": "prep", "ego_only": "ego", "hypotheses": "fused", "consensus": "match"}


def main(  # the options of a command line
    url: trial.Url = None,
    seconds: trial.Seconds = 10.0,
    egos: Annotated[list[int] | None, typer.Option(min=1, help="Egos at a time; give it several times.")] = None,
    rate: Annotated[float, typer.Option(min=0.1, help="Open loop: frames a second of each ego.")] = 5.0,
    budget_ms: trial.Budget = 200.0,
    scene: Annotated[int, typer.Option(min=0, help="Seed of the scene whose frames are sent.")] = 3,
    out: trial.Out = None,
    force: trial.Force = False,
    api_key: trial.ApiKey = None,
) -> None:
    """Measure a gateway's capacity and latency, with and without attackers, for one ego and for several."""
    torch.set_num_threads(1)
    console = Console()
    trial.make_folder(out, "--out", REPORT, force)
    bodies = {attacked: prepare(attacked, scene, console) for attacked in (False, True)}
    loads = [
        Load(loop, count, attacked, rate if loop == "open" else None)
        for count in egos or [1, 8]
        for loop in ("closed", "open")
        for attacked in (False, True)
    ]

    async def run_all() -> list[Figures]:
        async with trial.gateway_to_try(url, api_key) as (_, gateway):
            progress = track(loads, "loads", console=console, transient=True)
            return [await run_load(gateway, work, bodies[work.attacked], seconds, budget_ms) for work in progress]

    results = trial.run(run_all(), console, "The load test")
    size = len(bodies[False].numbered(0))
    show(console, results, size, budget_ms)
    machine = {"platform": platform.platform(), "processor": platform.processor(), "python": sys.version.split()[0]}
    report: Mapping[str, Any] = {
        "machine": machine,
        "bytes_a_frame": size,
        "budget_ms": budget_ms,
        "defense": DEFENSE,
        "loads": [figures.as_dict() for figures in results],
    }
    trial.write(report, out, REPORT, console)
    if any(not figures.latencies_ms for figures in results):
        console.print("[red]A load got no answer at all.[/red]")
        sys.exit(1)


if __name__ == "__main__":
    typer.run(main)
