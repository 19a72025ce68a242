"""Where a detector decodes several subsets at once, frames that are decided at the same time share passes."""

import asyncio
import math
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

from robosac.deadline import Deadline
from robosac.detectors import EmbeddedDetector
from robosac.detectors.map_fusion import PreparedMaps
from robosac.passes import Pass
from robosac.session import Session, defense_for
from service import jobs
from service.engine import Engine
from service.jobs import HOLD_S, Job, waiting, with_company
from service.turns import Turns, Work

SETTINGS = [
    {"kind": "group_testing"},
    {"kind": "sample_consensus", "sampling_budget": 7, "collaborators": 3, "consensus_threshold": 0.999},
]


class Wide(EmbeddedDetector):
    """The shipped detector in its own place, which decodes several subsets at once."""

    worth = 4


@pytest.fixture
async def engine():
    engine = Engine(1, [f"{__name__}:Wide"])
    await engine.start()
    yield engine
    engine.stop()


@pytest.fixture
def shared(monkeypatch):
    """How many frames, and how many subsets, each pass of several decoded."""
    seen, plain = [], PreparedMaps.detect_together

    def counted(wanted):
        if len(wanted) > 1:
            seen.append((len(wanted), sum(len(subsets) for _, subsets in wanted)))
        return plain(wanted)

    monkeypatch.setattr(PreparedMaps, "detect_together", staticmethod(counted))
    return seen


async def decide_at_once(engine, asked):
    """What comes of frames that are all there before the first of them begins."""
    go = threading.Event()
    held = asyncio.create_task(engine._submit(go.wait))
    await asyncio.sleep(0)
    decisions = [asyncio.create_task(engine.decide(*each[:-1], Deadline(math.inf), work=each[-1])) for each in asked]
    await asyncio.sleep(0.05)
    go.set()
    await held
    return await asyncio.gather(*decisions)


def frames_of(detector, settings, messages):
    """A frame for each of three egos."""
    for number, ego in enumerate(("car-1", "car-2", "car-3")):
        team = {name: message for name, message in messages.items() if name != ego}
        session = Session(detector, list(team), defense_for(settings, detector.info))
        work = Work("key", ego, time.perf_counter() + 60 + number, 0.05)
        yield session, 0, messages[ego], team, 3, work


@pytest.mark.parametrize("settings", SETTINGS, ids=lambda s: s["kind"])
async def test_frames_of_several_sessions_share_passes_and_are_decided_as_alone(
    settings, engine, messages, shared, monkeypatch
):
    monkeypatch.setattr(jobs, "HOLD_S", 10.0)  # however busy this machine is
    detector = engine.detectors["intersection-mean"]
    alone = [
        s.decide(n, ego, team, np.random.default_rng(seed))
        for s, n, ego, team, seed, _ in frames_of(detector, settings, messages)
    ]
    assert shared == []
    asked = list(frames_of(detector, settings, messages))
    decided = await decide_at_once(engine, asked)
    assert max(frames for frames, _ in shared) == 3
    assert max(subsets for _, subsets in shared) > 3
    for each, expected in zip(decided, alone, strict=True):
        result = each.result
        assert result.fault is None
        assert (result.accepted, result.sampling_steps) == (expected.accepted, expected.sampling_steps)
        assert [o.teammates for o in result.hypotheses] == [o.teammates for o in expected.hypotheses]
        np.testing.assert_allclose(result.boxes, expected.boxes, atol=1e-3)
        assert result.timings_ms["ego_only"] > 0
        assert sum(result.timings_ms.values()) <= 1e3 * each.worked_s
    assert all(
        each.worked_s == pytest.approx(work.had_s, rel=0.2) for each, (*_, work) in zip(decided, asked, strict=True)
    )


async def test_if_they_cannot_be_made_together_each_frame_makes_its_own(engine, messages, monkeypatch, caplog):
    monkeypatch.setattr(jobs, "HOLD_S", 10.0)
    plain, tried = PreparedMaps.detect_together, []

    def fails(wanted):
        if len(wanted) > 1:
            tried.append(len(wanted))
            raise RuntimeError("out of memory")
        return plain(wanted)

    monkeypatch.setattr(PreparedMaps, "detect_together", staticmethod(fails))
    detector = engine.detectors["intersection-mean"]
    decided = await decide_at_once(engine, frames_of(detector, SETTINGS[0], messages))
    assert tried
    assert {each.result.fault for each in decided} == {None}
    assert all(len(each.result.boxes) for each in decided)
    assert "could not be made together" in caplog.text


async def test_on_the_processor_no_frame_tells_what_it_will_decode(detector, ego_message, benign):
    session = Session(detector, list(benign), defense_for(SETTINGS[0], detector.info))
    steps = session.decide_in_steps(0, ego_message, benign, np.random.default_rng(0))
    assert set(steps) == {None}


def job(due_s=1.0, coming=True, family="a", came_s=0.0):
    """A frame that is due so long after 0, and whose pass came then."""
    made = Job(Work("key", "session", due_s, 0.01), iter(()), 0.0)
    made.coming = Pass(None, SimpleNamespace(family=family), (), ()) if coming else None
    made.came = came_s
    return made


def test_company_is_of_one_family_and_who_is_due_first_comes_first():
    first, late, soon = job(3.0), job(2.0), job(1.0)
    all_of_them = [first, late, job(0.5, family="b"), job(0.5, coming=False), soon]
    assert with_company(first, all_of_them, 0.0) == [first, soon, late]
    assert with_company(all_of_them[3], all_of_them, 0.0) == [all_of_them[3]]
    assert with_company(soon, all_of_them, 0.995) == [soon]  # it has no time for others


def test_a_pass_waits_for_others_that_are_on_their_way():
    held, other = job(), job(coming=False)
    assert waiting([held, other], HOLD_S / 2) == {held.work}
    assert waiting([held, other], HOLD_S * 1.1) == set()
    assert waiting([held, job()], HOLD_S / 2) == set()  # nobody else is on the way


def test_it_does_not_wait_if_its_frame_has_no_time():
    assert waiting([job(due_s=0.012), job(coming=False)], 0.0) == set()
    assert waiting([job(due_s=0.015), job(coming=False)], 0.0) != set()


def test_turns_pass_over_work_that_waits():
    turns, (first, second) = Turns(), (Work("key", "a", 1.0, 0.01), Work("key", "b", 2.0, 0.01))
    turns.add(first)
    turns.add(second)
    assert turns.next(0.0) is first
    assert turns.next(0.0, {first}) is second
