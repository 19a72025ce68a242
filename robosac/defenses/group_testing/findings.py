"""What is found out about the objects of one frame, as its subsets are decoded."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from functools import cached_property

import numpy as np

from robosac.boxes import FloatArray
from robosac.defenses.group_testing.claims import SUPPORTS
from robosac.defenses.group_testing.differences import SAME_LIE_M, blame, effects, gone, persists
from robosac.defenses.group_testing.fusions import NOTHING, Fusions
from robosac.defenses.group_testing.geometry import followed, gone_since
from robosac.defenses.group_testing.hearing import REACH_M
from robosac.defenses.group_testing.knowledge import Knowledge
from robosac.defenses.group_testing.lies import Lies, Word
from robosac.defenses.group_testing.objects import Lie
from robosac.defenses.group_testing.shapes import BLAMING, agreeing, reshaped, to_ask
from robosac.defenses.protocol import EGO, Difference, Hypothesis

CALM = 0.5
"""From here on the ego counts as steady."""
GROUPS = 4
"""Of those without whom a lie has to be there, too."""
DONE = {"ghost": "invented", "gone": "removed", "moved": "displaced", "reshaped": "reshaped"}
"""What was done to an object, by the kind of a lie."""


class Findings(Fusions):
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
    differences : list of Difference
        What somebody is to blame for.
    """

    def __init__(self, known: Knowledge, lies: Lies, team: Hypothesis, named: Collection[str]) -> None:
        super().__init__(known, team, named)
        self.lies = lies
        self.differences: list[Difference] = []
        self._gone: dict[tuple[Hypothesis, Hypothesis], FloatArray] = {}
        self._effects: dict[tuple[Hypothesis, Hypothesis, Hypothesis], list[Lie]] = {}
        self._shapes: dict[tuple[Hypothesis, Hypothesis, Hypothesis], list[list[int]]] = {}

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

    def proof(self, joined: Hypothesis, suspect: str, lie: Lie) -> Word:
        """What it is worth that a lie is not there without a suspect.

        Others may make it show only beside the suspect, whose own message may go with it by mistake. So a ghost is its
        own doing once it shows with the suspect alone. What it takes away or moves beside enough others is so once it
        was without each of them (`Lies.spared`). If it is put right without one of them, too, that is worth nothing,
        unless the messages of both go with it: those may lie together. As long as it is not known, it is doubtful where
        the suspect's own message does not go with it.
        """
        if not _takes_proof(lie):
            return Word.GOOD
        frame, without = self.known.memory.frame, self.shown[tuple(name for name in joined if name != suspect)]
        going = set(self.shown[joined].going_with(lie))
        put_right = False
        for part in filter(self.shown.__contains__, self._proving(joined, suspect, lie)):
            if persists(lie, self.shown[part], without):
                self.lies.spare(suspect, lie.kind, set(joined).difference(part), frame)
            elif suspect not in going or set(joined).difference(part) - going:
                put_right = True
        if put_right:
            return Word.NOTHING
        left = self.lies.not_spared(suspect, lie.kind, set(joined) - {suspect}, frame)
        return Word.DOUBTFUL if left and suspect not in going else Word.GOOD

    def to_prove(
        self, joined: Hypothesis, words: Collection[Word] = (Word.DOUBTFUL, Word.GOOD)
    ) -> Iterator[Hypothesis]:
        """What is to be decoded to see whether a lie, of which the `proof` is one of these words yet, shows only beside
        somebody else than its suspect.
        """
        if joined not in self.shown:
            return
        parts = one_out(joined, self.shown)
        done = {suspect: self.effects(joined, part, (suspect,)) for suspect, part in parts.items()}
        for suspect, lies in blame(done, self.shown[joined]).items():
            for lie in lies:
                if _takes_proof(lie) and self.proof(joined, suspect, lie) in words:
                    left = self.lies.not_spared(suspect, lie.kind, joined, self.known.memory.frame)
                    yield from (part for part in self._proving(joined, suspect, lie) if left.difference(part))

    @staticmethod
    def _proving(joined: Hypothesis, suspect: str, lie: Lie) -> list[Hypothesis]:
        """Parts of a fusion, with a suspect, in which a lie is to be seen: a ghost with the suspect alone; else without
        each of the others, of many without each of a few groups, as in small fusions one message changes much.
        """
        if lie.kind == "ghost":
            return [(suspect,)]
        others = [name for name in joined if name != suspect]
        groups = [others[first::GROUPS] for first in range(min(GROUPS, len(others)))]
        return [tuple(name for name in joined if name not in group) for group in groups]

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
        return [] if self.of_ego is None else self.of_ego.lies

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

    def placed(self, place: FloatArray) -> FloatArray:
        """A place (2,) of the ego's frame in the world."""
        placed: FloatArray = self.pose[:2, :2] @ place + self.pose[:2, 3]
        return placed


def _takes_proof(lie: Lie) -> bool:
    """Whether anybody may be named for such a lie."""
    return not (lie.along or lie.alone or lie.kind == "reshaped")


def one_out(fused: Hypothesis, decoded: Iterable[Hypothesis]) -> dict[str, Hypothesis]:
    """By teammate, in the order of those fused: the fusion of all the others, where it was decoded, too."""
    everybody = set(fused)
    parts = [part for part in decoded if len(part) == len(fused) - 1 and everybody.issuperset(part)]
    found = {next(iter(everybody.difference(part))): part for part in parts}
    return {name: found[name] for name in fused if name in found} if found else {}
