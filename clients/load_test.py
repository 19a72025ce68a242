"""How many frames a gateway answers, and how fast: ``robosac load-test``.

Frames are sensed, attacked and packed ahead, so that the load costs the client little. *Closed loop*: each ego posts
its next frame when the last is answered, which finds the capacity. *Open loop*: frames are due at a fixed rate
whatever the gateway does, and latency counts from the moment a frame was due, so that a stall shows in every frame it
delayed.
"""

from __future__ import annotations

import asyncio
import json
import platform
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Sequence
from contextlib import AsyncExitStack
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import track
from rich.table import Table

from clients.client import API_KEY_VARIABLE, GatewayClient, VehicleClient
from clients.errors import GatewayError
from clients.local_gateway import local_gateway
from clients.simulation import Fleet, make_folder
from robosac import wire
from robosac.answers import FrameAnswer
from robosac.attacks import PGD
from robosac.detectors import load
from robosac.scenes import FRAME_PERIOD_S, IntersectionScene

PREPARED_FRAMES = 20
WARM_UP_FRAMES = 3
REFUSED_WAIT_S = 0.05
"""How long an ego waits after a frame that was refused."""
DEFENSE = {"kind": "sample_consensus", "attacker_ratio": 0.2, "sampling_budget": 7, "collaborators": 3}


@dataclass(frozen=True)
class Load:
    """One way of loading the gateway.

    Attributes
    ----------
    loop : str
        ``closed`` or ``open``.
    egos : int
    attacked : bool
        Whether one of the five teammates is a PGD attacker.
    rate_hz : float or None
        Frames a second of each ego, open loop only.
    """

    loop: str
    egos: int
    attacked: bool
    rate_hz: float | None = None


@dataclass
class Figures:
    """What one load measured."""

    load: Load
    seconds: float = 0.0
    latencies_ms: list[float] = field(default_factory=list)
    steps: list[int] = field(default_factory=list)
    within_budget: int = 0
    deadline_met: int = 0
    degraded: int = 0
    errors: Counter[str] = field(default_factory=Counter)
    stages: defaultdict[str, list[float]] = field(default_factory=lambda: defaultdict(list))

    def add(self, answer: FrameAnswer, latency_ms: float, budget_ms: float) -> None:
        """Count an answer."""
        self.latencies_ms.append(latency_ms)
        self.steps.append(answer.sampling_steps)
        self.within_budget += latency_ms <= budget_ms
        self.deadline_met += answer.deadline_met
        self.degraded += answer.degraded_by is not None
        for stage, milliseconds in answer.timings_ms.items():
            self.stages[stage].append(milliseconds)

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON; shares are of the frames sent, so a refused frame counts as not answered in time."""
        answered = len(self.latencies_ms)
        sent = answered + sum(self.errors.values())
        p50, p95, p99 = np.percentile(self.latencies_ms, [50, 95, 99]) if answered else [None] * 3
        return {
            **asdict(self.load),
            "seconds": self.seconds,
            "frames": answered,
            "fps": answered / self.seconds,
            "latency_ms": {"p50": p50, "p95": p95, "p99": p99},
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

    @property
    def bytes_a_frame(self) -> int:
        """Size of a body."""
        return len(self._prefix) + len(self._tails[0]) + 1

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


async def run_load(gateway: GatewayClient, work: Load, bodies: Bodies, seconds: float, budget_ms: float) -> Figures:
    """Load the gateway for a time, after a few frames that do not count."""
    figures = Figures(work)
    agents = IntersectionScene(0).agents
    async with AsyncExitStack() as stack:
        egos = []
        for _ in range(work.egos):
            session = await gateway.open_session(agents[0], agents[1:], defense=DEFENSE, latency_budget_ms=budget_ms)
            ego = gateway.vehicle(session.session_id, agents[0], session.ego_token)
            stack.push_async_callback(ego.close)
            egos.append(ego)
        for index in range(WARM_UP_FRAMES):
            for ego in egos:
                await ego.post_frame_body(bodies.numbered(index))
        loop = _closed if work.loop == "closed" else _open
        started = time.perf_counter()
        await asyncio.gather(
            *(loop(ego, number, bodies, figures, started, seconds, budget_ms) for number, ego in enumerate(egos))
        )
        figures.seconds = time.perf_counter() - started
    return figures


async def _closed(
    ego: VehicleClient, _: int, bodies: Bodies, figures: Figures, started: float, seconds: float, budget_ms: float
) -> None:
    index = WARM_UP_FRAMES
    while time.perf_counter() - started < seconds:
        await _post(ego, bodies.numbered(index), figures, time.perf_counter(), budget_ms)
        index += 1


async def _open(
    ego: VehicleClient, number: int, bodies: Bodies, figures: Figures, started: float, seconds: float, budget_ms: float
) -> None:
    rate = figures.load.rate_hz or 1 / FRAME_PERIOD_S
    offset = number / figures.load.egos / rate  # egos are not in step
    posts = []
    for k in range(max(1, int(seconds * rate))):
        due = started + offset + k / rate
        await asyncio.sleep(max(0.0, due - time.perf_counter()))
        body = bodies.numbered(WARM_UP_FRAMES + k)
        posts.append(asyncio.create_task(_post(ego, body, figures, due, budget_ms)))
    await asyncio.gather(*posts)


async def _post(ego: VehicleClient, body: bytes, figures: Figures, due: float, budget_ms: float) -> None:
    try:
        answer = await ego.post_frame_body(body)
    except GatewayError as error:
        figures.errors[type(error).__name__] += 1
        await asyncio.sleep(REFUSED_WAIT_S)
    else:
        figures.add(answer, (time.perf_counter() - due) * 1e3, budget_ms)


def show(console: Console, results: Sequence[Figures], bytes_a_frame: int, budget_ms: float) -> None:
    """Print the figures and the gateway's own timings by stage."""
    size = f"{bytes_a_frame / 1e3:.0f} kB a frame"
    figures_of_load = ("FPS", "p50", "p95", "p99", "in time", "steps", "errors")
    table = _table(f"Six vehicles, {size}; latencies in ms, budget {budget_ms:.0f} ms", figures_of_load)
    names = list(dict.fromkeys(stage for figures in results for stage in figures.stages))
    stages = _table("The gateway's own median timings, ms", [_HEADINGS.get(name, name) for name in names])
    for figures in results:
        values, work = figures.as_dict(), figures.load
        loop = work.loop if work.rate_hz is None else f"{work.loop} {work.rate_hz:g} Hz"
        label = (loop, str(work.egos), "PGD" if work.attacked else "none")
        table.add_row(
            *label,
            f"{values['fps']:.1f}",
            *(_shown(values["latency_ms"][p], 0) for p in ("p50", "p95", "p99")),
            f"{values['within_budget_share']:.1%}",
            _shown(values["sampling_steps_mean"], 2),
            str(sum(figures.errors.values())),
        )
        stages.add_row(*label, *(_shown(values["stages_ms"].get(name), 1) for name in names))
    console.print(table)
    console.print(stages)


