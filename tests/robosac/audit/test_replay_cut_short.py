"""Decisions that the deadline cut short, made again."""

import dataclasses
import math
import sys
import time
from types import ModuleType, SimpleNamespace

import pytest

from robosac.audit import replay
from tests.robosac.audit.test_replay import BUDGET_MS, drive, told


class Tiring:
    """The shipped detector; after so many passes the next one takes longer than the frame has."""

    def __init__(self, detector):
        self.detector, self.info = detector, dataclasses.replace(detector.info, name="tiring")
        self.passes_left = math.inf  # until the gateway has warmed up

    def __getattr__(self, name):
        return getattr(self.detector, name)

    def prepare(self, ego, teammates):
        prepared = self.detector.prepare(ego, teammates)
        return SimpleNamespace(detect=lambda subset=(): self.detect(prepared, subset))

    def detect(self, prepared, subset):
        if self.passes_left == 0:
            time.sleep(BUDGET_MS / 1e3)
        self.passes_left -= 1
        return prepared.detect(subset)


@pytest.mark.parametrize("after", [0, 2])
async def test_a_decision_cut_short_comes_out_the_same(after, detector, ego_message, attacked, monkeypatch):
    """The pass of the ego, or the one after so many hypotheses, takes all the time."""
    module = ModuleType("tired")
    module.detector = Tiring(detector)
    module.build = lambda: module.detector
    monkeypatch.setitem(sys.modules, "tired", module)

    def tire():
        module.detector.passes_left = after

    options = {"detector": "tiring", "latency_budget_ms": BUDGET_MS, "gather_ms": 0}
    defense = {"kind": "a2cp", "consensus_threshold": 1.0}
    frames = [(0, ego_message, attacked)]
    got = await drive(frames, serving={"extra_detectors": "tired:build"}, ready=tire, defense=defense, **options)
    answer = replay.find(got.lines, 0).answer
    assert (answer.out_of_time, len(answer.hypotheses)) == (True, after)
    assert got.differences(0, detector) == []
    assert "hypotheses" in told(got, detector, out_of_time=False)
