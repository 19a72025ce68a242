"""What is found out about the objects of one frame, as its subsets are decoded."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from functools import cached_property

import numpy as np

from robosac.boxes import BoolArray, FloatArray, IntArray
from robosac.defenses.group_testing.claims import LEANS, NOT_TOGETHER, SUPPORTS
from robosac.defenses.group_testing.differences import SAME_LIE_M, effects, gone
from robosac.defenses.group_testing.geometry import WITNESS_SCORE, followed, gone_since
from robosac.defenses.group_testing.hearing import REACH_M, Hearing
from robosac.defenses.group_testing.knowledge import Knowledge
from robosac.defenses.group_testing.lateness import Place, late, motions, moved_since, senders, sent
from robosac.defenses.group_testing.lies import Lies
from robosac.defenses.group_testing.objects import Lie, Shown
from robosac.defenses.group_testing.placing import ego_misplaced
from robosac.defenses.group_testing.shapes import BLAMING, agreeing, reshaped, to_ask
from robosac.defenses.protocol import EGO, Difference, Hypothesis, Outcome
from robosac.testimony import Testimony

CALM = 0.5
"""From here on the ego counts as steady."""
DONE = {"ghost": "invented", "gone": "removed", "moved": "displaced", "reshaped": "reshaped"}
"""What was done to an object, by the kind of a lie."""
FEWEST_DENIED = 3
"""The ego leans against so many vehicles that others see before it is in doubt itself."""
NOTHING = np.zeros((0, 4))
UNHEARD = 0.9
"""The testimony of those suspected more than this counts for nothing."""


class Findings:
    """The objects of one frame while it is judged.

    Parameters
    ----------
    known : Knowledge
    lies : Lies
        Changed in place.
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
    differences : list of Difference
        What somebody is to blame for.
    """

    def __init__(self, known: Knowledge, lies: Lies, team: Hypothesis, named: Collection[str]) -> None:
        self.known = known
        self.lies = lies
        self.team = team
        self.named = frozenset(named)
        self.unheard = {name for name, p in known.suspicion().items() if name in self.named or p > UNHEARD}
        self.unheard |= known.memory.placing.out & set(team)
        self.shown: dict[Hypothesis, Shown] = {}
        self.decoded: set[Hypothesis] = set()
        self.hearing: Hearing | None = None
        self.pose: FloatArray = np.eye(4)
        self.number = 0
        self.differences: list[Difference] = []
        self._testimony: Testimony | None = None
        self._alone: FloatArray | None = None
        self._gone: dict[tuple[Hypothesis, Hypothesis], FloatArray] = {}
        self._late: dict[str, bool] = {}
        self._effects: dict[tuple[Hypothesis, Hypothesis, Hypothesis], list[Lie]] = {}
        self._shapes: dict[tuple[Hypothesis, Hypothesis, Hypothesis], list[list[int]]] = {}

    def learn(self, outcome: Outcome) -> Shown | None:
        """Take in a decoded subset; what it shows is given back, checked, if there is testimony to check it by."""
        self.decoded.add(outcome.teammates)
        if outcome.testimony is None or outcome.boxes is None:
            return None
        if self.hearing is None:
            self._testimony = outcome.testimony
            silent = self.known.memory.ego_is_late
            self.hearing = Hearing(outcome.testimony.silenced(EGO) if silent else outcome.testimony, self.unheard)
            self._alone, self.number = outcome.alone, outcome.frame
        if outcome.pose is not None:
            self.pose = outcome.pose
        shown = self.shown[outcome.teammates] = Shown(outcome.teammates, outcome.boxes, self.hearing)
        return shown

    @property
    def calm(self) -> bool:
        """Whether the ego is about as steady as where the detector was calibrated."""
        return self.known.memory.steadiness.calm >= CALM

    def unexplained(self, answer: Hypothesis) -> list[Lie]:
        """What is wrong in the answer and not remembered as nobody's, and in no decoded fusion without one of them, or
        without all that vouch for it, is put right.
        """
        lies = self.lies_in(answer)
        if not lies:
            return lies
        parts: dict[Hypothesis, Hypothesis] = {(name,): part for name, part in one_out(answer, self.shown).items()}
        for group in sorted({self.vouching(answer, lie) for lie in lies} - {()}):
            parts[group] = tuple(name for name in answer if name not in group)
        for group, without in parts.items():
            if lies and without in self.shown:
                done = self.effects(answer, without, group)
                lies = [a for a in lies if all(np.hypot(*(a.place - b.place)) > SAME_LIE_M for b in done)]
        return lies

    def effects(self, joined: Hypothesis, without: Hypothesis, suspects: Hypothesis) -> list[Lie]:
        """What is wrong in a fusion, and is not in one without the suspects; both are decoded."""
        asked = joined, without, suspects
        if asked not in self._effects:
            self._effects[asked] = effects(self.shown[joined], self.shown[without], suspects)
        boxes = self.shown[joined].boxes
        # not kept, as others may be asked for the shapes later
        return self._effects[asked] + [
            Lie("reshaped", boxes[index, :2], by=by)
            for index, _, by in self.reshaped(joined, without, suspects)
            if len(by) >= BLAMING
            and all(np.hypot(*(lie.place - boxes[index, :2])) > SAME_LIE_M for lie in self._effects[asked])
        ]

    def reshaped(
        self, joined: Hypothesis, without: Hypothesis, suspects: Hypothesis
    ) -> list[tuple[int, int, Hypothesis]]:
        """Vehicles that have another shape in a fusion than without the suspects, and the other one by the word of
        some: their boxes in both, and who they are.
        """
        found = []
        for index, at in self._other_shapes(joined, without, suspects):
            now, before = self.shown[joined].boxes[index], self.shown[without].boxes[at]
            alone = {name: self.shown[(name,)].boxes for name in without if (name,) in self.shown}
            if by := agreeing(now, before, alone if self._alone is None else {EGO: self._alone, **alone}):
                found.append((index, at, by))
        return found

    def to_ask(self, answer: Hypothesis) -> Iterator[str]:
        """Who is to be asked alone for the shape of a vehicle that has another one without one of those fused."""
        for name, without in one_out(answer, self.shown).items():
            for _, at in self._other_shapes(answer, without, (name,)):
                yield from to_ask(self.shown[without], at)

    def _other_shapes(self, joined: Hypothesis, without: Hypothesis, suspects: Hypothesis) -> list[list[int]]:
        """Boxes of two decoded fusions that show one vehicle in different shapes: pairs of their places."""
        asked = joined, without, suspects
        if asked not in self._shapes:
            self._shapes[asked] = reshaped(self.shown[joined], self.shown[without], suspects).T.tolist()
        return self._shapes[asked]

    @cached_property
    def senders(self) -> dict[str, Place]:
        """Where in the world each sender is that is known to be somewhere."""
        return {} if self.hearing is None else senders(self.hearing.everybody, self.pose)

    def remember_senders(self) -> None:
        """Let the next frames know where senders were."""
        if self.hearing is not None:
            self.known.memory.senders = sent(self.known.memory.senders, self.senders, self.number)

    def _moved(self, sender: str) -> FloatArray | None:
        return moved_since(self.known.memory.senders.get(sender), self.senders.get(sender), self.number)

    def late(self, sender: str) -> bool:
        """Whether a teammate's message is late: by the vehicles that the largest fusion without it shows, where one is
        decoded, or by those that the ego sees alone, as all others may be late, too.
        """
        if sender not in self._late:
            self._late[sender] = self._late_beside(sender, self._without(sender)) or self._late_beside(sender, ())
        return self._late[sender]

    @cached_property
    def ego_late(self) -> bool:
        """Whether the ego's own message is late: by vehicles of the largest fusion that more teammates see in one place
        than would lie together. Then every other message seems to be wrong.
        """
        if not self.shown:
            return False
        shown, teammates, told = self._told_by_several()
        centres, agreed = self.heard().everybody.agreed(shown.boxes[told, :2], teammates[:, told])
        return self._fits_late(EGO, shown, told[agreed], centres[agreed])

    @property
    def ego_differs(self) -> bool:
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

    def ego_off(self) -> float:
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
        """Whether what is wrong about a teammate's message may be because it is late, or because the ego's own is, now
        or not long ago, or because the ego is not where it says.
        """
        memory = self.known.memory
        return self.late(sender) or memory.ego_is_late or self.ego_late or memory.placing.ego_astray

    def _without(self, sender: str) -> Hypothesis:
        without = [fused for fused in self.shown if sender not in fused]
        return max(without or self.shown, key=len, default=())

    def _late_beside(self, sender: str, fused: Hypothesis) -> bool:
        shown = self.shown.get(fused) or self._of_ego
        if shown is None:
            return False
        others = shown.everybody.without({sender}).supporting.any(axis=0)
        told = np.flatnonzero(others & (shown.boxes[:, 5] >= WITNESS_SCORE))
        return self._fits_late(sender, shown, told, shown.boxes[told, :2])

    def _fits_late(self, sender: str, shown: Shown, told: IntArray, centres: FloatArray) -> bool:
        """Whether a sender's message is late by some boxes (n,) of a fusion, of vehicles centred there (n, 2)."""
        memory, own, ego = self.known.memory, self._moved(sender), self._moved(EGO)
        if self._testimony is None or own is None or ego is None:
            return False
        largest = max(memory.shown.values(), key=len, default=NOTHING)
        before = memory.shown.get(self.known.key(shown.teammates), largest)
        moved = motions(followed(shown.boxes[told], self.pose), before)
        known, turn = ~np.isnan(moved[:, 0]), self.pose[:2, :2]
        centres, moved = centres[known], moved[known] @ turn
        if sender != EGO:  # the ego is a vehicle, too
            centres, moved = np.vstack([centres, np.zeros(2)]), np.vstack([moved, ego @ turn])
        return late(self._testimony, sender, own @ turn, centres, moved)

    def note(self, joined: Hypothesis, without: Hypothesis, lies: Sequence[Lie]) -> None:
        """Note for whoever looks on what is wrong in a fusion by the fault of those whom the other one does without."""

        def places() -> Mapping[str, FloatArray]:
            return {
                said: np.array([lie.place for lie in lies if lie.kind == kind]).reshape(-1, 2)
                for kind, said in DONE.items()
            }

        if lies:
            self.differences.append(Difference("objects", joined, without, places))

    def gone(self, joined: Hypothesis, without: Hypothesis) -> FloatArray:
        """Boxes (n, 6) that one decoded fusion shows and another has lost although others support them."""
        asked = joined, without
        if asked not in self._gone:
            part = self.shown[without]
            self._gone[asked] = part.boxes[gone(self.shown[joined], part)]
        return self._gone[asked]

    def lost(self, fused: Hypothesis) -> FloatArray:
        """Where (n, 2) a vehicle stands that a fusion showed in the frame before and does not show now, though somebody
        is certain of it.
        """
        shown, subset = self.shown[fused], self.known.key(fused)
        if subset not in self.known.memory.shown:
            return NOTHING[:, :2]
        gone = gone_since(self.known.memory.shown[subset], self._followed(fused))
        return shown.missing_near((gone[:, :2] - self.pose[:2, 3]) @ self.pose[:2, :2]) if len(gone) else gone[:, :2]

    def _followed(self, fused: Hypothesis) -> FloatArray:
        known = self.known.shown.get(self.known.key(fused))
        return followed(self.shown[fused].boxes, self.pose) if known is None else known

    def vouching(self, fused: Hypothesis, lie: Lie) -> Hypothesis:
        """Those fused whose own messages go with a ghost or a hole, if they are several and not all."""
        if lie.kind == "moved":
            return ()
        going = set(self.shown[fused].going_with(lie))
        group = tuple([name for name in fused if name in going])
        return group if 2 <= len(group) < len(fused) else ()

    def lies_in(self, fused: Hypothesis) -> list[Lie]:
        """What is wrong in a fusion, and not remembered as nobody's doing, nor wrong in what the ego sees alone: nobody
        else has a part in that. But what the ego misses somebody may still take away.
        """
        frame = self.known.memory.frame
        found = [lie for lie in self.shown[fused].lies if not self.lies.is_quiet(self.placed(lie.place), frame)]
        return [lie for lie in found if lie.kind == "gone" or not self._is_of_ego(lie)]

    def _is_of_ego(self, lie: Lie) -> bool:
        same = (own for own in self._lies_of_ego if own.kind == lie.kind)
        return any(np.hypot(*(own.place - lie.place)) <= SAME_LIE_M for own in same)

    @cached_property
    def _lies_of_ego(self) -> list[Lie]:
        return [] if self._of_ego is None else self._of_ego.lies

    @cached_property
    def _of_ego(self) -> Shown | None:
        """What the ego shows alone."""
        if self.hearing is None or self._alone is None:
            return None
        return Shown((), self._alone, self.hearing)

    def supporters(self, answer: Hypothesis, hole: Lie) -> Hypothesis:
        """The two of those fused who support a vehicle in a hole most, in the order of the team."""
        said = self.heard().said(hole.place)
        most = sorted((name for name in answer if said[name] >= SUPPORTS), key=lambda name: -said[name])[:2]
        return tuple(name for name in answer if name in most)

    def is_real(self, answer: Hypothesis, witnesses: Hypothesis, hole: Lie) -> bool:
        """Whether those who support a vehicle in a hole show it without the others: else nobody has taken it away."""
        if witnesses not in self.shown:
            return False
        found = self.gone(answer, witnesses)
        return bool(len(found)) and bool(np.hypot(*(found[:, :2] - hole.place).T).min() <= REACH_M)

    def heard(self) -> Hearing:
        """What all messages say."""
        if self.hearing is None:
            raise RuntimeError("there is no testimony yet")
        return self.hearing

    def placed(self, place: FloatArray) -> FloatArray:
        """A place (2,) of the ego's frame in the world."""
        placed: FloatArray = self.pose[:2, :2] @ place + self.pose[:2, 3]
        return placed


def one_out(fused: Hypothesis, decoded: Iterable[Hypothesis]) -> dict[str, Hypothesis]:
    """By teammate, in the order of those fused: the fusion of all the others, where it was decoded, too."""
    everybody = set(fused)
    parts = [part for part in decoded if len(part) == len(fused) - 1 and everybody.issuperset(part)]
    found = {next(iter(everybody.difference(part))): part for part in parts}
    return {name: found[name] for name in fused if name in found} if found else {}
