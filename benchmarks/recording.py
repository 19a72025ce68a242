"""What a recording costs: frames per second, the gateway's processor time per frame and latency, of a session that is
recorded and of one that is not. The two take turns within one gateway.

    python benchmarks/recording.py --seconds 5 --rounds 4
    python benchmarks/recording.py --seconds 5 --rounds 4 --rate 5
"""

from __future__ import annotations

import asyncio
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
from clients.vehicle import VehicleClient
from robosac import IntersectionScene, load_detector

ARMS = ("not recorded", "recorded")
COLUMNS = ("FPS", "CPU ms a frame", "p50 ms", "p99 ms")


async def measure(seconds: float, rounds: int, pause_s: float) -> tuple[dict[str, list[tuple[float, ...]]], float, str]:
    """The columns by arm and round, bytes a frame on disk, and what was left out."""
    detector, frame = load_detector(), IntersectionScene(seed=8).frame(0)
    messages = {name: detector.encode(view.points, view.pose) for name, view in frame.views.items()}
    own = messages.pop("car-1")
    measured, numbers = defaultdict(list), dict.fromkeys(ARMS, 0)
    with tempfile.TemporaryDirectory() as folder:
        settings = {"ROBOSAC_RECORD": f"{folder}/recordings", "ROBOSAC_RECORD_SESSIONS": "asked"}
        process = GatewayProcess(Path(folder) / "log", f"sqlite:///{folder}/db", settings=settings)
        try:
            await process.ready()
            async with GatewayClient(process.url) as gateway:
                egos: dict[str, VehicleClient] = {}
                for arm in ARMS:
                    options = {"latency_budget_ms": 20_000, "gather_ms": 0, "record": arm == "recorded"}
                    session = await gateway.open_session("car-1", list(messages), **options)
                    egos[arm] = gateway.vehicle(session.session_id, "car-1", session.ego_token)

                async def drive(arm: str, for_s: float) -> tuple[float, ...]:
                    began, cpu_s, latencies = time.perf_counter(), process.cpu_s(), []
                    while time.perf_counter() - began < for_s:
                        asked = time.perf_counter()
                        await egos[arm].post_frame(numbers[arm], own, messages)
                        numbers[arm] += 1
                        latencies.append((time.perf_counter() - asked) * 1e3)
                        if pause_s:
                            await asyncio.sleep(max(0.0, asked + pause_s - time.perf_counter()))
                    took, frames = time.perf_counter() - began, len(latencies)
                    await asyncio.sleep(0.3)  # what waits is written
                    times = percentiles(latencies)
                    return frames / took, (process.cpu_s() - cpu_s) * 1e3 / frames, times["p50"] or 0, times["p99"] or 0

                for arm in ARMS:
                    await drive(arm, 1.0)
                for turn in range(rounds):
                    for arm in ARMS if turn % 2 else ARMS[::-1]:
                        measured[arm].append(await drive(arm, seconds))
                await egos["recorded"].close()
                left_out = (await gateway._request("GET", "/metrics")).text
        finally:
            await process.stop()
        nbytes = sum(path.stat().st_size for path in Path(folder, "recordings").iterdir())
    told = "; ".join(line for line in left_out.splitlines() if line.startswith("robosac_unrecorded_frames_total{"))
    return measured, nbytes / numbers["recorded"], told or "nothing was left out"


def main(
    seconds: Annotated[float, typer.Option(help="Of each turn.")] = 5.0,
    rounds: Annotated[int, typer.Option(min=1)] = 4,
    rate: Annotated[
        float, typer.Option(help="Frames a second that are asked for; 0: as fast as they are answered.")
    ] = 0,
) -> None:
    measured, nbytes, told = asyncio.run(measure(seconds, rounds, 1 / rate if rate else 0.0))
    table = trial.a_table(f"{rounds} rounds", ("session", *COLUMNS))
    for arm in ARMS:
        table.add_row(arm, *(shown(median(column), 2) for column in zip(*measured[arm], strict=True)))
    ratios = [
        median(a[i] / b[i] for a, b in zip(measured["recorded"], measured["not recorded"], strict=True))
        for i in range(len(COLUMNS))
    ]
    table.add_row("ratio", *(shown(ratio, 3) for ratio in ratios))
    console = Console()
    console.print(table)
    console.print(f"{nbytes / 1e3:.0f} kB a frame; {told}")


if __name__ == "__main__":
    typer.run(main)
