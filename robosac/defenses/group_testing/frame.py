"""One frame of group testing: what to test, what to learn from it, what to conclude."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from robosac.answers import Reason, Source, Verdict
from robosac.boxes import FloatArray
from robosac.defenses.group_testing import choice
from robosac.defenses.group_testing.candidates import WITNESSES, candidates, cleared
from robosac.defenses.group_testing.geometry import MIN_WITNESSES, PairMeasure, changes, crowd, followed, measure
from robosac.defenses.group_testing.memory import (
    CHANGE_REPEAT,
    EGO_REPEAT,
    PAIR_REPEAT,
    WORTH_KEEPING,
    Memory,
    identity,
    keys,
)
from robosac.defenses.group_testing.model import CLEAN, EvidenceModel, pair_bin
from robosac.defenses.group_testing.posterior import EXACT, BoolArray, Posterior
from robosac.defenses.protocol import Decision, Hypothesis, Outcome, Rejection, State, explain_rejections

TRUSTED_BELOW = 0.1
"""Largest suspicion of a teammate on the trust list."""
CLEARED_BELOW = 0.5
"""A named teammate is named no longer once its suspicion is below."""
FORGOTTEN_BELOW = 0.05
"""Evidence about a teammate less suspected is dropped."""
SUBSETS_TO_NAME = 2
"""Different subsets that must speak against a teammate before it is named."""
WORTH_WAITING = 0.34
"""Bits that a test must promise for a larger team's answer to wait for it."""
_REPEATS = {"ego": EGO_REPEAT, "pair": PAIR_REPEAT, "change": CHANGE_REPEAT}
_CERTAIN = 1e-9
_TIE = 1e-9
_TINY = 1e-300


@dataclass(frozen=True)
class Conclusion:
    """A decision without its state yet."""

    accepted: Hypothesis
    source: Source
    rejected: Mapping[str, Rejection]
    suspicion: Mapping[str, float]
    trusted: Sequence[str]
    named: Sequence[str]

    def with_state(self, state: State) -> Decision:
        """The decision."""
        ratio = sum(self.suspicion.values()) / len(self.suspicion) if self.suspicion else None
        return Decision(self.accepted, self.source, self.rejected, ratio, state, self.suspicion)


@dataclass(frozen=True)
class _Finding:
    """One piece of evidence: a test of ``a`` (and ``d`` beside it), and how likely its outcome was.

    ``test`` is ``ego`` (d beside the ego alone), ``pair`` (beside a), or ``change`` (d beside itself in the frame
    before).
    """

    test: str
    a: Hypothesis
    d: Hypothesis
    log_likelihood: FloatArray
    weight: float
    values: Mapping[str, Any]


