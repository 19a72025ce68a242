"""What is left of a frame once its last message is there, when it was begun before, against one decode."""

from __future__ import annotations

import time

import numpy as np
from speed import v2xsim
from speed.embedded import frame
from speed.turns import Part, Row, row

from robosac.ahead import Ahead
from robosac.defenses import EGO, SampleConsensus
from robosac.detectors import Detector, Message
from robosac.session import Session

DECODE = "one decode"
TEXT = """Sample consensus with one hypothesis of all five teammates, in process. A frame can be begun before its last
message is there (`robosac.ahead`): then only fusion, decoding and comparison are left."""


def part(turns: int) -> Part:
    """Measure it."""
    found = _measured("embedded", *frame(), turns) + _measured("V2X-Sim layout", *v2xsim.frame(), turns)
    return Part("After the last message", TEXT, found)


def _measured(name: str, detector: Detector, ego: Message, teammates: dict[str, Message], turns: int) -> list[Row]:
    team = sorted(teammates)
    defense = SampleConsensus(sampling_budget=1, collaborators=len(team))
    prepared = detector.prepare(ego, teammates)

    def answer(ahead: Ahead | None) -> None:
        Session(detector, team, defense, screening=None).answer(0, ego, teammates, detector=ahead)

    from_first, from_last = f"{name}: a frame, from its first message", f"{name}: a frame, from its last message"
    work = {DECODE: lambda _: prepared.detect(team), from_first: answer, from_last: answer}
    times: dict[str, list[float]] = {label: [] for label in work}
    for turn in range(turns + 1):
        for label, function in work.items():
            ahead = _begun(detector, ego, teammates) if label == from_last else None
            began = time.process_time()
            function(ahead)
            if turn:
                times[label].append(time.process_time() - began)
    base = float(np.median(times[DECODE]))
    return [row(label, times[label], base, f"{DECODE} of that detector") for label in (from_first, from_last)]


def _begun(detector: Detector, ego: Message, teammates: dict[str, Message]) -> Ahead:
    """A frame of which all messages were there some time ago."""
    ahead = Ahead(detector, ego)
    ahead.see_alone()
    ahead.read(EGO, ego)
    for name, message in teammates.items():
        ahead.lay(name, message)
        ahead.read(name, message)
    return ahead
