"""What is remembered of each teammate's lies about objects, and when they are too many for chance."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from robosac.boxes import FloatArray
from robosac.defenses.group_testing.claims import NOT_TOGETHER
from robosac.defenses.protocol import EGO


@dataclass(frozen=True)
class Rule:
    """How often an honest teammate may seem to lie in one way.

    In each frame a level goes up by ``gain`` for each lie, of which at most ``most`` count, and down by ``drift``; it
    is never below 0 (a cumulative sum: Page, Continuous Inspection Schemes, Biometrika 41, 1954), nor above
    `MOST_LEVEL` times ``names``: whoever lied for long is as soon trusted again as whoever lied for seconds.
    """

    gain: float
    most: int
    drift: float
    names: float
    """Level from which on it is named, if it is named for this at all."""
    weights: tuple[tuple[float, float], ...]
    """At each of these levels, when first reached, the logarithm of the likelihood ratio that it adds to suspicion."""
    malice: bool = True
    """Whether somebody is named for it; else it has innocent causes, too."""
    times: int | None = None
    """One place counts so often in `PLACE_FRAMES` frames, as an honest mistake about one thing stays where it is; None:
    always. A lie that the sender's own message tells, too, counts always (`objects.Lie.said`).
    """

    def after(self, level: float, highest: float, count: float) -> tuple[float, float, float]:
        """A level after a frame with so many lies, the highest since it was 0, and what new steps add to suspicion."""
        level = max(0.0, level + self.gain * min(count, self.most) - self.drift)
        level = min(level, MOST_LEVEL * self.names)
        weight = sum(w for step, w in self.weights if highest < step <= level)
        return round(level, 4), round(max(level, highest), 4) if level else 0.0, weight


RULES: Mapping[str, Rule] = {
    "ghost": Rule(1.5, 1, 0.5, 3.0, ((1.0, 5.0), (2.0, 2.0), (3.0, 3.0))),
    "gone": Rule(1.5, 1, 0.5, 3.0, ((1.0, 2.5), (2.0, 3.0), (3.0, 4.0)), times=2),
    "moved": Rule(1.0, 1, 0.3, 2.0, ((0.7, 2.0), (1.4, 3.0), (2.1, 4.0)), times=2),
    "reshaped": Rule(1.0, 1, 0.3, 2.0, (), malice=False),
    "late": Rule(1.0, 1, 0.3, 2.0, ((0.7, 2.0), (1.4, 3.0), (2.1, 4.0)), malice=False),
    "alone": Rule(1.0, 1, 0.3, 2.0, (), malice=False),  # one word against one
    "veiled": Rule(1.25, 1, 0.5, 3.0, ((0.75, 2.5), (1.5, 2.5), (2.25, 4.0)), times=2),
    "conflict": Rule(1.0, 3, 0.5, 6.0, ((3.0, 2.0), (4.5, 4.0), (6.0, 4.0)), times=3),
    "unseen": Rule(1.0, 3, 0.5, 6.0, ((3.0, 2.0), (4.5, 4.0), (6.0, 4.0)), malice=False, times=3),
}
MOST_LEVEL = 1.5
QUIET_FRAMES = 9
LONGEST_QUIET = 24
"""A place where something seemed wrong, but nobody had the effect, is left alone for so many frames, at first and at
most.
"""
RECENT_FRAMES = 3
"""Who was left out in so many frames is left out after the others."""
QUIET_M = 3.0
"""Places nearer than this are one, metres."""
MOST_QUIET = 32
AUDIT_FRAMES = 40
"""After so many frames a teammate of the answer is left out again, to see what it does."""
SEARCHED_FRAMES = 25
"""So long a place is not searched again."""
PLACE_FRAMES = 50
"""See `Rule.times`."""
SPARED_FRAMES = 10
"""So long nobody is asked again whether a lie shows only beside it."""


class Word(Enum):
    """What it is worth that some say of a teammate that it lies."""

    GOOD = "good"
    DOUBTFUL = "doubtful"
    """Nobody is named for it."""
    NOTHING = "nothing"


@dataclass
class Lies:
    """Mutable while a frame is judged."""

    levels: dict[str, dict[str, tuple[float, float]]] = field(default_factory=dict)
    """By teammate and kind: the level, and the highest since it was 0."""
    quiet: list[tuple[float, float, int, int]] = field(default_factory=list)
    """Places left alone: x, y (world, metres), the frame of the session until which, and for how many frames."""
    places: dict[str, dict[str, list[tuple[float, float, int, int]]]] = field(default_factory=dict)
    """By teammate and kind: where it told a lie: x, y (world, metres), the frame of the session in which it first
    counted, and how often it has counted since.
    """
    left_out: dict[str, int] = field(default_factory=dict)
    """By teammate: the frame of the session in which something was wrong, and an answer was last decoded without it."""
    audited: dict[str, int] = field(default_factory=dict)
    """By teammate: the frame in which it was last left out of a fusion of enough others to tell what it does."""
    accusers: dict[str, dict[str, int]] = field(default_factory=dict)
    """By teammate: who said that it moves or reshapes vehicles, and how often."""
    effects: dict[str, int] = field(default_factory=dict)
    """By teammate: the frame of the session in which it last did something to an object of a fusion, went with what was
    wrong in an answer, or saw what nobody else did and denied what all others saw.
    """
    searched: list[tuple[float, float, int]] = field(default_factory=list)
    """Places where a vehicle vanished, and everybody was left out to see who took it away: x, y (world, metres), the
    frame of the session.
    """

    spared: dict[str, dict[str, dict[str, int]]] = field(default_factory=dict)
    """By teammate and kind: without whom a lie that nobody else tells was still there, and without it not; the frame of
    the session in which that was seen last.
    """

    def spare(self, teammate: str, kind: str, others: Collection[str], frame: int) -> None:
        """A lie of a teammate is there without these others, too."""
        self.spared.setdefault(teammate, {}).setdefault(kind, {}).update(dict.fromkeys(sorted(others), frame))

    def not_spared(self, teammate: str, kind: str, others: Collection[str], frame: int) -> set[str]:
        """Of the others those beside whom alone a teammate's lies may show, for all that was seen lately."""
        known = self.spared.get(teammate, {}).get(kind, {})
        return {name for name in others if frame - known.get(name, -SPARED_FRAMES) >= SPARED_FRAMES}

    def recently_left_out(self, teammate: str, frame: int) -> bool:
        """Whether it was left out in this frame or one just before."""
        return frame - self.left_out.get(teammate, -RECENT_FRAMES) < RECENT_FRAMES

    def hear(self, teammate: str, by: Sequence[str], others: int) -> Word:
        """What the word of some against a teammate is worth; it is remembered that they said so.

        Two may lie together. So it is good if the ego is among them, or if they are three, or if anybody is among them
        but the two who have said such things most often. Else it is doubtful where one of them says so for the first
        time, and worth nothing where not. Of fewer ``others`` than three nobody would be left, so it is good; and so is
        what is by nobody.
        """
        if not by:
            return Word.GOOD
        said = self.accusers.setdefault(teammate, {})
        before = sorted(said, key=lambda name: (-said[name], name))
        for name in by:
            said[name] = said.get(name, 0) + 1
        often = before[:2] if len(before) >= 2 else by[:2]
        if EGO in by or others < NOT_TOGETHER or not set(by) <= set(often):
            return Word.GOOD
        return Word.NOTHING if set(by) <= set(before) else Word.DOUBTFUL

    def add(self, teammate: str, counts: Mapping[str, int]) -> float:
        """Take in the lies of a frame by kind; what new levels add to the teammate's suspicion."""
        if teammate not in self.levels and not any(counts.values()):
            return 0.0
        known = self.levels.setdefault(teammate, {})
        weight = 0.0
        for kind, rule in RULES.items():
            level, highest, added = rule.after(*known.pop(kind, (0.0, 0.0)), counts.get(kind, 0))
            weight += added
            if level:
                known[kind] = level, highest
        if not known:
            del self.levels[teammate]
        return weight

    def counting(
        self, teammate: str, kind: str, places: Sequence[FloatArray], frame: int, times: int | None = None
    ) -> int:
        """How many of the places (2,), world, of a teammate's lies of a kind in this frame count; see `Rule.times`,
        which ``times`` is in the stead of. They are known from now on, of new ones as many as count in a frame.
        """
        rule = RULES[kind]
        times = rule.times if times is None else times
        if times is None:
            return len(places)
        fresh = {
            each: [entry for entry in entries if frame - entry[2] < PLACE_FRAMES]
            for each, entries in self.places.pop(teammate, {}).items()
        }
        known, count = fresh.pop(kind, []), 0
        for place in places:
            at = next((i for i, (x, y, _, _) in enumerate(known) if _near(x, y, place)), None)
            if at is not None:
                x, y, first, told = known[at]
                if told < times:
                    known[at] = (x, y, first, told + 1)
                    count += 1
            elif count < rule.most:
                known.append((round(float(place[0]), 2), round(float(place[1]), 2), frame, 1))
                count += 1
        fresh = {each: entries for each, entries in {**fresh, kind: known[-MOST_QUIET:]}.items() if entries}
        if fresh:
            self.places[teammate] = fresh
        return count

    def worst(self, teammate: str) -> float:
        """The level of the kind nearest to being named for, as a share, whether or not somebody is named for it."""
        known = self.levels.get(teammate)
        return max(level / RULES[k].names for k, (level, _) in known.items()) if known else 0.0

    def doubted(self, teammate: str) -> bool:
        """Whether it seemed to lie lately, by more than one word against its own."""
        return any(kind != "alone" for kind in self.levels.get(teammate, ()))

    def guilt(self, teammate: str, frame: int) -> float:
        """The same of the kinds that somebody is named for: at 1 it is. It takes more words of which nothing came for
        long: a sensor may be mounted as no other is.
        """
        words = frame - self.effects.get(teammate, -PLACE_FRAMES) >= PLACE_FRAMES
        most = {kind: rule.names for kind, rule in RULES.items() if rule.malice}
        most["conflict"] *= MOST_LEVEL if words else 1.0
        known = self.levels.get(teammate, {}).items()
        return max((level / most[kind] for kind, (level, _) in known if kind in most), default=0.0)

    def is_quiet(self, place: FloatArray, frame: int) -> bool:
        """Whether a place (2,), world, is left alone."""
        return any(until >= frame and _near(x, y, place) for x, y, until, _ in self.quiet)

    def leave_alone(self, place: FloatArray, frame: int) -> None:
        """Leave a place (2,), world, alone for some frames: each time for twice as many."""
        before = [entry for entry in self.quiet if _near(entry[0], entry[1], place)]
        frames = min(LONGEST_QUIET, max((2 * entry[3] for entry in before), default=QUIET_FRAMES))
        others = [e for e in self.quiet if e not in before and frame - e[2] <= LONGEST_QUIET][-MOST_QUIET + 1 :]
        self.quiet = [*others, (round(float(place[0]), 2), round(float(place[1]), 2), frame + frames, frames)]

    def search(self, place: FloatArray, frame: int) -> bool:
        """Whether to look for who took a vehicle away from a place (2,), world: not where that was done lately."""
        self.searched = [entry for entry in self.searched if 0 <= frame - entry[2] < SEARCHED_FRAMES]
        if any(_near(x, y, place) for x, y, _ in self.searched):
            return False
        self.searched = [
            *self.searched[-MOST_QUIET + 1 :],
            (round(float(place[0]), 2), round(float(place[1]), 2), frame),
        ]
        return True

    def forget(self, teammate: str) -> None:
        """It left."""
        self.levels.pop(teammate, None)
        self.places.pop(teammate, None)
        self.left_out.pop(teammate, None)
        self.audited.pop(teammate, None)
        self.accusers.pop(teammate, None)
        self.effects.pop(teammate, None)
        self.spared.pop(teammate, None)
        for others in (*self.accusers.values(), *(of for kinds in self.spared.values() for of in kinds.values())):
            others.pop(teammate, None)

    def to_state(self) -> dict[str, Any]:
        """JSON values that `from_state` reads."""
        return {
            "levels": {name: {kind: list(pair) for kind, pair in of.items()} for name, of in self.levels.items()},
            "quiet": [list(entry) for entry in self.quiet],
            "places": {
                name: {kind: [list(entry) for entry in entries] for kind, entries in of.items()}
                for name, of in self.places.items()
            },
            "left_out": self.left_out,
            "audited": self.audited,
            "accusers": self.accusers,
            "effects": self.effects,
            "searched": [list(entry) for entry in self.searched],
            "spared": self.spared,
        }

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> Lies:
        """What `to_state` wrote."""
        return cls(
            {name: {kind: (float(a), float(b)) for kind, (a, b) in of.items()} for name, of in state["levels"].items()},
            [(float(x), float(y), int(until), int(frames)) for x, y, until, frames in state["quiet"]],
            {
                str(name): {
                    kind: [(float(x), float(y), int(first), int(told)) for x, y, first, told in entries]
                    for kind, entries in of.items()
                }
                for name, of in state.get("places", {}).items()  # not in the states of older versions
            },
            {str(name): int(frame) for name, frame in state["left_out"].items()},
            {str(name): int(frame) for name, frame in state.get("audited", {}).items()},  # nor are these
            {
                str(name): {str(other): int(count) for other, count in by.items()}
                for name, by in state.get("accusers", {}).items()
            },
            {str(name): int(frame) for name, frame in state.get("effects", {}).items()},
            [(float(x), float(y), int(frame)) for x, y, frame in state.get("searched", ())],
            {
                str(name): {kind: {str(other): int(at) for other, at in of.items()} for kind, of in kinds.items()}
                for name, kinds in state.get("spared", {}).items()
            },
        )


def _near(x: float, y: float, place: FloatArray) -> bool:
    return math.hypot(x - place[0], y - place[1]) < QUIET_M
