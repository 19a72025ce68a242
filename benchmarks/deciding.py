"""What a frame of group testing spends beside the decoder, in decoder passes: testimony, tests of messages, deciding,
storing.

One thread; validation scenes, nobody attacks, after the first frames of each session. A scene has five teammates; more
of them send what one of these sends, with noise. Storing is into a SQLite file, and ends with what is committed.
"""

import argparse
import asyncio
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from audit_records import event, like

from robosac.audit.events import SessionEnded, now
from robosac.defenses.group_testing import GroupTestingSettings
from robosac.detectors import load
from robosac.evaluation.frames import encode_all
from robosac.scenes import IntersectionScene
from robosac.session import Session, defense_for
from service.keeping.record import SessionRecord, new_seed
from service.keeping.store import Store
from service.runtime import keep_what_is_loaded, tune_process

FIRST_SCENE = 1600
LEARNING = 5
"""Frames of a session before it is measured."""


async def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=3)
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--teammates", type=int, default=5)
    options = parser.parse_args()
    tune_process()  # as a gateway does: else each frame's maps are faulted in anew
    torch.set_num_threads(1)
    parts: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        store = Store(f"sqlite:///{Path(folder) / 'sessions.db'}")
        await store.start()
        load()
        keep_what_is_loaded()
        for number in range(FIRST_SCENE, FIRST_SCENE + options.scenes):
            await play(number, options.frames, options.teammates, store, parts)
        await store.close()
    unit = float(np.median(parts["one decoder pass"]))
    for name, values in parts.items():
        median = float(np.median(values))
        print(f"{name}: {median:.2f} ms, {median / unit:.2f} passes")


async def play(number: int, frames: int, teammates: int, store: Store, parts: dict[str, list[float]]) -> None:
    """A session on one scene; what its frames spend is added to the parts, milliseconds."""
    detector, rng = load(), np.random.default_rng(number)
    scene = IntersectionScene(number)
    ego_id, team = scene.egos[0], sorted(set(scene.agents) - {scene.egos[0]})
    more = [f"more-{i:03d}" for i in range(teammates - len(team))]
    session = Session(detector, [*team, *more], defense_for(GroupTestingSettings(), detector.info), rng=rng)
    record = await opened(store, str(number), ego_id, [*team, *more])
    for index in range(frames):
        messages = encode_all(detector, scene.frame(index))
        ego = messages.pop(ego_id)
        messages |= {name: like(messages[team[i % len(team)]], rng) for i, name in enumerate(more)}
        prepared = detector.prepare(ego, messages)
        started = time.perf_counter()
        prepared.detect(team)
        decode = (time.perf_counter() - started) * 1e3
        before, started = session.previous, time.perf_counter()
        result = session.answer(index, ego, messages)
        whole = (time.perf_counter() - started) * 1e3
        told = event(result, index, ego, messages, None if before is None else before.frame, signed=False)
        started = time.perf_counter()
        record = await store.decide(record, told, new_seed())
        storing = (time.perf_counter() - started) * 1e3
        if index >= LEARNING:
            spent = dict(result.timings_ms)
            spent["deciding"] = whole - sum(spent.values())
            spent["deciding and storing"] = spent["deciding"] + storing
            for name, milliseconds in {"one decoder pass": decode, **spent, "storing": storing}.items():
                parts.setdefault(name, []).append(milliseconds)


async def opened(store: Store, session_id: str, ego_id: str, team: list[str]) -> SessionRecord:
    """A session in the store."""
    record = SessionRecord(
        session_id=session_id,
        ego_id=ego_id,
        teammates=tuple(team),
        detector="",
        defense={},
        latency_budget_ms=100.0,
        gather_ms=50.0,
        frame_period_ms=200.0,
        token_ids={},
        created_at=now(),
        seed=new_seed(),
    )
    return await store.create(record, SessionEnded(why="none"))  # which event begins a log makes no difference


if __name__ == "__main__":
    asyncio.run(main())
