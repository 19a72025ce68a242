"""What somebody with a valid key can do to an honest ego: ``robosac adversary``.

For each attack a fresh gateway is started on loopback. The attacker has an API key of its own, or the honest ego's, or
no more than the token of one of the ego's teammates. The ego posts frames at a fixed rate, at first alone, and then
beside the attack, which runs in a process of its own. Whether a frame was in time is told by the ego's own clock.

Attackers have machines of their own. So where there are several cores, and the system lets one choose, the gateway has
all but the last, the ego and the attack share that one, and the ego goes first there.
"""

from __future__ import annotations

import asyncio
import math
import multiprocessing
import os
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from contextvars import ContextVar
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from secrets import token_urlsafe
from typing import Annotated, Any

import httpx
import torch
import typer
from rich.console import Console
from rich.progress import track

from clients import trial
from clients.client import LIMITS, GatewayClient, VehicleClient
from clients.cores import Cores
from clients.errors import GatewayError
from clients.hostile import BROKEN, FAULTS, FAULTY, OF_TEAMMATES, Attack, Target, run_attack, strange_frame
from clients.load_test import DEFENSE, EGO, TEAM, WARM_UP_FRAMES, Bodies, prepare
from clients.local_gateway import GatewayProcess

REPORT = "adversary.json"
ONLY_HELP = f"Attacks to play, such as --only '{Attack.IDLE}' --only '{Attack.LONG}'; by default all."
BY_HELP = (
    "Who attacks: somebody with a key of its own; with the ego's; or one of the ego's teammates, with its token alone."
)
HONEST_HZ = 5.0
CLOCK_MS = 5.0
"""What the ego's clock sees more than the gateway's, on one machine: the way there and back."""
YIELDS = 5
"""By how much the attack's process is nicer than the ego's, with which it shares a core."""
RECOVERED_WITHIN = 2
"""Frames after a fault by which an answer has to be tested and in time again."""
_sent_at: ContextVar[float] = ContextVar("sent_at")


class _Noting(httpx.AsyncHTTPTransport):
    """Notes for its task when it sent a request: the client sends one again that the database failed."""

    async def handle_async_request(self, request: httpx.Request) -> httpx.Response:
        _sent_at.set(time.perf_counter())
        return await super().handle_async_request(request)


class By(StrEnum):
    """Who attacks."""

    OTHER = "another-key"
    SAME = "same-key"
    """Another session of the ego's own API key."""
    TEAMMATE = "teammate"
    """In the ego's own session."""


@dataclass(frozen=True)
class Plan:
    """How long each part takes, the honest ego's budget, and who attacks."""

    seconds: float
    budget_ms: float
    by: By


@dataclass
class Seen:
    """What an honest ego saw of its frames."""

    budget_ms: float
    frames: int = 0
    in_budget: int = 0
    """Answered within the budget, by its own clock."""
    tested: int = 0
    """Answered within the budget, and not cut short."""
    belied: int = 0
    """Answers that call themselves in time and came too late."""
    cores: float = math.nan
    """Of processor time, what the gateway used meanwhile."""
    refused: Counter[str] = field(default_factory=Counter)
    outcomes: list[tuple[float, bool]] = field(default_factory=list, repr=False)
    """Of each frame when it was due, and whether it was tested in time."""

    async def post(self, ego: VehicleClient, body: bytes) -> None:
        """Post a frame and note what comes of it."""
        began, good = time.perf_counter(), False
        self.frames += 1
        try:
            answer = await ego.post_frame_body(body)
        except GatewayError as error:
            self.refused[f"{type(error).__name__}: {str(error)[:60]}"] += 1
        else:
            ended = time.perf_counter()
            in_budget = (ended - began) * 1e3 <= self.budget_ms
            good = in_budget and answer.degraded_by is None
            self.in_budget += in_budget
            self.tested += good
            self.belied += answer.deadline_met and (ended - _sent_at.get()) * 1e3 > self.budget_ms + CLOCK_MS
        self.outcomes.append((began, good))

    def share(self, number: int) -> float:
        """Of its frames."""
        return number / max(self.frames, 1)

    def recovered_after(self, moment: float) -> int | None:
        """Frames from a moment (`time.perf_counter`) on until one was tested in time; None if none was."""
        after = [good for began, good in sorted(self.outcomes) if began >= moment]
        return after.index(True) if True in after else None


