"""Asks about the objects of a frame: whom to leave out to see who is behind a false one."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from itertools import islice

import numpy as np

from robosac.answers import Verdict
from robosac.boxes import FloatArray
from robosac.defenses.group_testing.candidates import UNRESOLVED
from robosac.defenses.group_testing.claims import SUPPORTS
from robosac.defenses.group_testing.conclusions import conclude
from robosac.defenses.group_testing.findings import Findings, one_out
from robosac.defenses.group_testing.lies import AUDIT_FRAMES, Word
from robosac.defenses.group_testing.objects import Lie, Shown
from robosac.defenses.group_testing.posterior import EXACT
from robosac.defenses.group_testing.standing import judge
from robosac.defenses.protocol import Difference, Hypothesis, Judged, Outcome
from robosac.testimony import Testimony

SUSPECT = 0.5
"""Who is suspected more than this, and not named, is asked again each frame, so as to be cleared or named."""

FEWEST_TO_ASK = 2
"""It takes so many hypotheses to ask one suspect again: alone, and beside the answer."""


class Inspection:
    """The questions about the objects of one frame, and what comes of them.

    Parameters
    ----------
    found : Findings
        Nothing yet.
    keep_contradicted : bool
        Whether boxes that are contradicted stay in the answer.
    """

    def __init__(self, found: Findings, keep_contradicted: bool) -> None:
        self._found = found
        self._keep_contradicted = keep_contradicted
        self._whole: Hypothesis | None = None
        self._agreeing: list[Hypothesis] = []
        self._lost: list[FloatArray] | None = None
        self._suspects: list[str] | None = None

    @property
    def differences(self) -> list[Difference]:
        """What somebody is to blame for, box by box."""
        return self._found.differences

    def learn(self, outcome: Outcome) -> Shown | None:
        """Take in a decoded subset; what it shows is given back, checked, if there is testimony to check it by."""
        if outcome.verdict is Verdict.CONSENSUS:
            self._agreeing.append(outcome.teammates)
        return self._found.learn(outcome)

    def next_test(self, answer: Hypothesis) -> Hypothesis | None:
        """The subset to decode next, to see who is behind what is wrong; None if nothing is, or all is explained."""
        return self._first_not_decoded(self._questions(answer))

    def asked_again(self, answer: Hypothesis) -> Hypothesis | None:
        """The subset to decode next to ask those again beside the answer that are left out; None if nobody is."""
        asked = [subset for subset in self._again(answer) if set(answer) <= set(subset)]
        proving = (part for subset in asked for part in self._found.to_prove(subset))
        return self._first_not_decoded((*asked, *proving))

    def _first_not_decoded(self, subsets: Iterable[Hypothesis]) -> Hypothesis | None:
        return next((subset for subset in subsets if subset and subset not in self._found.decoded), None)

    def _questions(self, answer: Hypothesis) -> Iterator[Hypothesis]:
        """What is worth decoding, in this order: those to be asked again; each alone who knows a vehicle's shape;
        whether what is missing is real; the answer without all that vouch for a lie, if they are several; without each,
        the likeliest first; what tells who made a vehicle vanish; without those who may stray, and those whose turn it
        is.
        """
        yield from self._again(answer)
        if answer not in self._found.shown:
            return
        # the answer may change within a frame, and nobody would be left out of the same one
        self._whole = self._to_be_audited(answer) if self._whole is None else self._whole
        yield from (self._without(answer, name) for name in answer if self._found.lies.worst(name))
        yield from ((name,) for name in self._found.to_ask(self._whole))
        lies = self._found.unexplained(answer) or self._hardly_explained(answer)
        lies = [lie for lie in lies if lie.kind != "gone" or self._found.supporters(answer, lie)]
        holes = [lie for lie in lies if lie.kind == "gone"]
        if holes and len(holes) == len(lies):
            witnesses = self._found.supporters(answer, holes[0])
            yield witnesses
            lies = [lie for lie in holes if self._found.is_real(answer, witnesses, lie)]
        if lies:
            groups = [self._found.vouching(answer, lie) for lie in lies]
            for group in (*filter(None, groups), *((name,) for name in self._candidates(answer, lies))):
                yield self._without(answer, *group)
        yield from self._found.to_prove(answer)
        if len(self._found.team) <= EXACT and self._whole in self._found.shown:
            yield from self._vanished(self._whole)
        again = (*self._straying(self._whole), *self._due(self._whole))
        yield from (self._without(self._whole, name) for name in again)

    def conclude(self, answer: Hypothesis) -> None:
        """Who lied in this frame; the posterior learns it, and memory keeps it. Whether all of the answer are to be
        left out again in the next frames, one after the other.
        """
        found, memory = self._found, self._found.known.memory
        conclude(found, answer)
        found.remember_senders()
        if answer in found.shown and memory.vigilance.learn(found.shown[answer]):
            for name in set(answer) - memory.straying.levels.keys():  # those are being looked at
                found.lies.audited.pop(name, None)

    def judged(self, answer: Hypothesis) -> Judged | None:
        """How each box of an answer stands; None where it was not decoded, or nothing is known of objects."""
        found = self._found
        shown = found.shown.get(answer) if answer else found.of_ego
        if shown is None:
            return None
        shapes = [
            (index, found.shown[without], at)
            for name, without in one_out(answer, found.shown).items()
            for index, at, _ in found.reshaped(answer, without, (name,))
        ]
        return self._kept(judge(shown, list(found.shown.values()), shapes, found.of_ego))

    def judged_alone(self, answer: Hypothesis, boxes: FloatArray, testimony: Testimony) -> Judged:
        """How each box (n, 6) of an answer stands that was not decoded as a test: by testimony alone."""
        shown = Shown(answer, boxes, self._found.hear(testimony))
        return self._kept(judge(shown, (), of_ego=self._found.of_ego))

    def _kept(self, judged: Judged) -> Judged:
        objects, contradicted = judged
        return ((*objects, *contradicted), ()) if self._keep_contradicted else judged

    def _again(self, answer: Hypothesis) -> list[Hypothesis]:
        """What is to be decoded to ask those again that are neither in the answer nor named: of those only in doubt,
        beside the answer, in one frame as many together as are more likely all honest than not, in the next the least
        suspected, in a large team of those who are not as good as cleared; each of the two most suspected ones, or that
        lied lately, beside the answer and alone. Whoever is only out of place is in no doubt.
        """
        posterior, suspicion = self._found.known.posterior, self._found.known.suspicion()
        left = [name for name in self._found.team if name not in answer and name not in self._found.named]
        left.sort(key=lambda name: round(suspicion[name], 9))
        suspects = [name for name in left if suspicion[name] > SUSPECT or self._found.lies.worst(name)]
        out = self._found.known.memory.placing.out
        doubtful = [name for name in left if name not in suspects and name not in out]
        large = len(self._found.team) > EXACT
        alone = [name for name in doubtful if not large or suspicion[name] >= UNRESOLVED[0]][:1]
        asked = [self._with(answer, alone)] if alone else []
        # every other frame, or a liar among them would spoil every test
        turn = self._found.hearing is None or self._found.known.memory.frame % 2 == 0
        if len(doubtful) > 1 and turn:
            groups = [doubtful[:count] for count in range(len(doubtful), 0, -1)]
            rows = self._found.known.rows([(*answer, *group) for group in groups])
            honest = posterior.unattacked(posterior.masks(rows)) >= SUSPECT
            asked = [self._with(answer, groups[int(honest.argmax())])] if honest.any() else asked
        # whoever is asked alone is less suspected by it, and others would be asked in its place before it is done with
        self._suspects = suspects[-2:][::-1] if self._suspects is None else self._suspects
        begun, last = [name for name in self._suspects if name in suspects], list[Hypothesis]()
        for suspect in (*begun, *(name for name in reversed(suspects) if name not in begun))[:2]:
            beside = self._with(answer, [suspect])
            # what a lie is worth is found out first, or where little can be asked nobody would ever be named for it
            asked += [beside, *self._found.to_prove(beside, [Word.DOUBTFUL]), (suspect,)]
            last += self._found.to_prove(beside)
        return [*asked, *last]

    def _with(self, answer: Hypothesis, others: Collection[str]) -> Hypothesis:
        """The answer and others, in the order of the team."""
        together = {*answer, *others}
        return tuple(name for name in self._found.team if name in together)

    @staticmethod
    def _without(answer: Hypothesis, *group: str) -> Hypothesis:
        return tuple(name for name in answer if name not in group)

    def _to_be_audited(self, answer: Hypothesis) -> Hypothesis:
        """The answer; in the first frame the largest fusion in consensus: once nothing is found wrong it may be the
        answer.
        """
        return max(self._agreeing, key=len, default=answer) if self._found.known.memory.frame == 0 else answer

    def _straying(self, whole: Hypothesis) -> list[str]:
        """Who may stray: in larger teams, where all take too many passes, those against whom there is something."""
        straying = self._found.known.memory.straying
        large = len(self._found.team) > EXACT
        return [name for name in straying.to_be_asked(whole) if straying.rising(name) or not large]

    def _due(self, whole: Hypothesis) -> list[str]:
        """Who is to be left out although nothing seems wrong, to see what it takes away: all that never were, and one
        in a frame of those that were long ago. In larger teams that takes too many passes.
        """
        if len(self._found.team) > EXACT:
            return []
        frame, last = self._found.known.memory.frame, self._found.lies.audited
        never = [name for name in whole if name not in last]
        if never or one_out(whole, self._found.decoded):
            return never
        return sorted((name for name in whole if frame - last[name] >= AUDIT_FRAMES), key=lambda name: last[name])[:1]

    def _vanished(self, whole: Hypothesis) -> Iterator[Hypothesis]:
        """Where a vehicle that somebody sees has vanished from a fusion since the frame before: the fusion without each
        who may have taken it away. Whoever sees it may have done so, too, but not if nobody else sees it.
        """
        found, frame = self._found, self._found.known.memory.frame
        if self._lost is None:  # the first that is to be searched: who took it away shows with others, too
            places = (place for place in found.lost(whole) if found.lies.search(found.placed(place), frame))
            self._lost = list(islice(places, 1))
        for place in self._lost:
            said = found.heard().said(place)
            seeing = [name for name in whole if said[name] >= SUPPORTS]
            others = [name for name in whole if name not in seeing]
            yield from (self._without(whole, name) for name in (*(seeing if len(seeing) > 1 else ()), *others))

    def _hardly_explained(self, answer: Hypothesis) -> list[Lie]:
        """What is wrong in the answer, and explained, while only one of those fused was left out: what two do together
        is explained by either.
        """
        left_out = len(one_out(answer, self._found.shown))
        return self._found.lies_in(answer) if left_out == 1 and len(answer) > 1 else []

    def _candidates(self, answer: Hypothesis, lies: Sequence[Lie]) -> list[str]:
        """Who may be behind them, the likeliest first: those suspected already, and those whose own testimony goes with
        the lie. Who was left out lately comes after the others.
        """
        testimony = self._found.heard().everybody
        said = testimony.likelihood(np.stack([lie.place for lie in lies]))
        sign = np.array([-1.0 if lie.kind == "gone" else 1.0 for lie in lies])
        suspicion = self._found.known.suspicion()
        own = dict(zip(testimony.agents, (said * sign).sum(axis=1).tolist(), strict=True))
        frame = self._found.known.memory.frame

        def unlikely(name: str) -> tuple[bool, float]:
            again = self._found.lies.recently_left_out(name, frame) and not self._found.lies.worst(name)
            return again, -round(10 * self._found.lies.worst(name) + 10 * suspicion[name] + own[name], 1)

        return sorted(answer, key=unlikely)
