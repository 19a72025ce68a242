"""What the defence keeps from frame to frame besides the posterior: tests and what they showed, evidence, who left."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np

from robosac import decimals
from robosac.boxes import FloatArray
from robosac.defenses.group_testing.lateness import Sent
from robosac.defenses.group_testing.lies import Lies
from robosac.defenses.group_testing.placing import Placing
from robosac.defenses.group_testing.steadiness import Steadiness
from robosac.defenses.group_testing.strangeness import Strangeness
from robosac.defenses.group_testing.straying import Straying
from robosac.defenses.group_testing.vigilance import Vigilance

REPEAT_MEMORY = 60
"""Frames after which a test counts as new."""
EGO_REPEAT = 0.95
PAIR_REPEAT = 0.9
CHANGE_REPEAT = 0.5
"""A test made k frames ago repeats its bias: made again, it weighs 1 - rho ** k. What changed since the frame before is
mostly new.
"""
KEPT_ITEMS = 12
"""Pieces of evidence kept of one teammate, the strongest."""
WORTH_KEEPING = 0.5
"""Evidence that moves a teammate's log-odds by less is not kept."""
FORGETTING_FRAMES = 1500.0
"""What was known of a teammate that left fades by a factor e in this many frames: five minutes at 5 Hz."""
MAX_LEFT = 256
"""Teammates remembered after they left, the latest."""
KeyArray = np.ndarray[tuple[Any, ...], np.dtype[np.uint64]]
_SPREAD_BY = 0x9E3779B97F4A7C15
_SPREAD = np.uint64(_SPREAD_BY)


@lru_cache(maxsize=4096)
def identity(name: str) -> int:
    """A teammate as 64 bits; a subset is the sum of its members, modulo 2 ** 64."""
    return int.from_bytes(hashlib.blake2b(name.encode(), digest_size=8).digest(), "little")


def key(a: int, d: int) -> int:
    """As `keys`, of one test."""
    return (a * _SPREAD_BY + d) % 2**64


def keys(a: KeyArray, d: KeyArray) -> KeyArray:
    """Keys (n,) of tests of subsets ``a`` beside which ``d`` joined (``a`` 0: the ego alone); all uint64."""
    with np.errstate(over="ignore"):
        return a * _SPREAD + d


def _boxes(kept: Any) -> FloatArray:
    """Boxes (n, 4) as they are kept; older versions kept lists of numbers."""
    return (decimals.from_text(kept) if isinstance(kept, str) else np.asarray(kept, dtype=np.float64)).reshape(-1, 4)


def _sent(kept: Sequence[float], state: Mapping[str, Any]) -> Sent:
    """Where a sender was as it is kept. Older versions kept nothing of how it turns, or those of the latest frame alone
    and without its number.
    """
    x, y, *others = kept
    if len(others) < 3:
        return float(x), float(y), int(others[0] if others else state.get("shown_in", 0)), None, 0.0
    number, yaw, turned = others
    return float(x), float(y), int(number), float(yaw), float(turned)


LATE_FRAMES = 5
"""An ego that was late is late for so many frames: a scanner's delay stays, and not every frame shows it."""


@dataclass(frozen=True)
class Left:
    """What was known of a teammate when it left."""

    suspicion: float
    frame: int
    named: bool
    levels: Mapping[str, tuple[float, float]]
    """See `Lies.levels`."""

    def to_state(self) -> list[Any]:
        """JSON values that `from_state` reads."""
        return [self.suspicion, self.frame, self.named, {kind: list(pair) for kind, pair in self.levels.items()}]

    @classmethod
    def from_state(
        cls, suspicion: float, frame: int, named: bool = False, levels: Mapping[str, Sequence[float]] | None = None
    ) -> Left:
        """What `to_state` wrote; older versions wrote only the first two."""
        known = {kind: (float(level), float(highest)) for kind, (level, highest) in (levels or {}).items()}
        return cls(float(suspicion), int(frame), named, known)


