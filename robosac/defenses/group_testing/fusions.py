"""The fusions of one frame as they are decoded; and whose messages are late by them, or whether the ego is astray."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from functools import cached_property

import numpy as np

from robosac.boxes import BoolArray, FloatArray, IntArray
from robosac.defenses.group_testing.claims import LEANS, NOT_TOGETHER, SUPPORTS, Claims
from robosac.defenses.group_testing.geometry import WITNESS_SCORE, followed
from robosac.defenses.group_testing.hearing import Hearing
from robosac.defenses.group_testing.knowledge import Knowledge
from robosac.defenses.group_testing.lateness import (
    TURNING,
    WHILE_S,
    Place,
    late,
    lately,
    motions,
    moved_since,
    replayed,
    senders,
    sent,
    turned_since,
)
from robosac.defenses.group_testing.objects import PLACED_SCORE, Shown
from robosac.defenses.group_testing.placing import DOUBTED_M, ego_misplaced, elsewhere, misplaced
from robosac.defenses.protocol import EGO, Hypothesis, Outcome
from robosac.testimony import Testimony

FEWEST_DENIED = 3
"""The ego leans against so many vehicles that others see before it is in doubt itself."""
DENIED = 2
"""Whose message denies so many vehicles may be elsewhere."""
LOST_S, LOST_FRAMES = 1.0, 5
"""Whose message is elsewhere is to blame for nothing so long, and in at least so many frames."""
NOTHING = np.zeros((0, 4))
UNHEARD = 0.9
"""The testimony of those suspected more than this counts for nothing."""


class Fusions:
    """The fusions of one frame.

    Parameters
    ----------
    known : Knowledge
    team : tuple of str
        Teammates present.
    named : collection of str
        Held to be attackers before this frame.

    Attributes
    ----------
    shown : dict of tuple of str to Shown
        By subset decoded: what it shows.
    decoded : set of tuple of str
        All that were.
    hearing : Hearing or None
        What all messages say; None before the first outcome.
    pose : (4, 4) ndarray
        world_from_sensor of the ego.
    number : int
        The frame's, as its outcomes give it.
    """

    def __init__(self, known: Knowledge, team: Hypothesis, named: Collection[str]) -> None:
        self.known = known
        self.team = team
        self.named = frozenset(named)
        self.unheard = {name for name, p in known.suspicion().items() if name in self.named or p > UNHEARD}
        self.unheard |= known.memory.placing.out & set(team)
        self.shown: dict[Hypothesis, Shown] = {}
        self.decoded: set[Hypothesis] = set()
        self.hearing: Hearing | None = None
        self.pose: FloatArray = np.eye(4)
        self.number = 0
        self._testimony: Testimony | None = None
        self._alone: FloatArray | None = None
        self._late: dict[str, bool] = {}

    def learn(self, outcome: Outcome) -> Shown | None:
        """Take in a decoded subset; what it shows is given back, checked, if there is testimony to check it by."""
        self.decoded.add(outcome.teammates)
        if outcome.testimony is None or outcome.boxes is None:
            return None
        if self.hearing is None:
            self._testimony, self.hearing = outcome.testimony, self.hear(outcome.testimony)
            self._alone, self.number = outcome.alone, outcome.frame
        if outcome.pose is not None:
            self.pose = outcome.pose
        shown = self.shown[outcome.teammates] = Shown(outcome.teammates, outcome.boxes, self.hearing)
        return shown

    def hear(self, testimony: Testimony) -> Hearing:
        """Testimony of the frame, without that of an ego whose own message is late."""
        silent = self.known.memory.ego_is_late
        return Hearing(testimony.silenced(EGO) if silent else testimony, self.unheard)

    def heard(self) -> Hearing:
        """What all messages say."""
        if self.hearing is None:
            raise RuntimeError("there is no testimony yet")
        return self.hearing

    @cached_property
    def of_ego(self) -> Shown | None:
        """What the ego shows alone."""
        if self.hearing is None or self._alone is None:
            return None
        return Shown((), self._alone, self.hearing)

    def place(self, answer: Hypothesis) -> None:
        """Learn whose messages are out of place as a whole, by the answer, or else by the largest fusion. Where the ego
        is not where it says, all are.
        """
        if not self.shown:
            return
        everybody, placing = self.heard().everybody, self.known.memory.placing
        shown = self.shown.get(answer) or self.shown[max(self.shown, key=len)]
        placed = shown.boxes[:, 5] >= PLACED_SCORE
        supporting = shown.everybody.supporting[:, placed]
        centres = everybody.sighting(shown.boxes[placed, :2], supporting).centre
        heard = np.array([name not in self.unheard for name in everybody.agents])
        far = misplaced(centres, supporting, everybody.origins, heard).tolist()
        off = {name: by for name, by in zip(everybody.agents, far, strict=True) if not np.isnan(by)}
        self._place_ego(sorted(off.values()))
        found = self._search(shown.boxes[placed, :2], shown.everybody.of_boxes(placed), heard)
        placing.lose(found, max(LOST_FRAMES, round(LOST_S / self.known.period_s)))
        placing.learn({**off, **found}, self.team)

    def _search(self, vehicles: FloatArray, said: Claims, heard: BoolArray) -> dict[str, float]:
        """How far those messages lie from where they should that lie elsewhere as a whole. It is asked of those that
        deny some of the vehicles (n, 2) that the ego or two others see.
        """
        witnesses = said.supporting & heard[:, None]
        shared = witnesses[0] | (witnesses.sum(axis=0) - witnesses >= 2)
        denying = (said.denying & shared).sum(axis=1)
        found, hearing = dict[str, float](), self.heard()
        origins = hearing.everybody.origins
        for index in np.flatnonzero(denying[1:] >= DENIED) + 1:
            name = said.witnesses[index]
            if name in self.named:
                continue
            own, others = hearing.everybody.of({name}), np.delete(origins, index, axis=0)
            far = elsewhere(own, vehicles[shared[index]], hearing.seen_by(name), others)
            lost = self.known.memory.placing.lost
            if (name in lost or not np.isnan(far)) and self._replays(name):
                lost.pop(name, None)
            elif not np.isnan(far) and not self.late(name):
                found[name] = far
        return found

    def _place_ego(self, off: Sequence[float]) -> None:
        """Learn whether the ego itself is not where it says, by how far ``off`` its teammates are, the least first.
        What begins as if it were late is taken for that.
        """
        memory, doubted = self.known.memory, bool(off) and off[(len(off) - 1) // 2] >= DOUBTED_M
        before = memory.placing.ego_astray
        memory.placing.learn_ego(self._ego_off() if doubted else np.nan, differs=self._ego_differs)
        if memory.placing.ego_astray and not before and (memory.ego_is_late or self.ego_late):
            memory.placing.ego_astray = False

    @cached_property
    def senders(self) -> dict[str, Place]:
        """Where in the world each sender is that is known to be somewhere."""
        return {} if self.hearing is None else senders(self.hearing.everybody, self.pose)

    def remember_senders(self) -> None:
        """Let the next frames know where senders were."""
        if self.hearing is not None:
            self.known.memory.senders = sent(self.known.memory.senders, self.senders, self.number, self._lately)

    def _moved(self, sender: str) -> FloatArray | None:
        return moved_since(self.known.memory.senders.get(sender), self.senders.get(sender), self.number, self._lately)

    @property
    def _lately(self) -> int:
        return lately(self.known.period_s)

    def _turned(self, sender: str) -> float:
        """How far a sender has turned in a frame, radians. An ego that had not been turning is not where it says."""
        last = self.known.memory.senders.get(sender)
        turned = turned_since(last, self.senders.get(sender), self.number, self._lately)
        least = TURNING * self.known.period_s / WHILE_S
        return turned if last is None or sender != EGO or last[4] * turned > least**2 else 0.0

    def late(self, sender: str) -> bool:
        """Whether a teammate's message is late: by the vehicles that the largest fusion without it shows, where one is
        decoded, or by those that the ego sees alone, as all others may be late, too.
        """
        if sender not in self._late:
            self._late[sender] = self._fits_beside(late, sender)
        return self._late[sender]

    def _replays(self, sender: str) -> bool:
        """Whether a teammate's message is older than a late one may be, by the same vehicles."""
        return self._fits_beside(replayed, sender)

    @cached_property
    def ego_late(self) -> bool:
        """Whether the ego's own message is late: by vehicles of the largest fusion that more teammates see in one place
        than would lie together. Then every other message seems to be wrong.
        """
        if not self.shown:
            return False
        shown, teammates, told = self._told_by_several()
        centres, agreed = self.heard().everybody.agreed(shown.boxes[told, :2], teammates[:, told])
        return self._fits(late, EGO, shown, told[agreed], centres[agreed])

    @property
    def _ego_differs(self) -> bool:
        """Whether the ego leans against vehicles that more teammates see in one place than would lie together: against
        at least `FEWEST_DENIED`, and with half the sum of L with which it supports others.
        """
        shown, teammates, told = self._told_by_several()
        said = shown.everybody.likelihood[0, told]
        leaning = np.flatnonzero(said <= LEANS)
        if len(leaning) < FEWEST_DENIED:  # as nearly always
            return False
        denied = told[leaning]
        _, agreed = self.heard().everybody.agreed(shown.boxes[denied, :2], teammates[:, denied])
        against, supporting = -said[leaning[agreed]], said[said >= SUPPORTS]
        return len(against) >= FEWEST_DENIED and bool(2.0 * against.sum() >= supporting.sum())

    def _ego_off(self) -> float:
        """How far the ego shows vehicles from where more teammates agree that they are than would lie together, metres;
        not a number where those are too few.
        """
        shown, teammates, told = self._told_by_several()
        told = told[shown.everybody.supporting[0, told]]
        everybody, places = self.heard().everybody, shown.boxes[told, :2]
        centres, agreed = everybody.agreed(places, teammates[:, told])
        ego = np.zeros_like(teammates[:, told])
        ego[0] = True
        return ego_misplaced(everybody.centres(places, ego)[agreed], centres[agreed])

    def _told_by_several(self) -> tuple[Shown, BoolArray, IntArray]:
        """The largest fusion, which teammates (witnesses, n) support its boxes, and the boxes that more of them do than
        would lie together.
        """
        shown = self.shown[max(self.shown, key=len)]
        teammates = shown.everybody.supporting.copy()
        teammates[0] = False
        told = np.flatnonzero((teammates.sum(axis=0) >= NOT_TOGETHER) & (shown.boxes[:, 5] >= WITNESS_SCORE))
        return shown, teammates, told

    def excused(self, sender: str) -> bool:
        """Whether what is wrong about a teammate's message may be because it is late or lies elsewhere as a whole, or
        because the ego's own is late, now or not long ago, or because the ego is not where it says.
        """
        memory = self.known.memory
        at_fault = memory.ego_is_late or self.ego_late or memory.placing.ego_astray
        return at_fault or sender in memory.placing.lost or self.late(sender)

    def _without(self, sender: str) -> Hypothesis:
        without = [fused for fused in self.shown if sender not in fused]
        return max(without or self.shown, key=len, default=())

    def _fits_beside(self, fits: Callable[..., bool], sender: str) -> bool:
        for fused in (self._without(sender), ()):
            shown = self.shown.get(fused) or self.of_ego
            if shown is not None:
                others = shown.everybody.without({sender}).supporting.any(axis=0)
                told = np.flatnonzero(others & (shown.boxes[:, 5] >= WITNESS_SCORE))
                if self._fits(fits, sender, shown, told, shown.boxes[told, :2]):
                    return True
        return False

    def _fits(self, fits: Callable[..., bool], sender: str, shown: Shown, told: IntArray, centres: FloatArray) -> bool:
        """Whether a sender's message is `late`, or `replayed`, by some boxes (n,) of a fusion, of vehicles (n, 2)."""
        memory, own, ego = self.known.memory, self._moved(sender), self._moved(EGO)
        if self._testimony is None or own is None or ego is None:
            return False
        shown_before, since = memory.shown or self.known.shown_before, self.known.frames_since
        largest = max(shown_before.values(), key=len, default=NOTHING)
        before = shown_before.get(self.known.key(shown.teammates), largest)
        moved = motions(followed(shown.boxes[told], self.pose), before, since, self.known.period_s)
        known, turn = ~np.isnan(moved[:, 0]), self.pose[:2, :2]
        centres, moved = centres[known], moved[known] @ turn
        if sender != EGO:  # the ego is a vehicle, too
            centres, moved = np.vstack([centres, np.zeros(2)]), np.vstack([moved, ego @ turn])
        frames = WHILE_S / self.known.period_s
        turned = frames * self._turned(sender)
        return fits(self._testimony, sender, frames * (own @ turn), centres, frames * moved, turned)