_HEADINGS = {"receive": "recv", "prepare": "prep", "ego_only": "ego", "hypotheses": "fused", "consensus": "match"}


def _shown(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _table(title: str, columns: Sequence[str]) -> Table:
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, padding=(0, 0, 0, 1))
    for heading in ("loop", "egos", "attack", *columns):
        table.add_column(heading, justify="left" if heading == "loop" else "right", no_wrap=heading == "loop")
    return table


def main(
    url: Annotated[str | None, typer.Option(help="The gateway; by default one is started for the test.")] = None,
    seconds: Annotated[float, typer.Option(min=0.5, help="Length of each load.")] = 10.0,
    egos: Annotated[list[int] | None, typer.Option(min=1, help="Egos at a time; give it several times.")] = None,
    rate: Annotated[float, typer.Option(min=0.1, help="Open loop: frames a second of each ego.")] = 5.0,
    budget_ms: Annotated[float, typer.Option(min=1, help="Latency budget.")] = 200.0,
    scene: Annotated[int, typer.Option(min=0, help="Seed of the scene whose frames are sent.")] = 3,
    out: Annotated[Path | None, typer.Option(help="Folder for load_test.json.")] = None,
    api_key: Annotated[
        str | None, typer.Option(envvar=API_KEY_VARIABLE, help="Opens sessions, where the gateway asks for one.")
    ] = None,
) -> None:
    """Measure a gateway's capacity and latency, with and without attackers, for one ego and for several."""
    torch.set_num_threads(1)
    console = Console()
    if out is not None:
        make_folder(out, "--out")
    bodies = {attacked: prepare(attacked, scene, console) for attacked in (False, True)}
    loads = [
        Load(loop, count, attacked, rate if loop == "open" else None)
        for count in egos or [1, 8]
        for loop in ("closed", "open")
        for attacked in (False, True)
    ]
    try:
        results = asyncio.run(_run_all(url, api_key, loads, bodies, seconds, budget_ms, console))
    except asyncio.CancelledError:
        sys.exit(143)
    except (GatewayError, OSError) as error:
        console.print(f"[red]The load test stopped:[/red] {error}")
        sys.exit(1)
    size = bodies[False].bytes_a_frame
    show(console, results, size, budget_ms)
    if out is not None:
        report = {
            "machine": {
                "platform": platform.platform(),
                "processor": platform.processor(),
                "python": sys.version.split()[0],
            },
            "bytes_a_frame": size,
            "budget_ms": budget_ms,
            "defense": DEFENSE,
            "loads": [figures.as_dict() for figures in results],
        }
        (out / "load_test.json").write_text(json.dumps(report, indent=2) + "\n")
        console.print(f"Written: {out / 'load_test.json'}")
    if any(not figures.latencies_ms for figures in results):
        console.print("[red]A load got no answer at all.[/red]")
        sys.exit(1)


async def _run_all(
    url: str | None,
    api_key: str | None,
    loads: Sequence[Load],
    bodies: dict[bool, Bodies],
    seconds: float,
    budget_ms: float,
    console: Console,
) -> list[Figures]:
    async with AsyncExitStack() as stack:
        if url is None:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            url = await stack.enter_async_context(local_gateway(folder / "gateway.log"))
        gateway = await stack.enter_async_context(GatewayClient(url, api_key))
        results = []
        for work in track(loads, "loads", console=console, transient=True):
            results.append(await run_load(gateway, work, bodies[work.attacked], seconds, budget_ms))
        return results


if __name__ == "__main__":
    typer.run(main)