@dataclass
class Result:
    """What came of one attack."""

    attack: Attack
    before: Seen
    during: Seen
    attacker: Counter[str]
    """What the attacker was answered, by status."""
    memory_mib: float
    """Most that the gateway held."""
    recovered_after: int | None = None
    """Of an attack that ends before its part does: frames until one was tested in time."""

    @property
    def held(self) -> bool:
        """Whether no answer was belied, nothing was given that should not be, and the ego was served again after a
        fault.
        """
        recovered = self.attack not in FAULTS or (
            self.recovered_after is not None and self.recovered_after <= RECOVERED_WITHIN
        )
        return not self.before.belied + self.during.belied + len(self.broken) and recovered

    @property
    def broken(self) -> list[str]:
        """What the attacker was given that nobody should be."""
        return [told.removeprefix(BROKEN) for told in self.attacker if told.startswith(BROKEN)]


async def _drive(
    ego: VehicleClient, bodies: Bodies, first: int, seen: Seen, seconds: float, process: GatewayProcess
) -> int:
    """Post frames at the honest rate, whatever becomes of them; the number of the next frame."""
    started, posts, used_s = time.perf_counter(), [], process.cpu_s()
    for k in range(max(1, int(seconds * HONEST_HZ))):
        await asyncio.sleep(max(0.0, started + k / HONEST_HZ - time.perf_counter()))
        posts.append(asyncio.create_task(seen.post(ego, bodies.numbered(first + k))))
    await asyncio.gather(*posts)
    seen.cores = (process.cpu_s() - used_s) / (time.perf_counter() - started)
    return first + len(posts)


async def play(
    attack: Attack, plan: Plan, bodies: Bodies, strange: bytes, pool: ProcessPoolExecutor, cores: Cores
) -> Result:
    """One attack on a gateway of its own."""
    honest_key, key, viewer = (token_urlsafe(32) for _ in range(3))
    key = honest_key if plan.by is By.SAME else key
    with tempfile.TemporaryDirectory(prefix="robosac-") as name:
        folder = Path(name)
        url, settings = f"sqlite:///{folder}/robosac.db", {"ROBOSAC_VIEWER_TOKENS": viewer}
        with cores.of_gateways():
            process = GatewayProcess(folder / "gateway.log", url, ",".join({honest_key, key}), settings=settings)
        try:
            await process.ready()
            noting = _Noting(limits=LIMITS)
            async with GatewayClient(process.url, honest_key, transport=noting) as gateway:
                opened = await gateway.open_session(EGO, TEAM, defense=DEFENSE, latency_budget_ms=plan.budget_ms)
                ego = gateway.vehicle(opened.session_id, EGO, opened.ego_token)
                mate = (TEAM[0], opened.teammate_tokens[TEAM[0]]) if plan.by is By.TEAMMATE else None
                for frame in range(WARM_UP_FRAMES):
                    await ego.post_frame_body(bodies.numbered(frame))
                before, during = Seen(plan.budget_ms), Seen(plan.budget_ms)
                frame = await _drive(ego, bodies, WARM_UP_FRAMES, before, plan.seconds, process)
                database, honest = str(folder / "robosac.db"), bodies.numbered(0)
                target = Target(process.url, key, database, process.pid, strange, honest, ego.session_id, viewer, mate)
                loop = asyncio.get_running_loop()
                attacking = loop.run_in_executor(pool, run_attack, attack, target, plan.seconds)
                ends = time.perf_counter() + FAULTY * plan.seconds
                await _drive(ego, bodies, frame, during, plan.seconds, process)
                result = Result(attack, before, during, await attacking, process.peak_memory_mib())
                if attack in FAULTS:
                    result.recovered_after = during.recovered_after(ends)
                return result
        finally:
            await process.stop()


