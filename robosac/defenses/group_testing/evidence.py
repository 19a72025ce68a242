"""What the outcomes of a frame tell about who attacks."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from robosac.boxes import BoolArray, FloatArray
from robosac.defenses.group_testing import geometry
from robosac.defenses.group_testing.choice import DEPENDENCE, UNDILUTED_SIZE
from robosac.defenses.group_testing.differences import misplaced
from robosac.defenses.group_testing.geometry import MIN_WITNESSES, PairMeasure, Said, crowd
from robosac.defenses.group_testing.knowledge import Knowledge
from robosac.defenses.group_testing.memory import CHANGE_REPEAT, EGO_REPEAT, PAIR_REPEAT, WORTH_KEEPING, key
from robosac.defenses.group_testing.model import CELLS, CLEAN
from robosac.defenses.group_testing.objects import Shown
from robosac.defenses.group_testing.strangeness import TESTS
from robosac.defenses.protocol import Difference, Hypothesis, Outcome

Real = Callable[[FloatArray], BoolArray]
_REPEATS = {"ego": EGO_REPEAT, "pair": PAIR_REPEAT, "change": CHANGE_REPEAT}
NOBODY = 0
"""The key of the ego alone."""
MISPLACED, MISPLACED_SLOPE, MISPLACED_MOST = 0.4, 3.0, 3.0
"""Boxes misplaced by more than this (`differences.misplaced`) speak against who joins, whatever the kind of attack: the
logarithm of the likelihood ratio grows by the slope, up to the last.
"""
SAID_AGAIN = 1.0
"""A finding that speaks against teammates counts 1 / (1 + so many times what findings of its test in this frame have
counted against each of them): what makes one of them odd is in the same messages again.
"""
_CERTAIN = 1e-9
_TINY = 1e-300


@dataclass(frozen=True)
class _Finding:
    """One piece of evidence: a test of ``a`` (and ``d`` beside it), and how likely its outcome was in each world.

    ``test`` is ``ego`` (d beside the ego alone), ``pair`` (beside a), or ``change`` (d beside itself in the frame
    before).
    """

    test: str
    a: Hypothesis
    d: Hypothesis
    likelihood: FloatArray
    weight: float
    values: Mapping[str, Any]
    misplaced: float = 0.0
    """How far d moves boxes from where others see the vehicles, see `differences.misplaced`."""


class Evidence:
    """Learns from one outcome after the other; posterior and memory are changed in place.

    Parameters
    ----------
    known : Knowledge
        Of this frame, before its evidence.
    compare_frames : bool
        Whether to compare with the frame before.

    Attributes
    ----------
    outcomes : list of Outcome
        What was learned from.
    ego_sees, ego_witnesses : bool
        Whether the ego alone has boxes enough for a verdict, and confident ones enough to compare fusions with; taken
        for granted before the first outcome.
    shown : dict of key to (n, 4) ndarray
        What each subset showed in this frame, see `geometry.followed`.
    differences : list of Difference
        What was compared, box by box.
    """

    measure = staticmethod(geometry.measure)
    followed = staticmethod(geometry.followed)
    changes = staticmethod(geometry.changes)

    def __init__(self, known: Knowledge, *, compare_frames: bool = True) -> None:
        self._known = known
        self._compare_frames = compare_frames
        if not compare_frames:
            self._forgo()
        self._checked: dict[Hypothesis, Shown | None] = {}
        self._alone: Shown | None = None
        self._against: dict[str, defaultdict[str, float]] = {test: defaultdict(float) for test in TESTS}
        self.outcomes: list[Outcome] = []
        self.shown = known.shown = {}
        self.differences: list[Difference] = []
        self.ego_sees = self.ego_witnesses = True

    def learn(self, outcome: Outcome, shown: Shown | None = None) -> None:
        """Take in a decoded subset: the pairs it makes with the ego alone and with what this frame has shown already,
        and what has changed in it since the frame before. ``shown`` is the same, checked by testimony.
        """
        self._checked[outcome.teammates] = shown
        self._known.frames_since = since = outcome.frame - self._known.memory.shown_in
        if since != 1:
            self._forgo()
        self.ego_sees = outcome.reference is not None and len(outcome.reference) >= MIN_WITNESSES
        if not self.outcomes and self._compare_frames:
            self._begin(outcome)
        findings = self._pairs(outcome)
        if outcome.reference is not None and outcome.boxes is not None:
            if self._alone is None and shown is not None:
                self._alone = shown.of_ego(outcome.reference)
            pair = self.measure(outcome.reference, outcome.boxes, *_said(self._alone, shown, outcome.teammates))
            self.ego_witnesses = pair is not None
            if pair is not None:
                values = {"jaccard_index": round(outcome.jaccard_index, 4)}
                findings.append(self._finding((), outcome.teammates, pair, 1.0, values))
        findings += self._changes(outcome)
        self.outcomes.append(outcome)
        for finding in findings:
            self._apply(finding)

    def _forgo(self) -> None:
        """Let nothing be compared with the frame judged before, nor promised by it. Vehicles have not gone since."""
        known, memory = self._known, self._known.memory
        known.shown_before, memory.shown = memory.shown or known.shown_before, {}

    def compare_singles(self) -> None:
        """Let those be judged whose own fusion was decoded in this frame and the one before; the frame is over."""
        before, now = self._known.memory.shown, self.shown
        singles = {}
        for outcome in self.outcomes:
            if len(outcome.teammates) == 1:
                subset = self._known.key(outcome.teammates)
                if subset in before and subset in now:
                    singles[outcome.teammates[0]] = self._flicker(before[subset], now[subset], self._real(outcome))
        self._known.memory.steadiness.learn(singles)

    def _begin(self, first: Outcome) -> None:
        """Let the ego alone be compared with the frame before."""
        before, alone = self._known.memory.shown.get(NOBODY), None
        if first.alone is not None and first.pose is not None:
            self.shown[NOBODY] = self.followed(first.alone, first.pose)
            alone = None if before is None else self._flicker(before, self.shown[NOBODY])
        self._known.memory.steadiness.begin(alone)

    def _flicker(self, before: FloatArray, now: FloatArray, real: Real | None = None) -> tuple[int, int]:
        """Boxes of a fusion, and those that came or went where no vehicle stands by the word of others."""
        return max(crowd(before), crowd(now)), self.changes(before, now, real)

    def _real(self, outcome: Outcome) -> Real | None:
        """Of boxes (n, 4), as `followed` gives them, whether others say that a vehicle stands there; None where there
        is no testimony.
        """
        shown, pose = self._checked[outcome.teammates], outcome.pose
        if shown is None or pose is None:
            return None
        return lambda rows: shown.stands(_in_frame(rows, pose))

    def _pairs(self, outcome: Outcome) -> list[_Finding]:
        found = []
        for other in self.outcomes:
            small, large = sorted((other, outcome), key=lambda o: len(o.teammates))
            joining = tuple(name for name in large.teammates if name not in set(small.teammates))
            if len(joining) != len(large.teammates) - len(small.teammates) or not joining:
                continue
            if small.boxes is None or large.boxes is None:
                continue
            part, whole = self._checked[small.teammates], self._checked[large.teammates]
            pair = self.measure(small.boxes, large.boxes, *_said(part, whole, joining))
            if pair is not None:
                off = 0.0 if part is None or whole is None else misplaced(whole, part, joining)
                found.append((small.teammates, joining, pair, off))
        return [self._finding(a, d, pair, 1 / math.sqrt(len(found)), {}, off) for a, d, pair, off in found]

    def _changes(self, outcome: Outcome) -> list[_Finding]:
        if outcome.boxes is None or outcome.pose is None:
            return []
        subset = self._known.key(outcome.teammates)
        self.shown[subset] = now = self.followed(outcome.boxes, outcome.pose)
        before = self._known.memory.shown.get(subset)
        if before is None or max(crowd(before), crowd(now)) < MIN_WITNESSES:
            return []
        boxes, real = crowd(now), self._real(outcome)
        changed = self.changes(before, now, real)
        if real is None:
            changed = self._known.memory.steadiness.unexpected(boxes, changed)
        likelihood = self._known.model.change(len(outcome.teammates), boxes, changed)
        self._note_changes(outcome.teammates, before, now, real, outcome.pose)
        values = {"boxes": boxes, "changes": changed}
        return [_Finding("change", (), outcome.teammates, likelihood, 1.0, values)]

    def _note_changes(
        self, fused: Hypothesis, before: FloatArray, now: FloatArray, real: Real | None, pose: FloatArray
    ) -> None:
        def places() -> Mapping[str, FloatArray]:
            came, gone = geometry.come_and_gone(before, now, real)
            return {"came": _in_frame(came, pose), "gone": _in_frame(gone, pose)}

        self.differences.append(Difference("change", fused, fused, places))

    def _finding(
        self,
        a: Hypothesis,
        d: Hypothesis,
        pair: PairMeasure,
        weight: float,
        values: Mapping[str, Any],
        misplaced: float = 0.0,
    ) -> _Finding:
        likelihood = self._known.model.pair(len(a), len(d), pair)
        if pair.compared is not None:
            joined = tuple(sorted((*a, *d)))
            self.differences.append(Difference("pair" if a else "ego", joined, a, pair.compared.places))
        values = {**values, "loss": round(pair.loss, 4), "novelty": pair.novelty}
        weight *= DEPENDENCE
        return _Finding("pair" if a else "ego", a, d, likelihood, weight, values, misplaced)

    def _apply(self, finding: _Finding) -> None:
        posterior = self._known.posterior
        before = posterior.marginals()
        masks = posterior.masks(self._known.rows([finding.a, finding.d]))
        cells = posterior.cells(masks[:, :1], masks[:, 1:])[0]
        strangeness = self._known.memory.strangeness
        likelihood = self._neutral(strangeness.weights[finding.test] @ finding.likelihood, cells)
        if finding.misplaced > MISPLACED:
            against = np.exp(min(MISPLACED_MOST, MISPLACED_SLOPE * (finding.misplaced - MISPLACED)))
            likelihood[CLEAN:] *= np.tile([against, 1.0, against], len(likelihood[CLEAN:]) // CELLS)
        weight = self._weight(finding, cells, likelihood)
        strangeness.learn(finding.test, finding.likelihood, cells, weight)
        posterior.learn(masks, weight * np.log(likelihood))
        self._keep(finding, _log_odds(posterior.marginals()) - _log_odds(before))

    def _neutral(self, likelihood: FloatArray, cells: FloatArray) -> FloatArray:
        """The likelihoods, with those of liars as they are on average for the honest: what tells honest messages from
        each other tells nothing about liars.
        """
        lie = self._known.model.lie
        if lie is not None and (clean := float(cells[:CLEAN].sum())) > _TINY:
            first = CLEAN + CELLS * lie
            likelihood[first : first + CELLS] = float(cells[:CLEAN] @ likelihood[:CLEAN]) / clean
        return likelihood

    def _weight(self, finding: _Finding, cells: FloatArray, likelihood: FloatArray) -> float:
        """What a finding counts: a repetition little, and one of a large subset less."""
        memory = self._known.memory
        clean, attacked = (
            float(cells[part] @ likelihood[part]) / max(float(cells[part].sum()), _TINY)
            for part in (slice(CLEAN), slice(CLEAN, None))
        )
        of_a, of_d = self._known.key(finding.a), self._known.key(finding.d)
        test = key(of_d, of_a) if finding.test == "change" else key(of_a, of_d)
        against = attacked > clean
        weight = finding.weight * min(1.0, UNDILUTED_SIZE / (len(finding.a) + len(finding.d)))
        weight *= memory.trust if against else 1.0
        weight *= memory.weigh(test, _REPEATS[finding.test], 1 if against else -1)
        if against:
            counted = self._against[finding.test]
            weight /= 1.0 + SAID_AGAIN * min(counted[name] for name in finding.d)
            for name in finding.d:
                counted[name] += weight
        return weight

    def _keep(self, finding: _Finding, ratios: FloatArray) -> None:
        """Keep a finding as evidence on those (S,) whose log-odds it moved by these ratios."""
        memory = self._known.memory
        for index in np.flatnonzero(np.abs(ratios) >= WORTH_KEEPING):
            name, ratio = self._known.members[index], float(ratios[index])
            if ratio > 0 or name in memory.evidence:
                item = {"frame": memory.frame, "test": finding.test, **finding.values}
                item["teammates"] = list(finding.a or finding.d)
                if finding.a:
                    item["joining"] = list(finding.d)
                item["log_likelihood_ratio"] = round(ratio, 3)
                memory.add_evidence(name, item)


def _said(smaller: Shown | None, larger: Shown | None, joining: Hypothesis) -> tuple[Said, FloatArray] | tuple[()]:
    """What others than the joining say of the boxes of two fusions, and their overlap; nothing where there is no
    testimony.
    """
    if smaller is None or larger is None:
        return ()
    said = Said(smaller.vouched(joining), larger.vouched(joining), larger.in_place(joining))
    return said, larger.overlap(smaller)


def _in_frame(rows: FloatArray, pose: FloatArray) -> FloatArray:
    """Places (n, 2) in the ego's frame of boxes (n, 4) as `geometry.followed` gives them."""
    return (rows[:, :2] - pose[:2, 3]) @ pose[:2, :2]


def _log_odds(p: FloatArray) -> FloatArray:
    kept = np.minimum(np.maximum(p, _CERTAIN), 1 - _CERTAIN)
    odds: FloatArray = np.log(kept / (1 - kept))
    return odds
