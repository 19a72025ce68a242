"""What a fusion does to single objects, checked by testimony: ghosts, objects gone, objects moved.

Whole fusions can look honest while one object is false. So each box of a fusion is checked by what the messages say of
its place, each by itself, and so are places where the messages say that a vehicle stands and the fusion shows none.
What is wrong there is blamed on a teammate only if it is not so in the same fusion without it: that takes both
witnesses and an effect.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

import numpy as np

from robosac.boxes import BoolArray, FloatArray, IntArray, pairwise_iou
from robosac.defenses.group_testing.claims import DENIES, NOT_TOGETHER, SUPPORTS, Claims, two_witnesses, vouched
from robosac.defenses.group_testing.hearing import REACH_M, Hearing
from robosac.defenses.protocol import Hypothesis
from robosac.testimony import Sighting

SHOWN_SCORE = 0.3
"""Boxes from this score on claim something. Fainter ones are as good as none: whoever dims a vehicle takes it away."""
CRISP_SCORE = 0.5
"""Nobody is to blame for boxes below this score: a detector makes many of them up by itself."""
PLACED_SCORE = 0.4
"""Boxes from this score on have to be in their place."""
SURE_SCORE = 0.9
"""A fusion is sure of a box of this score or more. Of such a vehicle somebody has seen something."""
RIM_M = 1.2
"""A place so near a box belongs to it."""
AWAY = 2.5
"""A box is out of place if it is so many times farther from where witnesses see the vehicle than they may err."""
IN_PLACE = 1.5
"""A box is in its place if it is at most so many times farther from where witnesses see it than they may err."""
ELSEWHERE = 2.0
"""A witness sees the vehicle of a box elsewhere if that is so many times farther away than the witness may err."""
SLACK_ALONG_M = 0.25
SLACK_ACROSS_M = 0.2
"""Added to what a witness says it may err: senders are not quite where they say, nor are boxes where all is honest."""
_LOWEST = 0.05
T = TypeVar("T")


@dataclass(frozen=True)
class Lie:
    """Something wrong with one object in a fusion."""

    kind: str
    """``ghost``, ``gone``, ``moved`` or ``reshaped``."""
    place: FloatArray
    """(2,): ego frame, metres."""
    veiled: bool = False
    """Whether the message of whoever is behind it says the contrary of what it does: that a ghost is none, or that a
    vehicle that it removes is there.
    """
    along: bool = False
    """Whether a message that is late may be behind it: a vehicle is moved along itself only, many are a little, or the
    message is known to be late.
    """
    alone: bool = False
    """Whether a single witness supports the vehicle that is gone: one word against one."""
    said: bool = False
    """Whether the message of whoever is behind it says so, too: that a vehicle that it removes is not there."""
    by: Hypothesis = ()
    """Who says that a vehicle is moved or reshaped, or sees the one that is gone."""

    @property
    def counts_as(self) -> str:
        """What it is counted as, see `lies.RULES`."""
        if self.along:
            return "late"
        if self.alone:
            return "alone"
        return "veiled" if self.veiled else self.kind


class Shown:
    """A decoded fusion, checked.

    Parameters
    ----------
    teammates : tuple of str
        Who is fused.
    boxes : (n, 6) ndarray
        Ego frame.
    hearing : Hearing
        Of the frame.
    """

    def __init__(self, teammates: Hypothesis, boxes: FloatArray, hearing: Hearing) -> None:
        self.teammates = teammates
        self.boxes = boxes
        self._hearing = hearing
        self._testimony = hearing.heard
        self.everybody = Claims.of(boxes, hearing.everybody, boxes[boxes[:, 5] >= SHOWN_SCORE])
        """What everybody says of the boxes, heard or not."""
        self.claims = self.everybody.without(set(hearing.everybody.agents) - set(hearing.heard.agents))
        self._beside: WeakKeyDictionary[Shown, dict[Any, Any]] = WeakKeyDictionary()
        self._medians: dict[tuple[frozenset[str], bool], tuple[FloatArray, IntArray]] = {}

    def of_ego(self, boxes: FloatArray) -> Shown:
        """What the ego alone shows in the same frame, checked."""
        return Shown((), boxes, self._hearing)

    def beside(self, other: Shown, compare: Callable[[Shown, Shown], T]) -> T:
        """What comes of comparing this fusion with another one; it is worked out once. It must not hold the other."""
        known = self._beside.setdefault(other, {})
        if compare not in known:
            known[compare] = compare(self, other)
        found: T = known[compare]
        return found

    def overlap(self, other: Shown) -> FloatArray:
        """IoU (n, m) of the boxes with those of another fusion; nobody may write to it."""
        return self.beside(other, _overlap)

    @cached_property
    def seen(self) -> Sighting:
        """Where each witness sees the vehicle of each box; not a number where it does not support the box."""
        return self._testimony.sighting(self.boxes[:, :2], self.claims.supporting)

    @cached_property
    def _away(self) -> FloatArray:
        """How far (2, witnesses, n) each box is along and across itself from where a witness sees the vehicle, in units
        of what it may err; not a number where it does not support the box.
        """
        seen = self.seen
        off = seen.centre - self.boxes[None, :, :2]
        cos, sin = np.cos(self.boxes[:, 4]), np.sin(self.boxes[:, 4])
        along, across = off[..., 0] * cos + off[..., 1] * sin, off[..., 1] * cos - off[..., 0] * sin
        return np.abs([along / (seen.along + SLACK_ALONG_M), across / (seen.across + SLACK_ACROSS_M)])

    @cached_property
    def _farther_away(self) -> FloatArray:
        """The greater (witnesses, n) of the two."""
        farther: FloatArray = self._away.max(axis=0)
        return farther

    def away(self, suspects: Collection[str] = (), *, across: bool = False) -> FloatArray:
        """How far (n,) each box is from where witnesses see it, in either direction or ``across`` itself, the lower
        median of at least two; 0 with fewer. The suspects are no witnesses.
        """
        middle, seeing = self._median_away(suspects, across=across)
        return np.where(seeing >= 2, middle, 0.0)

    def accusers(self, index: int, suspects: Collection[str]) -> Hypothesis:
        """Who but the suspects sees a vehicle elsewhere than a box is."""
        away = self._farther_away[:, index].tolist()  # not a number where nothing is seen
        said = zip(self.claims.witnesses, away, strict=True)
        return tuple(name for name, far in said if far > IN_PLACE and name not in suspects)

    @cached_property
    def seen_elsewhere(self) -> BoolArray:
        """Who (witnesses, n), of at least two that see the vehicle of a box, sees it elsewhere; nobody where the ego
        sees it in the box's place, or more teammates do than would lie together.
        """
        away = self._farther_away
        placed = away <= IN_PLACE  # what is not a number is neither
        settled = placed[0] | (np.add.reduce(placed[1:], axis=0, dtype=np.int16) >= NOT_TOGETHER)
        several = np.add.reduce(self.claims.supporting, axis=0, dtype=np.int16) >= 2
        elsewhere: BoolArray = (away >= ELSEWHERE) & several & ~settled
        return elsewhere

    def in_place(self, joining: Collection[str]) -> BoolArray:
        """Which boxes (n,) stand where those who are not among the joining see a vehicle, by their lower median."""
        middle, _ = self._median_away(joining)
        placed: BoolArray = middle <= IN_PLACE
        return placed

    def _median_away(self, suspects: Collection[str], *, across: bool = False) -> tuple[FloatArray, IntArray]:
        """The lower median (n,) of all but the suspects of how far away each box is, infinite where none of them sees
        it; and how many (n,) do.
        """
        asked = frozenset(suspects), across
        if asked not in self._medians:
            others = [name not in asked[0] for name in self.claims.witnesses]
            away = (self._away[1] if across else self._farther_away)[others].T
            seeing: IntArray = np.add.reduce(~np.isnan(away), axis=1)
            away = np.sort(away, axis=1)  # what is not a number comes last
            middle: FloatArray = away[np.arange(len(self.boxes)), np.maximum(seeing - 1, 0) // 2]
            self._medians[asked] = np.where(seeing > 0, middle, np.inf), seeing
        return self._medians[asked]

    def own(self, suspects: Sequence[str]) -> FloatArray:
        """What the suspects' own messages say of each box: (suspects, n)."""
        own: FloatArray = self.everybody.likelihood[[self.everybody.witnesses.index(name) for name in suspects]]
        return own

    def goes_with(self, suspect: str, lie: Lie) -> bool:
        """Whether a suspect's own message says what a lie says."""
        return suspect in self.going_with(lie)

    def going_with(self, lie: Lie) -> Hypothesis:
        """Those whose own messages say what a lie says."""
        said = self._hearing.said(lie.place).items()
        if lie.kind == "gone":
            return tuple([name for name, at in said if at <= DENIES])
        return tuple([name for name, at in said if at >= SUPPORTS])

    @cached_property
    def on_nobodys_word(self) -> BoolArray:
        """Boxes (n,) that the fusion is sure of, though nobody supports them, heard or not; none while some messages
        are unread.
        """
        if self._hearing.everybody.unread:
            return np.zeros(len(self.boxes), dtype=bool)
        nobodys: BoolArray = (self.boxes[:, 5] >= SURE_SCORE) & ~self.everybody.supporting.any(axis=0)
        return nobodys

    @cached_property
    def contradicted(self) -> BoolArray:
        """Boxes (n,) that are contradicted by those who are heard, or on nobody's word."""
        return self.claims.contradicted() | self.on_nobodys_word

    @cached_property
    def ghosts(self) -> BoolArray:
        """Boxes (n,) that are shown and contradicted."""
        return self.contradicted & (self.boxes[:, 5] >= SHOWN_SCORE)

    @cached_property
    def displaced(self) -> BoolArray:
        """Boxes (n,) that are out of place."""
        return (self.away() >= AWAY) & (self.boxes[:, 5] >= PLACED_SCORE) & ~self.ghosts

    @cached_property
    def holes(self) -> FloatArray:
        """Places (k, 2) where a vehicle stands by testimony, and nothing is shown."""
        left = self._hearing.standing
        left, found = left[~self._covered(left)], []
        while len(left):
            found.append(left[0])
            left = left[np.hypot(*(left - left[0]).T) > REACH_M]
        return np.array(found).reshape(-1, 2)

    def missing_near(self, places: FloatArray) -> FloatArray:
        """Centres (n, 2) of vehicles near places (k, 2) of which somebody is certain, and of which nothing is shown."""
        near = self._hearing.seen_near(places)
        missing: FloatArray = near[~self._covered(near)]
        return missing

    def stands(self, places: FloatArray) -> BoolArray:
        """Whether a vehicle stands at places (n, 2) by the word of somebody who is not among those fused, or of two."""
        return vouched(self._testimony.likelihood(places) >= SUPPORTS, self._testimony.agents, self.teammates)

    def vouched(self, joining: Hypothesis) -> BoolArray:
        """Which boxes (n,) somebody supports who is not among the joining, or two: nothing that one has made up."""
        return vouched(self.claims.supporting, self.claims.witnesses, joining)

    @cached_property
    def lies(self) -> list[Lie]:
        """All that somebody may be to blame for."""
        ghosts = [Lie("ghost", box[:2]) for box in self.boxes[self.ghosts] if box[5] >= CRISP_SCORE]
        moved = [Lie("moved", box[:2]) for box in self.boxes[self.displaced]]
        if len(self.holes):
            self._hearing.ask(self.holes)
        return ghosts + moved + [Lie("gone", place) for place in self.holes]

    def odds_at(self, places: FloatArray) -> FloatArray:
        """Logarithm of the odds (n,) of the best box at each place (n, 2)."""
        score = np.maximum(self.boxes[:, 5], _LOWEST)
        x, y = places[:, :1] - self.boxes[:, 0], places[:, 1:] - self.boxes[:, 1]
        near = np.hypot(x, y) <= REACH_M
        best = np.where(near, score, _LOWEST).max(axis=1, initial=_LOWEST)
        best = np.minimum(best, 1 - 1e-6)
        odds: FloatArray = np.log(best / (1 - best))
        return odds

    def _covered(self, places: FloatArray) -> BoolArray:
        """Whether places (n, 2) lie in boxes that are shown, or beside them; before and behind them only if the ego or
        two teammates support the box: else it may be that vehicle, shown where it is not.
        """
        shown = self.boxes[:, 5] >= SHOWN_SCORE
        boxes, known = self.boxes[shown], two_witnesses(self.claims.supporting[:, shown])
        length = np.where(known, boxes[:, 2] / 2 + RIM_M, np.maximum(boxes[:, 2] / 2, REACH_M))
        x, y = places[:, :1] - boxes[:, 0], places[:, 1:] - boxes[:, 1]
        cos, sin = np.cos(boxes[:, 4]), np.sin(boxes[:, 4])
        along, across = x * cos + y * sin, y * cos - x * sin
        inside = (np.abs(along) <= length) & (np.abs(across) <= boxes[:, 3] / 2 + RIM_M)
        covered: BoolArray = np.atleast_1d(inside.any(axis=1))
        return covered


def _overlap(one: Shown, other: Shown) -> FloatArray:
    return pairwise_iou(one.boxes, other.boxes)