def _as_attacker(cores: Cores) -> None:
    cores.be_a_client()
    os.nice(YIELDS)


async def play_all(attacks: Sequence[Attack], plan: Plan, bodies: Bodies, console: Console) -> list[Result]:
    """One attack after another."""
    strange, cores = strange_frame(bodies.numbered(0)), Cores()
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, spawn, initializer=_as_attacker, initargs=(cores,)) as pool:
        await asyncio.get_running_loop().run_in_executor(pool, time.time)  # it takes seconds to start
        return [
            await play(attack, plan, bodies, strange, pool, cores)
            for attack in track(attacks, "attacks", console=console, transient=True)
        ]


def show(console: Console, results: Sequence[Result], plan: Plan) -> None:
    """Print what came of it."""
    title = f"One honest ego at {HONEST_HZ:g} Hz, budget {plan.budget_ms:g} ms, by its own clock; attacks by: {plan.by}"
    columns = ["tested: before", "during", "belied", "refused", "broken", "cores: before", "during", "MiB"]
    columns.append("recovered after")
    table = trial.a_table(title, ["attack", *columns])
    for result in results:
        before, during = result.before, result.during
        table.add_row(
            result.attack.value,
            *(f"{seen.share(seen.tested):.0%}" for seen in (before, during)),
            str(before.belied + during.belied),
            str(during.refused.total()),
            str(len(result.broken)),
            *(f"{seen.cores:.2f}" for seen in (before, during)),
            f"{result.memory_mib:.0f}",
            "-" if result.recovered_after is None else f"{result.recovered_after} frames",
        )
    trial.print_whole(console, table)
    for result in results:
        for told in result.broken:
            console.print(f"{result.attack.value}: {told}")


def main(
    out: trial.Out = None,
    force: trial.Force = False,
    only: Annotated[list[Attack] | None, typer.Option(help=ONLY_HELP)] = None,
    seconds: trial.Seconds = 4.0,
    budget_ms: trial.Budget = 200.0,
    at_least: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Share of frames to be tested in time during an attack.")
    ] = 0.95,
    by: Annotated[By, typer.Option(help=BY_HELP)] = By.OTHER,
) -> None:
    """Attack gateways of one's own with a valid key, and measure what an honest ego beside notices.

    Exits with 1 if an answer called itself in time and was not, if the attacker was given what nobody should be, if the
    ego was not served again after a fault, or if fewer frames than asked for were tested in time during another attack.
    """
    torch.set_num_threads(1)
    console = Console()
    attacks = only or [attack for attack in Attack if by is not By.TEAMMATE or attack in OF_TEAMMATES]
    if by is By.TEAMMATE and (others := set(attacks) - OF_TEAMMATES):
        raise typer.BadParameter(f"no teammate's attack: {', '.join(sorted(others))}", param_hint="'--only'")
    trial.make_folder(out, "--out", REPORT, force)
    plan = Plan(seconds, budget_ms, by)
    bodies = prepare(True, 3, console)
    results = trial.run(play_all(attacks, plan, bodies, console), console, "The adversary")
    show(console, results, plan)
    trial.write([_as_dict(result) for result in results], out, REPORT, console)
    enough = [r.during.share(r.during.tested) >= at_least for r in results if r.attack not in FAULTS]
    if not all(enough) or not all(result.held for result in results):
        sys.exit(1)


def _as_dict(result: Result) -> dict[str, Any]:
    """Plain values for JSON."""
    parts = {
        name: {
            "frames": seen.frames,
            "in_budget": seen.in_budget,
            "tested": seen.tested,
            "belied": seen.belied,
            "cores": seen.cores,
            "refused": dict(seen.refused),
        }
        for name, seen in (("before", result.before), ("during", result.during))
    }
    others = {name: getattr(result, name) for name in ("memory_mib", "recovered_after", "broken", "held")}
    return {"attack": result.attack.value, **parts, "attacker": dict(result.attacker), **others}


if __name__ == "__main__":
    typer.run(main)
