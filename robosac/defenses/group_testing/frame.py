"""One frame of group testing: what to test, and what to conclude."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from robosac.answers import Reason, Source, Verdict
from robosac.defenses.group_testing import choice
from robosac.defenses.group_testing.candidates import WITNESSES, candidates, cleared
from robosac.defenses.group_testing.evidence import Evidence
from robosac.defenses.group_testing.findings import CALM
from robosac.defenses.group_testing.inspection import Inspection
from robosac.defenses.group_testing.knowledge import Knowledge, remember
from robosac.defenses.group_testing.posterior import EXACT
from robosac.defenses.protocol import Decision, Hypothesis, Outcome, Rejection, explain_rejections

TRUSTED_BELOW = 0.1
"""Largest suspicion of a teammate on the trust list."""
SUSPECTED_FROM = 0.5
"""Suspicion from which on a teammate that is left out is told to be suspected."""
CLEARED_BELOW = 0.5
"""A named teammate is named no longer once its suspicion is below."""
FORGOTTEN_BELOW = 0.05
"""Evidence about a teammate less suspected is dropped."""
SUBSETS_TO_NAME = 2
"""Different subsets that must speak against a teammate before it is named."""
WORTH_WAITING = 0.34
"""Bits that a test must promise for a larger team's answer to wait for it."""
_TIE = 1e-9
_DIGITS = 9