class JudgedFrame:
    """Mutable; posterior and memory are changed in place.

    Parameters
    ----------
    model : EvidenceModel
    posterior : Posterior
        Of this frame, before its evidence.
    memory : Memory
    team : tuple of str
        Teammates present.
    trusted : frozenset of str
        The trust list that the frame began with.
    compare_frames : bool
        Whether to compare with the frame before.
    """

    def __init__(
        self,
        model: EvidenceModel,
        posterior: Posterior,
        memory: Memory,
        team: Hypothesis,
        trusted: frozenset[str],
        *,
        compare_frames: bool,
    ) -> None:
        self._model = model
        self._posterior = posterior
        self._memory = memory
        self._team = team
        self._trusted = trusted
        self._compare_frames = compare_frames
        if not compare_frames:
            memory.shown = {}
        self._outcomes: list[Outcome] = []
        self._shown: dict[int, FloatArray] = {}
        self._ego_sees = self._ego_witnesses = True
        self._members = posterior.members
        self._index = {name: i for i, name in enumerate(self._members)}
        self._identities = np.array([identity(name) for name in self._members], dtype=np.uint64)

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
        decoded = self._rows([o.teammates for o in self._outcomes])
        options = candidates(self._posterior, self._rows([self._team])[0], decoded)
        if not len(options):
            return None
        bits = choice.expected_information(
            self._model, self._posterior, self._memory, self._identities, options, decoded, ego_sees=self._ego_witnesses
        )
        worth = choice.utility(self._posterior, options) - max(0.0, self._best_answer()[1])
        value = np.maximum(0.0, worth) + choice.INFORMATION_VALUE * bits - choice.TEST_COST
        if len(self._team) > EXACT and not self._outcomes and passes > 1:
            beside = (options & cleared(self._posterior.marginals())).sum(axis=1) >= WITNESSES
            if (beside & (bits >= WORTH_WAITING)).any():
                value = np.where(beside, bits, 0.0)
        best = np.flatnonzero(value >= value.max() - _TIE)
        chosen = int(best[rng.integers(len(best))])
        if value[chosen] <= 0:
            return None
        return tuple(name for name in self._team if options[chosen, self._index[name]])

    def learn(self, outcome: Outcome) -> None:
        """Take in a decoded subset: the pairs it makes with the ego alone and with what this frame has shown already,
        and what has changed in it since the frame before.
        """
        if outcome.frame != self._memory.shown_in + 1:  # nothing to compare with, nor to be promised
            self._memory.shown = {}
        self._ego_sees = outcome.reference is not None and len(outcome.reference) >= MIN_WITNESSES
        findings = self._pairs(outcome)
        if outcome.reference is not None and outcome.boxes is not None:
            pair = measure(outcome.reference, outcome.boxes)
            self._ego_witnesses = pair is not None
            if pair is not None:
                values = {"jaccard_index": round(outcome.jaccard_index, 4)}
                findings.append(self._finding((), outcome.teammates, pair, 1.0, values))
        findings += self._changes(outcome)
        self._outcomes.append(outcome)
        for finding in findings:
            self._apply(finding)

    def _pairs(self, outcome: Outcome) -> list[_Finding]:
        found = []
        for other in self._outcomes:
            small, large = sorted((other, outcome), key=lambda o: len(o.teammates))
            joining = tuple(name for name in large.teammates if name not in set(small.teammates))
            if len(joining) != len(large.teammates) - len(small.teammates) or not joining:
                continue
            if small.boxes is None or large.boxes is None:
                continue
            pair = measure(small.boxes, large.boxes)
            if pair is not None:
                found.append((small.teammates, joining, pair))
        return [self._finding(a, d, pair, 1 / math.sqrt(len(found)), {}) for a, d, pair in found]

    def _changes(self, outcome: Outcome) -> list[_Finding]:
        if not self._compare_frames or outcome.boxes is None or outcome.pose is None:
            return []
        (key,) = (self._rows([outcome.teammates]) @ self._identities).tolist()
        self._shown[key] = now = followed(outcome.boxes, outcome.pose)
        before = self._memory.shown.get(key)
        if before is None or max(crowd(before), crowd(now)) < MIN_WITNESSES:
            return []
        boxes, changed = crowd(now), changes(before, now)
        likelihood = self._model.change(len(outcome.teammates), boxes, changed)
        values = {"boxes": boxes, "changes": changed}
        return [_Finding("change", (), outcome.teammates, np.log(likelihood), 1.0, values)]

    def _finding(
        self, a: Hypothesis, d: Hypothesis, pair: PairMeasure, weight: float, values: Mapping[str, Any]
    ) -> _Finding:
        table = self._model.tables(np.array([len(a)]), np.array([len(d)]))[0]
        values = {**values, "loss": round(pair.loss, 4), "novelty": pair.novelty}
        weight *= choice.DEPENDENCE
        return _Finding("pair" if a else "ego", a, d, np.log(table[:, pair_bin(pair)]), weight, values)

    def _apply(self, finding: _Finding) -> None:
        a, d = self._rows([finding.a, finding.d])
        cells = self._posterior.cells(self._posterior.masks(a[None]), self._posterior.masks(d[None]))[0]
        likelihood = np.exp(finding.log_likelihood)
        clean, attacked = (
            float(cells[part] @ likelihood[part]) / max(float(cells[part].sum()), _TINY)
            for part in (slice(CLEAN), slice(CLEAN, None))
        )
        sign = 1 if attacked > clean else -1
        of_a, of_d = a[None] @ self._identities, d[None] @ self._identities
        (key,) = keys(of_d, of_a) if finding.test == "change" else keys(of_a, of_d)
        weight = finding.weight * float(choice.dilution(np.array([len(finding.a) + len(finding.d)]))[0])
        weight *= self._memory.weigh(int(key), _REPEATS[finding.test], sign)
        before = self._posterior.marginals()
        self._posterior.update(a, d, weight * finding.log_likelihood)
        ratios = _log_odds(self._posterior.marginals()) - _log_odds(before)
        for index in np.flatnonzero(np.abs(ratios) >= WORTH_KEEPING):
            name, ratio = self._members[index], float(ratios[index])
            if ratio > 0 or name in self._memory.evidence:
                item = {"frame": self._memory.frame, "test": finding.test, **finding.values}
                item["teammates"] = list(finding.a or finding.d)
                if finding.a:
                    item["joining"] = list(finding.d)
                item["log_likelihood_ratio"] = round(ratio, 3)
                self._memory.add_evidence(name, item)

    def decide(self, named_before: frozenset[str], naming_bound: float) -> Conclusion:
        """The answer, whom to trust, and whom to name."""
        suspicion = self._suspicion()
        accepted, _, source = self._best_answer()
        if not self._outcomes or (not accepted and len(self._team) > EXACT):
            accepted, source = self._untested_answer()
        named = [
            name
            for name, p in suspicion.items()
            if (p > naming_bound and self._memory.subsets_against(name) >= SUBSETS_TO_NAME)
            or (name in named_before and p >= CLEARED_BELOW)
        ]
        believed = set(self._trusted)
        for outcome in self._outcomes:
            if self._verified(outcome):
                believed.update(outcome.teammates)
        trusted = [name for name, p in suspicion.items() if name in believed and p <= TRUSTED_BELOW]
        rejected = self._explain(accepted, set(named), suspicion)
        self._memory.shown = self._shown
        self._memory.shown_in = self._outcomes[0].frame if self._outcomes else 0
        self._memory.forget_evidence({name for name, p in suspicion.items() if p < FORGOTTEN_BELOW})
        return Conclusion(accepted, source, rejected, suspicion, trusted, named)

    def _best_answer(self) -> tuple[Hypothesis, float, Source]:
        """Of the decoded subsets that may be answered, the most useful; the ego alone if none is of use."""
        allowed = [o for o in self._outcomes if self._verified(o) or self._trusted.issuperset(o.teammates)]
        if not allowed:
            return (), 0.0, Source.EGO_ONLY
        worth = choice.utility(self._posterior, self._rows([o.teammates for o in allowed]))
        best = int(np.argmax(worth))
        if worth[best] <= 0:
            return (), 0.0, Source.EGO_ONLY
        source = Source.CONSENSUS if self._verified(allowed[best]) else Source.TRUSTED
        return allowed[best].teammates, float(worth[best]), source

    def _untested_answer(self) -> tuple[Hypothesis, Source]:
        """Without time for any test: all that are trusted."""
        present = tuple(name for name in self._team if name in self._trusted)
        if present and choice.utility(self._posterior, self._rows([present]))[0] > 0:
            return present, Source.TRUSTED
        return (), Source.EGO_ONLY

    def _verified(self, outcome: Outcome) -> bool:
        """In consensus with an ego that sees enough to be asked."""
        return self._ego_sees and outcome.verdict is Verdict.CONSENSUS

    def _explain(self, accepted: Hypothesis, named: set[str], suspicion: Mapping[str, float]) -> dict[str, Rejection]:
        rejected = {}
        for name, rejection in explain_rejections(self._team, accepted, self._outcomes).items():
            evidence: dict[str, Any] = {**rejection.evidence, "suspicion": round(suspicion[name], 6)}
            reason = rejection.reason
            if name in named:
                reason = Reason.DISTRUSTED
                evidence["evidence"] = [dict(item) for item in self._memory.evidence.get(name, ())]
            rejected[name] = Rejection(reason, evidence)
        return rejected

    def _suspicion(self) -> dict[str, float]:
        return dict(zip(self._members, map(float, self._posterior.marginals()), strict=True))

    def _rows(self, subsets: Sequence[Hypothesis]) -> BoolArray:
        rows = np.zeros((len(subsets), len(self._members)), dtype=bool)
        for row, subset in zip(rows, subsets, strict=True):
            row[[self._index[name] for name in subset]] = True
        return rows


def _log_odds(p: FloatArray) -> FloatArray:
    kept = np.minimum(np.maximum(p, _CERTAIN), 1 - _CERTAIN)
    odds: FloatArray = np.log(kept / (1 - kept))
    return odds
