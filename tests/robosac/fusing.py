"""A detector without a network, and frames fused with it."""

import math
from collections.abc import Collection

import numpy as np

from robosac.answers import Source
from robosac.boxes import pose_matrix
from robosac.deadline import Deadline
from robosac.defenses import Decision, SampleConsensus
from robosac.detectors import DetectorInfo, Message
from robosac.fusion import fuse

EGO = Message(pose_matrix(0, 0, 0, 0), {})
TEAM = dict.fromkeys("abcde", EGO)
SEEN = np.array([[10.0 * i, 5.0, 4.0, 2.0, 0.0, 0.9] for i in range(5)])
NOISE = SEEN + [[3.0, 50.0, 0, 0, 0, 0]]


class FakeDetector:
    """Decodes the same boxes for every clean subset and others for one with an attacker; time passes by its clock."""

    def __init__(self, attackers: Collection[str] = (), pass_s: float = 0.0, broken: str = "") -> None:
        self.info = DetectorInfo("fake", {"ego": {}, "teammate": {}}, (-32, -32, 32, 32), 2.0, "0", 0.5)
        self.attackers = set(attackers)
        self.pass_s = pass_s
        self.broken = broken
        self.now = 0.0
        self.decoded: list[tuple[str, ...]] = []

    def clock(self) -> float:
        return self.now

    def prepare(self, ego, teammates):
        if self.broken == "prepare" and teammates:
            raise RuntimeError("cannot warp")
        return self

    def detect(self, teammates=()):
        if self.broken == "detect" and teammates:
            raise RuntimeError("cannot decode")
        self.now += self.pass_s
        self.decoded.append(tuple(teammates))
        return NOISE if self.attackers & set(teammates) else SEEN


def run(
    detector, defense=SampleConsensus(sampling_budget=7, collaborators=3), team=TEAM, seed=0, due=math.inf, **options
):
    rng = np.random.default_rng(seed)
    return fuse(detector, defense, EGO, team, rng=rng, deadline=Deadline(due, clock=detector.clock), **options)


class Stubborn(SampleConsensus):
    """Answers with what it tested, whatever the verdict."""

    def converse(self, team, state, rng):
        yield [("a", "c")]
        return Decision(("a", "c"), Source.CONSENSUS, dict.fromkeys("bde"), None, state)
