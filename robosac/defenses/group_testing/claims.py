"""What all testimony says of boxes, and of places without one.

A box claims that a vehicle is there. It is checked by what each agent's own message says of the place (`Testimony`).
Whoever may have made the box up cannot speak for it: a claim is denied or supported by the others.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from robosac.boxes import BoolArray, FloatArray
from robosac.testimony import KNOWS, Testimony

SUPPORTS = KNOWS
"""An agent supports a place from this L on."""
NEARLY_SUPPORTS = 2.5
"""From this L on, an agent is the second to support a box, if all but the first support it together."""
DENIES = -KNOWS
"""An agent denies a place from this L on downwards."""
EGO_KNOWS = -6.75
"""Where the ego's own L is so low, whoever supports a vehicle is wrong: nobody else has a part in what the ego saw. But
right behind another vehicle it sees nothing, and its L there may be as low. And where `NOT_TOGETHER` teammates support
one, the ego itself may be late, or see badly.
"""
HIDING_M = 0.5
"""A vehicle hides what is behind it and so much to its sides."""
WEIGHTY = 6.0
"""Testimony of several agents decides from this sum of L on, in either direction."""
BLAMED_SUM, BLAMED_BESIDE = 8.0, 4.0
"""Somebody is to blame for a box that the others contradict with the first sum of L, and with the second one without
the teammate who denies it most.
"""
CONFLICT_OWN, CONFLICT_SUM = 4.5, 10.0
"""L of one, and the sum of all others' the other way, from which on they are in conflict."""
AROUND_M = 0.6
"""L of a box is the greatest within so far along and across of its centre: a place a little off is no denial. Where
another box is beside it, that is not looked for on the other's side: there a witness sees that vehicle.
"""
BESIDE_M = 4.5
"""Two boxes are beside one another if they are centred so near."""
NOT_TOGETHER = 3
"""So many teammates do not lie together, or no more would be left to tell."""
LEANS = -1.0
"""All others lean against a box if the sum of L without those who vouch for it is so low."""
_SAME_M = 1e-3
_PARALLEL = 1e-9
_STEPS = np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])