class JudgedFrame:
    """A frame while it is judged.

    Parameters
    ----------
    known : Knowledge
    evidence : Evidence
        What the frame's outcomes tell.
    team : tuple of str
        Teammates present.
    trusted : frozenset of str
        The trust list that the frame began with.
    """

    def __init__(self, known: Knowledge, evidence: Evidence, team: Hypothesis, trusted: frozenset[str]) -> None:
        self._known = known
        self._evidence = evidence
        self._team = team
        self._trusted = trusted
        self._out = known.memory.placing.out
        self._best: tuple[tuple[int, int, frozenset[str]], tuple[Hypothesis, float, Source]] | None = None

    def next_test(self, rng: np.random.Generator, passes: int) -> Hypothesis | None:
        """The subset most worth decoding, ties broken at random; None if none is worth its pass.

        A larger team's frame begins with a test of doubtful teammates beside trusted ones where it promises much: it
        may be the answer itself, and else the answer is decoded next.

        Parameters
        ----------
        rng : numpy.random.Generator
        passes : int
            Left in this frame, at least 1.
        """
        if not self._team:
            return None
        known, outcomes = self._known, self._evidence.outcomes
        decoded = known.rows([o.teammates for o in outcomes])
        tested = tuple(name for name in self._team if name not in self._out)
        if self._out and self._are_suspected(tested):  # they may be worth no test, and nobody would be seen to be back
            tested = self._team
        options = candidates(known.posterior, known.rows([tested])[0], decoded)
        if not len(options):
            return None
        ego_sees = self._evidence.ego_witnesses
        gained = np.maximum(0.0, choice.utility(known, options) - max(0.0, self._best_answer()[1]))
        worth_of_a_bit = choice.INFORMATION_VALUE
        if known.memory.hurried and not outcomes:
            worth_of_a_bit *= choice.LASTING
        most_promised = worth_of_a_bit * choice.most_promised(known)
        if outcomes and gained.max() + most_promised <= choice.TEST_COST:  # as in most frames of an honest team
            return None
        may_wait = len(self._team) > EXACT and not outcomes and passes > 1
        if not outcomes and not may_wait:  # what cannot be the best is not worth reckoning
            most = worth_of_a_bit * choice.most_information(known, options)
            likely = gained + most >= gained.max() - 2 * _TIE
            options, gained = options[likely], gained[likely]
            if len(options) == 1 and gained[0] > choice.TEST_COST:  # whatever it tells
                return known.names(options[0], self._team)
        bits = choice.expected_information(known, options, decoded, ego_sees=ego_sees)
        value = gained + worth_of_a_bit * bits - choice.TEST_COST
        if may_wait:
            beside = (options & cleared(known.posterior.marginals())).sum(axis=1) >= WITNESSES
            if (beside & (bits >= WORTH_WAITING)).any():
                value = np.where(beside, bits, 0.0)
        best = np.flatnonzero(value >= value.max() - _TIE)
        chosen = int(best[rng.integers(len(best))])
        return known.names(options[chosen], self._team) if value[chosen] > 0 else None

    def _are_suspected(self, names: Hypothesis) -> bool:
        suspicion = self._known.suspicion()
        return all(suspicion[name] >= CLEARED_BELOW for name in names)

    def best_answer(self) -> Hypothesis:
        """The decoded subset that would be answered now."""
        return self._best_answer()[0]

    def in_place(self) -> Hypothesis | None:
        """The answer without those who turned out to be out of place in this frame; None if it was decoded already, or
        nobody is left of it.
        """
        out = self._known.memory.placing.out
        answer = self._most_useful(self._allowed())[0]
        left = tuple(name for name in answer if name not in out)
        return left if left and left not in {o.teammates for o in self._evidence.outcomes} else None

    def decide(self, named_before: frozenset[str], naming_bound: float, inspection: Inspection) -> Decision:
        """The answer, whom to trust, and whom to name; the frame is over."""
        memory, outcomes = self._known.memory, self._evidence.outcomes
        if not outcomes:  # how steady the ego is, by all frames so far
            memory.steadiness.begin(None)
        suspicion = self._known.suspicion()
        accepted, _, source = self._best_answer()
        if not outcomes or (not accepted and len(self._team) > EXACT):
            accepted, source = self._untested_answer()
        named = [
            name
            for name, p in suspicion.items()
            if p >= CLEARED_BELOW and (name in named_before or self._is_attacker(name, p, naming_bound))
        ]
        believed = self._trusted.union(*(o.teammates for o in outcomes if self._verified(o)))
        trusted = [name for name, p in suspicion.items() if name in believed and p <= TRUSTED_BELOW]
        rejected = self._explain(accepted, set(named), suspicion)
        memory.shown, memory.shown_in = self._evidence.shown, outcomes[0].frame if outcomes else 0
        memory.forget_evidence({name for name, p in suspicion.items() if p < FORGOTTEN_BELOW})
        memory.frame += 1
        ratio = sum(suspicion.values()) / len(suspicion) if suspicion else None
        state = remember(self._known.posterior, memory, trusted, named)
        objects, contradicted = inspection.judged(accepted) or (None, ())
        judge = partial(inspection.judged_alone, accepted)
        differences = (*self._evidence.differences, *inspection.differences)
        return Decision(accepted, source, rejected, ratio, state, suspicion, objects, contradicted, judge, differences)

    def _is_attacker(self, name: str, suspicion: float, naming_bound: float) -> bool:
        """Whether a teammate is to be named. It is suspected, and lied about objects too often where the ego is steady;
        or it is suspected for certain by several tests, and its own fusions are too unsteady. Nobody is suspected here
        for straying, nor named whose message lies elsewhere.
        """
        memory = self._known.memory
        suspicion = memory.straying.without(name, suspicion)
        if suspicion < CLEARED_BELOW or name in memory.placing.lost:
            return False
        if memory.steadiness.calm >= CALM and memory.lies.guilt(name, memory.frame) >= 1.0:
            return True
        return (
            suspicion > naming_bound
            and memory.subsets_against(name) >= SUBSETS_TO_NAME
            and memory.steadiness.names(name)
        )

    def _best_answer(self) -> tuple[Hypothesis, float, Source]:
        """Of the decoded subsets that may be answered, the most useful; the ego alone if none is of use. Nobody is in
        it who was out of place before this frame, nor, if possible, who is since.
        """
        known = self._known.posterior.version, len(self._evidence.outcomes), self._known.memory.placing.out
        if self._best is None or self._best[0] != known:
            self._best = known, self._choose_answer()
        return self._best[1]

    def _choose_answer(self) -> tuple[Hypothesis, float, Source]:
        allowed, out = self._allowed(), self._known.memory.placing.out
        best = self._most_useful([o for o in allowed if out.isdisjoint(o.teammates)])
        return best if best[0] else self._most_useful(allowed)

    def _allowed(self) -> list[Outcome]:
        """What may be answered: in consensus or all trusted, and nobody in it was out of place before this frame."""
        outcomes = [o for o in self._evidence.outcomes if self._out.isdisjoint(o.teammates)]
        return [o for o in outcomes if self._verified(o) or self._trusted.issuperset(o.teammates)]

    def _most_useful(self, outcomes: Sequence[Outcome]) -> tuple[Hypothesis, float, Source]:
        if outcomes:
            worth = choice.utility(self._known, self._known.rows([o.teammates for o in outcomes]))
            best = int(np.argmax(worth.round(_DIGITS)))
            if worth[best] > 0:
                source = Source.CONSENSUS if self._verified(outcomes[best]) else Source.TRUSTED
                return outcomes[best].teammates, float(worth[best]), source
        return (), 0.0, Source.EGO_ONLY

    def _untested_answer(self) -> tuple[Hypothesis, Source]:
        """Without time for any test: all that are trusted, and in place."""
        present = tuple(name for name in self._team if name in self._trusted - self._out)
        if present and choice.utility(self._known, self._known.rows([present]))[0] > 0:
            return present, Source.TRUSTED
        return (), Source.EGO_ONLY

    def _verified(self, outcome: Outcome) -> bool:
        """In consensus with an ego that sees enough to be asked."""
        return self._evidence.ego_sees and outcome.verdict is Verdict.CONSENSUS

    def _explain(self, accepted: Hypothesis, named: set[str], suspicion: Mapping[str, float]) -> dict[str, Rejection]:
        rejected, memory = {}, self._known.memory
        for name, rejection in explain_rejections(self._team, accepted, self._evidence.outcomes).items():
            evidence: dict[str, Any] = {**rejection.evidence, "suspicion": round(suspicion[name], 6)}
            reason = rejection.reason
            if memory.placing.ego_astray:
                evidence["ego_astray"] = True
            elif name in memory.placing.out:
                evidence["misplaced_m"] = round(memory.placing.off[name], 2)
            elif reason is Reason.NOT_SAMPLED and suspicion[name] >= SUSPECTED_FROM:
                reason = Reason.SUSPECTED
            if name in named:
                reason = Reason.DISTRUSTED
                evidence["evidence"] = [dict(item) for item in memory.evidence.get(name, ())]
            rejected[name] = Rejection(reason, evidence)
        return rejected
