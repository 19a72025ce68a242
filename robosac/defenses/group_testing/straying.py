"""Who moves many vehicles a little: each by less than testimony can place it, all together by more than chance.

One frame cannot tell. What honest messages do to the places of boxes differs from frame to frame, and goes either way.
What an attacker does adds up.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from robosac.boxes import FloatArray
from robosac.defenses.group_testing.differences import same_boxes
from robosac.defenses.group_testing.lies import Rule
from robosac.defenses.group_testing.objects import PLACED_SCORE, SLACK_ACROSS_M, SLACK_ALONG_M, Shown

OWN_WORD = 0.7
"""What it counts where boxes end up by a teammate's own word, beside the word of others. Honest messages pull boxes to
where their senders see the vehicles, be their poses right or wrong.
"""
LEAST_RISE = -1.2
"""Neither word takes off more than this: a message is no better for being wrong about all places alike."""
MOST_RISE = 2.0
"""What a single box counts, at most, in either direction."""
FEW = 4
"""Added to the number of boxes: where there are few, they tell little."""
FEWEST_WITNESSES = 2
"""Boxes count by the word of so many others, at least."""
RULE = Rule(1.0, 1, 0.1, 1.5, ((0.75, 2.0), (1.0, 3.0), (1.5, 4.0)), malice=False)
"""How the levels grow. Nobody is named for it: whoever is late, or wrong about its pose, strays as well."""
HEAD_START = 0.5
"""Whoever was not left out for long begins at this level, so that it is looked at again until it has proved harmless
(Lucas and Crosier, Fast Initial Response for CUSUM Quality-Control Schemes, Technometrics 24, 1982).
"""
MOST_AT_ONCE = 2
"""So many are looked at again in a frame, at most."""


def strays(joined: Shown, without: Shown, suspect: str) -> float:
    """How much farther boxes are from where witnesses see the vehicles than they are without a teammate.

    With d the distance of a box from the median of where those who support it see the vehicle, in units of
    `SLACK_ALONG_M` and `SLACK_ACROSS_M`, a box counts what ``ln(1 + d^2)`` grows by. Of n boxes this is the sum by the
    square root of n + 4: by the word of all others, and .7 of the same by the suspect's own word. For honest messages
    the first is around 0 and the second below; whoever moves boxes against its own word is above in both. One of four
    others that lies about the places moves no median far.

    Boxes of score >= .4 count that are in both fusions, and that two others support there, or the suspect.
    """
    now, before = same_boxes(joined, without, *(shown.boxes[:, 5] >= PLACED_SCORE for shown in (joined, without)))
    centres = (joined.seen.centre[:, now] + without.seen.centre[:, before]) / 2  # not a number where one has none
    own = np.array([name == suspect for name in joined.claims.witnesses])
    boxes, others, total = joined.boxes[now], without.boxes[before], 0.0
    for said, fewest, worth in ((centres[~own], FEWEST_WITNESSES, 1.0), (centres[own], 1, OWN_WORD)):
        counts = (~np.isnan(said[..., 0])).sum(axis=0) >= fewest
        if counts.any():
            rise = _rise(boxes[counts], others[counts], median(said[:, counts]))
            total += worth * max(rise, LEAST_RISE)
    return total


def median(places: FloatArray) -> FloatArray:
    """The median (n, 2) of places (witnesses, n, 2) along each axis, of those that are numbers: at least one."""
    ranked, count = np.sort(places, axis=0), (~np.isnan(places)).sum(axis=0)
    low, high = (np.take_along_axis(ranked, at[None], axis=0)[0] for at in ((count - 1) // 2, count // 2))
    middle: FloatArray = (low + high) / 2
    return middle


def distances(boxes: FloatArray, places: FloatArray, yaws: FloatArray) -> FloatArray:
    """``ln(1 + d^2)`` (n,) of how far boxes (n, 6) are from places (n, 2), along and across headings (n,), in units of
    `SLACK_ALONG_M` and `SLACK_ACROSS_M`.
    """
    cos, sin = np.cos(yaws), np.sin(yaws)
    x, y = (boxes[:, :2] - places).T
    along, across = (x * cos + y * sin) / SLACK_ALONG_M, (y * cos - x * sin) / SLACK_ACROSS_M
    off: FloatArray = np.log1p(along**2 + across**2)
    return off


def _rise(now: FloatArray, before: FloatArray, places: FloatArray) -> float:
    """What `distances` grow by, over boxes (n, 6) of two fusions and the places (n, 2) of their vehicles."""
    off, off_before = (distances(boxes, places, before[:, 4]) for boxes in (now, before))
    grown = np.minimum(np.maximum(off - off_before, -MOST_RISE), MOST_RISE)
    return float(grown.sum() / np.sqrt(len(grown) + FEW))


@dataclass
class Straying:
    """Mutable while a frame is judged."""

    levels: dict[str, tuple[float, float]] = field(default_factory=dict)
    """By teammate: a cumulative sum of what it `strays`, as `RULE` has it, and the highest since it was 0."""
    weights: dict[str, float] = field(default_factory=dict)
    """By teammate: what has been added to the logarithm of the odds that it attacks, since its level was 0."""

    def learn(self, teammate: str, by: float, *, anew: bool) -> float:
        """Take in how much a teammate strays; what new levels add to its suspicion, which takes two frames.

        Parameters
        ----------
        teammate : str
        by : float
            See `strays`.
        anew : bool
            Whether it was not left out for long.
        """
        level, highest = self.levels.pop(teammate, (HEAD_START, 0.0) if anew else (0.0, 0.0))
        level, reached, weight = RULE.after(level, highest, by)
        if level:
            self.levels[teammate] = level, highest if anew else reached
        else:
            self.weights.pop(teammate, None)
        return 0.0 if anew else weight

    def fade(self, teammate: str) -> None:
        """It was not looked at for some frames, so that what is known of it means less. It does not fall to 0: whoever
        is in the answer again is looked at, and what straying has added to its suspicion is still known.
        """
        before, _ = self.levels[teammate]
        level = min(before, round(max(RULE.drift, before - RULE.drift), 4))
        self.levels[teammate] = level, level  # what it adds when it rises again counts anew

    def note(self, teammate: str, weight: float) -> None:
        """Note what has been added to a teammate's suspicion for straying alone."""
        if teammate in self.levels:
            self.weights[teammate] = round(self.weights.get(teammate, 0.0) + weight, 4)

    def without(self, teammate: str, suspicion: float) -> float:
        """A teammate's suspicion as it were without what straying has added."""
        kept = (1.0 - suspicion) * math.exp(self.weights.get(teammate, 0.0))
        return suspicion / (suspicion + kept)

    def rising(self, teammate: str) -> bool:
        """Whether there is so much against a teammate that it adds to suspicion."""
        return self.levels.get(teammate, (0.0, 0.0))[0] >= RULE.weights[0][0]

    def to_be_asked(self, teammates: Iterable[str]) -> list[str]:
        """Who of these is to be left out again, the worst first."""
        straying = [name for name in teammates if name in self.levels]
        return sorted(straying, key=lambda name: -self.levels[name][0])[:MOST_AT_ONCE]

    def forget(self, teammate: str) -> None:
        """It left."""
        self.levels.pop(teammate, None)
        self.weights.pop(teammate, None)

    def to_state(self) -> dict[str, Any]:
        """JSON values that `from_state` reads."""
        return {name: [*pair, self.weights.get(name, 0.0)] for name, pair in self.levels.items()}

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> Straying:
        """What `to_state` wrote."""
        levels = {str(name): (float(level), float(highest)) for name, (level, highest, _) in state.items()}
        return cls(levels, {str(name): float(weight) for name, (_, _, weight) in state.items() if weight})
