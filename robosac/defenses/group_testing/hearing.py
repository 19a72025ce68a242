"""What all messages of a frame say: of places, and of where vehicles stand."""

from __future__ import annotations

from collections.abc import Collection
from functools import cached_property

import numpy as np

from robosac.boxes import FloatArray
from robosac.defenses.group_testing.claims import CONFLICT_OWN, DENIES, WEIGHTY, Claims, two_witnesses
from robosac.testimony import Testimony

STANDING_SUM = 10.0
"""A vehicle stands where the sum of L is so much."""
CERTAIN = 4.0
"""From this L on, two teammates or the ego know that a vehicle stands in a place."""
REACH_M = 2.2
"""A box is at a place if it is centred so near."""
APART_M = 3.0
"""Vehicles are so far apart."""
OWN_M = 3.0
"""What is centred so near the ego's sensor is the ego."""
EDGE_M = 1.0
"""What is centred so near the edge of the ego's map may be beyond it."""


class Hearing:
    """What all messages of a frame say, and what decoded fusions are worth by that.

    Parameters
    ----------
    testimony : Testimony
    unheard : collection of str
        Those whose testimony counts for nothing.
    """

    def __init__(self, testimony: Testimony, unheard: Collection[str]) -> None:
        self.everybody = testimony
        self.heard = testimony.of([name for name in testimony.agents if name not in unheard])
        self._said: dict[bytes, dict[str, float]] = {}

    def said(self, place: FloatArray) -> dict[str, float]:
        """What everybody says of a place (2,), heard or not: L by agent."""
        asked = place.tobytes()
        if asked not in self._said:
            self.ask(place[None])
        return self._said[asked]

    def ask(self, places: FloatArray) -> None:
        """Look up at once what everybody says of places (n, 2)."""
        said = self.everybody.likelihood(places).T.tolist()
        for place, by_agent in zip(places, said, strict=True):
            self._said[place.tobytes()] = dict(zip(self.everybody.agents, by_agent, strict=True))

    def alone(self, agent: str, unheard: Collection[str]) -> int:
        """In how many places, `APART_M` apart, an agent sees a vehicle against the word of all who are heard."""
        over, places = self.everybody.over_ego, self.everybody.ego_places()
        index = self.everybody.agents.index(agent)
        rows, columns = np.nonzero(over[index] >= CONFLICT_OWN)
        said = np.minimum(np.maximum(over[:, rows, columns], -WEIGHTY), WEIGHTY)
        supported, _ = Claims(places[rows, columns], self.everybody.agents, said).in_conflict(unheard)
        surest = np.argsort(-over[index, rows, columns], kind="stable")
        return len(_apart(places[rows, columns][surest[supported[index, surest]]]))

    def seen_by(self, agent: str) -> FloatArray:
        """Centres (n, 2) of the vehicles that an agent sees, `APART_M` apart, the surest first."""
        over, places = self.everybody.over_ego[self.everybody.agents.index(agent)], self.everybody.ego_places()
        rows, columns = np.nonzero(over >= CERTAIN)
        surest = np.argsort(-over[rows, columns], kind="stable")
        found = _apart(places[rows, columns][surest])
        return self.everybody.of({agent}).centres(found, np.ones((1, len(found)), dtype=bool))

    def seen_near(self, places: FloatArray) -> FloatArray:
        """Centres (n, 2) of vehicles near places (k, 2) of which somebody is certain, and nobody says the contrary; of
        one vehicle there may be many. At the edge of the ego's map there are none.
        """
        over, cells = self.heard.over_ego, self.heard.ego_places()
        rows, columns = np.nonzero((over >= CERTAIN).any(axis=0) & (over.min(axis=0) > DENIES))
        asked = cells[rows, columns]
        near = np.hypot(*(asked[:, None] - places[None]).transpose(2, 0, 1)).min(axis=1, initial=np.inf) <= REACH_M
        if not near.any():
            return np.zeros((0, 2))
        asked, supporting = asked[near], over[:, rows[near], columns[near]] >= CERTAIN
        centres = self.heard.centres(asked, supporting)
        kept = np.hypot(*(centres[:, None] - places[None]).transpose(2, 0, 1)).min(axis=1) <= REACH_M
        kept &= np.abs(centres).max(axis=1) <= self.heard.half_extent_m - EDGE_M
        found: FloatArray = centres[kept]
        return found

    @cached_property
    def standing(self) -> FloatArray:
        """Centres (k, 2) of vehicles that the ego, or two teammates, know of, and all together without the one who
        denies them most. The surest come first; of one vehicle there may be many.

        What no fusion shows is none of them: the ego itself, which others see, and what is centred at the edge of its
        map or beyond.
        """
        rows, columns = np.nonzero(two_witnesses(self.heard.over_ego >= CERTAIN))
        over = np.minimum(np.maximum(self.heard.over_ego[:, rows, columns], -WEIGHTY), WEIGHTY)
        total = over.sum(axis=0) - np.minimum(over[1:].min(axis=0, initial=0.0), 0.0)
        enough = np.flatnonzero(total >= STANDING_SUM)
        order = enough[np.argsort(-total[enough], kind="stable")]
        places = self.heard.ego_places()[rows[order], columns[order]]
        supporting = over[:, order] >= CERTAIN
        centres = self.heard.centres(places, supporting)
        far, outermost = np.hypot(*centres.T), np.abs(centres).max(axis=1, initial=0.0)
        shown = (far > OWN_M) & (outermost <= self.heard.half_extent_m - EDGE_M)
        standing: FloatArray = centres[shown & (np.hypot(*(centres - places).T) <= REACH_M)]
        return standing


def _apart(places: FloatArray) -> FloatArray:
    """Those of places (n, 2) that are `APART_M` from all that come before."""
    kept = []
    while len(places):
        kept.append(places[0])
        places = places[np.hypot(*(places - places[0]).T) > APART_M]
    return np.array(kept).reshape(-1, 2)
