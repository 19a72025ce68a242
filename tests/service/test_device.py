"""An engine whose detectors compute elsewhere than on the processor."""

import math

import numpy as np
import pytest

from robosac.deadline import Deadline
from robosac.session import Session, defense_for
from service import engine as engines
from service.engine import Engine
from tests.robosac.detectors.elsewhere import elsewhere
from tests.service.conftest import serve

SETTINGS = [{"kind": "group_testing"}, {"kind": "sample_consensus", "collaborators": 3}]


@pytest.mark.parametrize(("settings", "begun"), [*zip(SETTINGS, (True, False), strict=True)], ids=["begun", "whole"])
async def test_frames_are_decided_there_as_here(settings, begun, detector, ego_message, attacked):
    team = list(attacked)
    here = Session(detector, team, defense_for(settings, detector.info))
    expected = here.decide(0, ego_message, attacked, np.random.default_rng(3))
    on_its_thread = elsewhere()  # a mode of torch's holds on one thread
    engine = Engine(1, device="elsewhere")
    with elsewhere():
        await engine._submit(on_its_thread.__enter__)
        await engine.find_device()
        await engine.start()
        far = engine.detectors["intersection-mean"]
        session, ahead = Session(far, team, defense_for(settings, far.info)), None
        if begun:
            started = engine.begin(session, ego_message)
            for name, message in attacked.items():
                started.add(name, message)
            await engine._submit(started.end)
            ahead = started.ahead
        decided = await engine.decide(session, 0, ego_message, attacked, 3, Deadline(math.inf), ahead=ahead)
        await engine._submit(lambda: on_its_thread.__exit__(None, None, None))
    engine.stop()
    result = decided.result
    assert (far.info.device, result.fault) == ("elsewhere", None)
    assert (result.accepted, result.sampling_steps) == (expected.accepted, expected.sampling_steps)
    assert len(result.boxes) > 0
    np.testing.assert_allclose(result.boxes, expected.boxes, atol=1e-3)


async def test_every_detector_is_loaded_for_the_device_that_is_set(monkeypatch):
    asked = []

    def load(name, device):
        asked.append((name, device))
        return plain(name, device)

    plain = engines.load
    monkeypatch.setattr(engines, "load", load)
    async with serve(device="cpu:0", extra_detectors="intersection-mean@bfloat16"):
        assert asked == [("intersection-mean@bfloat16", "cpu:0"), ("intersection-mean", "cpu:0")]
