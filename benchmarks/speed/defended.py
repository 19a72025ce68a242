"""Frames under a defence against undefended ones, with more teammates, and with a message that floods."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from speed.embedded import enlarged, flooding, sequence
from speed.turns import Part, Row, row

from robosac.defenses import A2CP, DefenseSettings, SampleConsensus, StaticTeam, Undefended
from robosac.defenses.group_testing import GroupTestingSettings
from robosac.evaluation.frames import EvaluationFrame
from robosac.session import Session, defense_for

LEARNING = 6
"""Frames of a session before it is measured."""
NONE = "no defence"
KINDS: dict[str, DefenseSettings] = {
    NONE: Undefended(),
    "static team, in frames without a re-check": StaticTeam(attacker_ratio=0.2, recheck_every=None),
    "sample consensus, three of five": SampleConsensus(attacker_ratio=0.2, sampling_budget=7, collaborators=3),
    "A2CP": A2CP(),
    "group testing": GroupTestingSettings(),
    "group testing without judging objects": GroupTestingSettings(judge_objects=False),
}
TEAMS = (5, 10, 20, 50)
TEXT = f"""A session of the embedded detector in process, messages at hand, from its {LEARNING + 1}th frame on;
processor time of a frame, tests of messages and testimony included. The undefended frame fuses everybody in one
pass. The attacker is one of five, by PGD."""
GROWING = """The same with more teammates: a scene has five, and the others send what one of these sends, with noise."""
FLOODED = """One of five teammates sends a message that makes as many boxes as it can, by gradient ascent, with values
up to the largest that honest ones hold. The session has no defence and no tests of messages: it is always fused."""


def parts(turns: int) -> list[Part]:
    """Measure them."""
    quiet, attacked = sequence(0), sequence(1)
    spent = _spent({**_over("", quiet), **_over(", one attacker", attacked)}, turns)
    base = float(np.median(spent[NONE]))
    found = [row(name, times, base, f"{NONE}, nobody attacks") for name, times in spent.items() if name != NONE]
    rate = Row("frames a second without a defence, one thread", 0.0, 1 / base, 0.0, "this machine")
    tested = Row("frames a second of group testing", 0.0, 1 / float(np.median(spent["group testing"])), 0.0, rate.of)
    return [
        Part("Frames under a defence", TEXT, [*found, rate, tested]),
        Part("More teammates", GROWING, _grown(turns)),
        Part("A flooded frame", FLOODED, _flooded(turns)),
    ]


Kind = tuple[DefenseSettings, Sequence[EvaluationFrame], bool]


def _over(name: str, frames: Sequence[EvaluationFrame]) -> dict[str, Kind]:
    return {kind + name: (settings, frames, True) for kind, settings in KINDS.items()}


def _spent(kinds: dict[str, Kind], turns: int) -> dict[str, list[float]]:
    """Seconds of processor time of frames of each kind; all kinds take turns, frame by frame."""
    times: dict[str, list[float]] = {name: [] for name in kinds}
    for turn in range(max(1, turns // 5)):
        sessions = {name: _session(*kind, seed=turn) for name, kind in kinds.items()}
        for index in range(min(len(frames) for _, frames, _ in kinds.values())):
            for name, (_, frames, _) in kinds.items():
                met = frames[index]
                began = time.process_time()
                sessions[name].answer(index, met.ego, met.teammates)
                if index >= LEARNING:
                    times[name].append(time.process_time() - began)
    return times


def _session(settings: DefenseSettings, frames: Sequence[EvaluationFrame], screened: bool, seed: int) -> Session:
    detector = frames[0].detector
    defense = defense_for(settings, detector.info)
    screening = "calibrated" if screened else None
    return Session(detector, sorted(frames[0].teammates), defense, rng=np.random.default_rng(seed), screening=screening)


def _grown(turns: int) -> list[Row]:
    rng = np.random.default_rng(1)
    teams = {
        size: [replace(met, teammates=enlarged(met.teammates, size, rng)) for met in sequence(0)] for size in TEAMS
    }
    kinds: dict[str, Kind] = {}
    for size, frames in teams.items():
        for name in (NONE, "group testing"):
            kinds[f"{name}, {size} teammates"] = (KINDS[name], frames, True)
    spent = _spent(kinds, turns)
    of = f"{NONE}, {TEAMS[0]} teammates"
    base = float(np.median(spent[of]))
    return [row(name, times, base, of) for name, times in spent.items() if name != of]


def _flooded(turns: int) -> list[Row]:
    frames = sequence(0)
    name = sorted(frames[0].teammates)[0]
    flood = [replace(met, teammates=flooding(met, name)) for met in frames]
    normal = "a normal frame"
    spent = _spent({normal: (Undefended(), frames, False), "a flooded frame": (Undefended(), flood, False)}, turns)
    found = {
        kind: np.mean([len(met.detector.prepare(met.ego, met.teammates).detect(sorted(met.teammates))) for met in of])
        for kind, of in (("normal", frames), ("flooded", flood))
    }
    boxes = float(found["flooded"] / found["normal"])
    rows = [row("a flooded frame", spent["a flooded frame"], float(np.median(spent[normal])), normal)]
    return [*rows, Row("boxes in it", boxes, boxes, boxes, "those in a normal frame")]