@dataclass(frozen=True)
class Claims:
    """Boxes, and what each witness says of them."""

    boxes: FloatArray
    """(n, 6): ego frame."""
    witnesses: tuple[str, ...]
    """Whose testimony counts, `robosac.defenses.EGO` first."""
    likelihood: FloatArray
    """(witnesses, n): L of each box."""

    @classmethod
    def of(cls, boxes: FloatArray, heard: Testimony, shown: FloatArray | None = None) -> Claims:
        """Look up boxes (n, 5+), each by itself; or beside others that are ``shown`` (m, 2+), themselves among them."""
        cos, sin = np.cos(boxes[:, 4]), np.sin(boxes[:, 4])
        along, across = np.array([cos, sin]).T, np.array([-sin, cos]).T
        around = boxes[:, :2] + AROUND_M * (_STEPS[:, None, :1] * along + _STEPS[:, None, 1:] * across)
        found = heard.likelihood(around.reshape(-1, 2)).reshape(len(heard.agents), len(_STEPS), len(boxes))
        if shown is not None:
            found[:, _nearer_to_another(around, shown)] = -np.inf
        return cls(boxes, heard.agents, found.max(axis=1))

    def without(self, agents: Collection[str]) -> Claims:
        """The same boxes, and what the other witnesses say of them."""
        others = set(agents)
        kept = [i for i, name in enumerate(self.witnesses) if name not in others]
        if len(kept) == len(self.witnesses):
            return self
        return Claims(self.boxes, tuple(self.witnesses[i] for i in kept), self.likelihood[kept])

    def of_boxes(self, which: BoolArray) -> Claims:
        """Some of the boxes (n,)."""
        return Claims(self.boxes[which], self.witnesses, self.likelihood[:, which])

    @cached_property
    def supporting(self) -> BoolArray:
        """Who (witnesses, n) supports which box."""
        return self.likelihood >= SUPPORTS

    @property
    def denying(self) -> BoolArray:
        """Who (witnesses, n) denies which box."""
        return self.likelihood <= DENIES

    def denied_for_certain(self, others: int) -> BoolArray:
        """Which boxes (n,) the ego denies; or three teammates, or two whom the ego leans to; of fewer ``others`` than
        three, all of them. Two teammates may lie together.
        """
        count = self.denying[1:].sum(axis=0)
        several = (count >= 2) & ((count >= min(NOT_TOGETHER, others)) | (self.likelihood[0] <= LEANS))
        denied: BoolArray = self.denying[0] | several
        return denied

    @cached_property
    def rest(self) -> FloatArray:
        """What the others say of each box (n,): the sum of L without the teammate who supports it, or without the two
        who do most.
        """
        supports = np.sort(np.where(self.supporting[1:], self.likelihood[1:], 0.0), axis=0)
        rest: FloatArray = self.likelihood.sum(axis=0) - supports[-2:].sum(axis=0)
        return rest

    @cached_property
    def beside(self) -> FloatArray:
        """The sum of L of each box (n,) without the teammate who supports it most."""
        most = np.maximum(self.likelihood[1:].max(axis=0, initial=0.0), 0.0)
        beside: FloatArray = self.likelihood.sum(axis=0) - most
        return beside

    def in_conflict(self, unheard: Collection[str]) -> tuple[BoolArray, BoolArray]:
        """Which boxes each witness supports (witnesses, n), and which it denies, against all others that are heard: its
        L is at least 4.5 one way, and the sum of theirs 10 the other. Two that lie together come to more than that, so
        it has to be 3 without the two teammates who oppose it most.
        """
        heard = np.array([name not in unheard for name in self.witnesses])[:, None]
        said = np.where(heard, self.likelihood, 0.0)
        others = said.sum(axis=0) - said
        ranked = np.sort(said[1:], axis=0)
        high, low = np.maximum(ranked[-2:], 0.0).sum(axis=0), np.minimum(ranked[:2], 0.0).sum(axis=0)
        supported = (self.likelihood >= CONFLICT_OWN) & (others <= -CONFLICT_SUM) & (others - low <= DENIES)
        denied = (self.likelihood <= -CONFLICT_OWN) & (others >= CONFLICT_SUM) & (others - high >= SUPPORTS)
        return supported, denied

    def contradicted(self) -> BoolArray:
        """Which boxes (n,) are contradicted, whoever supports them.

        Those with an L of -6.75 or less by the ego are, but for what is behind a vehicle that it sees, or what three
        teammates support. So are those
        that are denied for certain (`denied_for_certain`), if the sum of L without the teammate who supports a box most
        is at most -6. What the ego itself supports is not contradicted.
        """
        return self._contradicted(self.beside <= -WEIGHTY, len(self.witnesses) - 2) & ~self._supported_by_many

    def contradicted_by_others(self, suspects: Collection[str]) -> BoolArray:
        """Which boxes (n,) are so contradicted by all but the suspects that somebody is to blame for them.

        The sum of their L is at most -8, and at most -4 without the teammate who denies a box most: whoever lies may
        deny what another one alone sees, and the ego may lean to it. Two may lie together, however few others are
        heard: to accuse the last honest one, too.
        """
        others = self.without(suspects)
        total = others.likelihood.sum(axis=0)
        most = others.likelihood[1:].min(axis=0, initial=0.0)
        enough = (total <= -BLAMED_SUM) & (total - most <= -BLAMED_BESIDE)
        return others._contradicted(enough, NOT_TOGETHER) & ~self._supported_by_many

    def _contradicted(self, enough: BoolArray, others: int) -> BoolArray:
        """Which boxes (n,) are contradicted where it is ``enough`` (n,), by so many ``others`` besides the ego."""
        denied = enough & self.denied_for_certain(others) & ~self.supporting[0]
        sure: BoolArray = self.likelihood[0] <= EGO_KNOWS
        if sure.any():  # seldom
            sure &= ~self._behind_another()
        known: BoolArray = denied | sure
        return known

    @cached_property
    def _supported_by_many(self) -> BoolArray:
        """Which boxes (n,) more teammates support than would lie together."""
        many: BoolArray = self.supporting[1:].sum(axis=0) >= NOT_TOGETHER
        return many

    def _behind_another(self) -> BoolArray:
        """Which boxes (n,) the ego can only look at through another one, which it supports."""
        others = self.boxes[self.supporting[0]]
        to, cos, sin = self.boxes[:, None, :2], np.cos(others[:, 4]), np.sin(others[:, 4])
        length, width = others[:, 2:4].T / 2 + HIDING_M
        near, far = np.zeros((len(to), len(others))), np.ones((len(to), len(others)))
        for side, x, y in ((length, cos, sin), (width, -sin, cos)):  # a line is inside a box between two pairs of sides
            start, way = -(others[:, 0] * x + others[:, 1] * y), to[..., 0] * x + to[..., 1] * y
            way = np.where(np.abs(way) < _PARALLEL, _PARALLEL, way)
            one, other = (-side - start) / way, (side - start) / way
            near, far = np.maximum(near, np.minimum(one, other)), np.minimum(far, np.maximum(one, other))
        behind: BoolArray = np.logical_or.reduce((near < far) & (far < 1.0), axis=1)
        return behind


def _nearer_to_another(around: FloatArray, shown: FloatArray) -> BoolArray:
    """Which places (k, n) around boxes, given as (k, n, 2) with their centres first, are nearer than these to another
    box beside them, of those shown (m, 2+).
    """
    x, y = (shown[:, axis] - around[0, :, None, axis] for axis in (0, 1))
    apart = x * x + y * y
    own, other = np.nonzero((apart > _SAME_M**2) & (apart <= BESIDE_M**2))
    nearer = np.zeros(around.shape[:2], dtype=bool)
    if len(own):
        x, y = (around[:, own, axis] - shown[other, axis] for axis in (0, 1))
        at, pair = np.nonzero(x * x + y * y < apart[own, other] - _SAME_M)
        nearer[at, own[pair]] = True
    return nearer


def two_witnesses(speaking: BoolArray) -> BoolArray:
    """Which places (n,) the ego, or two teammates, speak of: ``speaking`` (witnesses, n), the ego first."""
    enough: BoolArray = speaking[0] | (np.add.reduce(speaking[1:], axis=0, dtype=np.int16) >= 2)
    return enough


def vouched(supporting: BoolArray, agents: Sequence[str], suspects: Collection[str]) -> BoolArray:
    """Which places (n,) one of the agents supports, ``supporting`` (agents, n), who is no suspect, or two."""
    suspected = set(suspects)
    others = [name not in suspected for name in agents]
    enough: BoolArray = supporting[others].any(axis=0) | (np.add.reduce(supporting, axis=0, dtype=np.int16) >= 2)
    return enough
