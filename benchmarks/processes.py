"""How much more two gateway processes behind HAProxy answer than one: ``python benchmarks/processes.py``.

Both run behind the same proxy, on the same database, under the same load: whole frames in a closed loop. Client, proxy
and gateways share the machine. Where it has fewer cores than all of them need, frames a second say more of the machine
than of the gateways. ``--core 0.25`` gives each gateway process that share of a core and no more (Linux control groups,
as root), so that there is enough for two of them, the proxy and the client. Sessions go where their ids lead: with few
of them one process may have more than the other.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import torch
from rich.console import Console

from clients.client import GatewayClient
from clients.load_test import EGO, TEAM, Bodies, Load, prepare, run_load
from clients.proxied import proxied

CONFIG = Path(__file__).parents[1] / "deploy" / "haproxy.cfg"
KEY = "a-key-of-the-benchmark"
PERIOD_US = 10_000
FRAMES = 8
GROUPS = Path("/sys/fs/cgroup")


@contextlib.contextmanager
def at_most(core: float | None, pids: list[int]) -> Iterator[None]:
    """Give each of these processes no more than a share of a core, for the length of a block."""
    if core is None:
        yield
        return
    old = (GROUPS / "cpu").is_dir()
    groups = [GROUPS / ("cpu" if old else "") / f"robosac-benchmark-{pid}" for pid in pids]
    for group, pid in zip(groups, pids, strict=True):
        group.mkdir()
        if old:
            (group / "cpu.cfs_period_us").write_text(str(PERIOD_US))
            (group / "cpu.cfs_quota_us").write_text(str(round(core * PERIOD_US)))
        else:
            (group / "cpu.max").write_text(f"{round(core * PERIOD_US)} {PERIOD_US}")
        (group / "cgroup.procs").write_text(str(pid))
    try:
        yield
    finally:
        for group in groups:
            for pid in (group / "cgroup.procs").read_text().split():
                (group.parent / "cgroup.procs").write_text(pid)
            group.rmdir()


async def boxes_of(client: GatewayClient, bodies: Bodies, sessions: int) -> list[str]:
    """The boxes of the same frames in each of some sessions without a defence, whose answers depend on nothing else."""
    told = []
    for _ in range(sessions):
        opened = await client.open_session(EGO, TEAM, defense={"kind": "none"}, latency_budget_ms=20_000.0)
        ego = client.vehicle(opened.session_id, EGO, opened.ego_token)
        answers = [await ego.post_frame_body(bodies.numbered(frame)) for frame in range(FRAMES)]
        told.append(json.dumps([answer.boxes.tolist() for answer in answers]))
        await ego.close()
    return told


async def measure(
    processes: int, seconds: float, egos: int, core: float | None, database_url: str | None
) -> dict[str, object]:
    bodies = prepare(False, 3, Console(stderr=True), FRAMES)
    with tempfile.TemporaryDirectory(prefix="robosac-") as name:
        url = database_url or f"sqlite:///{name}/robosac.db"
        async with proxied(CONFIG, Path(name), url, KEY, processes) as gateways, gateways.client() as client:
            before, own = [process.cpu_s() for process in gateways.processes], time.process_time()
            with at_most(core, [process.pid for process in gateways.processes]):
                figures = await run_load(client, Load("closed", egos, False), bodies, seconds, 20_000.0)
            used = [process.cpu_s() - was for process, was in zip(gateways.processes, before, strict=True)]
            boxes = await boxes_of(client, bodies, egos)
            memory = [process.peak_memory_mib() for process in gateways.processes]
            client_s = time.process_time() - own
    told = figures.as_dict()
    return {
        "processes": processes,
        "egos": egos,
        "fps": told["fps"],
        "frames": told["frames"],
        "errors": told["errors"],
        "gateway_cpu_s": used,
        "client_cpu_s": client_s,
        "cpu_ms_a_frame": sum(used) * 1e3 / told["frames"],
        "memory_mib": memory,
        "latency_ms": told["latency_ms"],
        "boxes": boxes,
    }


async def main(seconds: float, egos: int, rounds: int, core: float | None, database_url: str | None) -> None:
    torch.set_num_threads(1)
    found = {1: [], 2: []}
    for _ in range(rounds):  # in turn, as the machine changes its mind
        for processes, results in found.items():
            results.append(await measure(processes, seconds, egos, core, database_url))
            print(json.dumps({name: value for name, value in results[-1].items() if name != "boxes"}), flush=True)
    for name in ("fps", "cpu_ms_a_frame"):
        one, two = (sorted(float(str(result[name])) for result in found[n])[rounds // 2] for n in (1, 2))
        print(f"{name}: 1 process {one:.1f}, 2 processes {two:.1f}, ratio {two / one:.2f}")
    boxes = {text for results in found.values() for result in results for text in result["boxes"]}
    print(
        f"the boxes of {FRAMES} frames are {'equal' if len(boxes) == 1 else 'NOT EQUAL'} in all sessions of all rounds"
    )
    print(f"cores: {os.cpu_count()}, load: {os.getloadavg()[0]:.1f}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--egos", type=int, default=8)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--core", type=float)
    parser.add_argument("--database-url")
    given = parser.parse_args()
    asyncio.run(main(given.seconds, given.egos, given.rounds, given.core, given.database_url))