@dataclass
class Memory:
    """Mutable while a frame is judged."""

    frame: int = 0
    """Frames judged before this one, in this session."""
    tests: dict[int, tuple[int, int]] = field(default_factory=dict)
    """By test: when it was made last, as (frame, sign); the sign says whether it spoke for an attacker."""
    evidence: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    """By teammate: what spoke for or against those under suspicion; JSON values."""
    left: dict[str, Left] = field(default_factory=dict)
    """By teammate: what was known of those who left."""
    shown: dict[int, FloatArray] = field(default_factory=dict)
    """By the sum of its identities: what each subset decoded in the latest frame showed (n, 4), see
    `geometry.followed`.
    """
    shown_in: int = 0
    """That frame's number, as its outcomes gave it."""
    senders: dict[str, Sent] = field(default_factory=dict)
    """Of each that sent a message lately; see `lateness.sent`."""
    ego_late: int | None = None
    """The latest frame in which the ego's own message was late."""
    hurried: bool = False
    """Whether that frame had time for one pass alone, and another was worth it."""
    lies: Lies = field(default_factory=Lies)
    """About objects."""
    straying: Straying = field(default_factory=Straying)
    placing: Placing = field(default_factory=Placing)
    vigilance: Vigilance = field(default_factory=Vigilance)
    steadiness: Steadiness = field(default_factory=Steadiness)
    strangeness: Strangeness = field(default_factory=Strangeness)

    @property
    def ego_is_late(self) -> bool:
        """Whether the ego's own message was late not long ago."""
        return self.ego_late is not None and self.frame - self.ego_late <= LATE_FRAMES

    @property
    def trust(self) -> float:
        """Weight of evidence from whole fusions that speaks against anybody."""
        return 0.0 if self.placing.ego_astray else self.steadiness.trust

    def weights(self, tests: KeyArray, rho: float) -> FloatArray:
        """Expected weights of tests (n,): ``1 - rho ** k`` if a test was made k frames ago already, else 1."""
        worth = np.ones(len(tests))
        for index, key in enumerate(tests.tolist()):
            if key in self.tests:
                worth[index] = 1.0 - rho ** (self.frame - self.tests[key][0])
        return worth

    def weigh(self, test: int, rho: float, sign: int) -> float:
        """Note a test, and give its weight: 1, or less if it repeats an earlier test and speaks for the same side.

        Parameters
        ----------
        test : int
            Its key.
        rho : float
        sign : int
            +1 if the outcome speaks for an attacker, -1 if against.
        """
        frame, before = self.tests.get(test, (0, 0))
        self.tests[test] = (self.frame, sign)
        return 1.0 if sign != before else 1.0 - float(rho ** (self.frame - frame))

    def add_evidence(self, teammate: str, item: Mapping[str, Any]) -> None:
        """Keep a piece of evidence, if it is among the strongest."""
        items = [*self.evidence.get(teammate, ()), dict(item)]
        if len(items) > KEPT_ITEMS:
            items.remove(min(items, key=lambda i: abs(i["log_likelihood_ratio"])))
        self.evidence[teammate] = items

    def forget_evidence(self, cleared: Collection[str]) -> None:
        """Drop the evidence on those no longer under suspicion."""
        self.evidence = {name: items for name, items in self.evidence.items() if name not in cleared}

    def subsets_against(self, teammate: str) -> int:
        """Different tested subsets that speak against a teammate."""
        against = [i for i in self.evidence.get(teammate, ()) if i["log_likelihood_ratio"] > 0]
        return len({tuple(sorted([*i["teammates"], *i.get("joining", ())])) for i in against})

    def leave(self, teammate: str, suspicion: float, named: bool) -> None:
        """Remember who left, and whether it was named."""
        levels = self.lies.levels.get(teammate, {})
        self.evidence.pop(teammate, None)
        self.lies.forget(teammate)
        self.straying.forget(teammate)
        self.placing.forget(teammate)
        self.steadiness.levels.pop(teammate, None)
        self.senders.pop(teammate, None)
        self.left[teammate] = Left(suspicion, self.frame, named, levels)
        while len(self.left) > MAX_LEFT:  # not by their order, which a state that was stored has lost
            del self.left[min(self.left, key=lambda name: (self.left[name].frame, name))]

    def welcome(self, teammate: str, prior: float) -> tuple[float | None, bool]:
        """Suspicion of one that joins, and whether it was named: None if it was never here, else what is left of what
        was known. So it is with its lies.
        """
        if teammate not in self.left:
            return None, False
        left = self.left.pop(teammate)
        kept = math.exp(-(self.frame - left.frame) / FORGETTING_FRAMES)
        if left.levels:
            self.lies.levels[teammate] = {
                kind: (round(level * kept, 4), round(highest * kept, 4))
                for kind, (level, highest) in left.levels.items()
            }
        return prior + (left.suspicion - prior) * kept, left.named

    def to_state(self) -> dict[str, Any]:
        """JSON values that `from_state` reads; tests too long ago are left out."""
        return {
            "frame": self.frame,
            "tests": {f"{k:016x}": [f, s] for k, (f, s) in self.tests.items() if self.frame - f <= REPEAT_MEMORY},
            "evidence": self.evidence,
            "left": {name: left.to_state() for name, left in self.left.items()},
            "shown": {f"{key:016x}": decimals.as_text(boxes.ravel(), 6) for key, boxes in self.shown.items()},
            "shown_in": self.shown_in,
            "senders": {name: list(place) for name, place in self.senders.items()},
            "ego_late": self.ego_late,
            "hurried": self.hurried,
            "lies": self.lies.to_state(),
            "straying": self.straying.to_state(),
            "placing": self.placing.to_state(),
            "vigilance": self.vigilance.to_state(),
            "steadiness": self.steadiness.to_state(),
            "strangeness": self.strangeness.to_state(),
        }

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> Memory:
        """What `to_state` wrote."""
        return cls(
            frame=int(state["frame"]),
            tests={int(key, 16): (int(f), int(s)) for key, (f, s) in state["tests"].items()},
            evidence={name: [dict(item) for item in items] for name, items in state["evidence"].items()},
            left={name: Left.from_state(*of) for name, of in state["left"].items()},
            # none of them is in the states of older versions
            shown={int(key, 16): _boxes(kept) for key, kept in state.get("shown", {}).items()},
            shown_in=int(state.get("shown_in", 0)),
            senders={name: _sent(kept, state) for name, kept in state.get("senders", {}).items()},
            ego_late=state.get("ego_late"),
            hurried=bool(state.get("hurried", False)),
            lies=Lies.from_state(state["lies"]) if "lies" in state else Lies(),
            straying=Straying.from_state(state.get("straying", {})),
            placing=Placing.from_state(state.get("placing", {})),
            vigilance=Vigilance.from_state(state.get("vigilance", ())),
            steadiness=Steadiness.from_state(state["steadiness"]) if "steadiness" in state else Steadiness(),
            strangeness=Strangeness.from_state(state.get("strangeness", ())),
        )
