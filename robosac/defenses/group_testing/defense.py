"""Group testing: find out who attacks, name them, and answer with everybody else."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from robosac.consensus import DEFAULT_THRESHOLD
from robosac.defenses.batch import Batch
from robosac.defenses.group_testing.calibration import Calibration
from robosac.defenses.group_testing.candidates import unresolved
from robosac.defenses.group_testing.evidence import Evidence
from robosac.defenses.group_testing.findings import Findings
from robosac.defenses.group_testing.frame import JudgedFrame
from robosac.defenses.group_testing.inspection import FEWEST_TO_ASK, Inspection
from robosac.defenses.group_testing.knowledge import Knowledge, remember
from robosac.defenses.group_testing.memory import Memory
from robosac.defenses.group_testing.model import CalibrationError, EvidenceModel
from robosac.defenses.group_testing.posterior import Hazards, Posterior
from robosac.defenses.protocol import Asking, Conversation, Hypothesis, Reference, State, named_in, trusted_in
from robosac.defenses.sampling import MAX_BUDGET
from robosac.defenses.settings import LEAST, DefenseSettings

DEFAULT_POSE_ERROR_M = 0.2
"""To expect more error than there is costs some sharpness; to expect less names honest teammates."""
CALIBRATED_PERIOD_MS = 200.0
COMPARABLE_PERIOD_MS = 250.0
"""Longest period of frames of which one is like the next, as calibrated at `CALIBRATED_PERIOD_MS`."""
LEAST_PERIOD_MS, LONGEST_PERIOD_MS = 1.0, 60_000.0
HIJACKED_OF = 10
"""In larger teams as many teammates are hijacked from frame to frame as in a team of so many."""


class GroupTestingSettings(DefenseSettings):
    """Bayesian group testing with memory: finds attackers of an unknown number, and names them."""

    needs_calibration = True

    kind: Literal["group_testing"] = "group_testing"
    attack_prior: float = Field(0.5, gt=0, lt=1, description="Probability beforehand that anybody attacks.")
    attacker_prior: float = Field(
        0.25, gt=0, lt=1, description="Probability of each teammate to attack if anybody does."
    )
    hijack: float = Field(
        0.003,
        ge=0,
        le=0.5,
        description="Per frame, that a benign teammate becomes an attacker; of a team of more than "
        f"{HIJACKED_OF}, so much less that as many do as of {HIJACKED_OF}.",
    )
    recovery: float = Field(0.001, ge=0, le=0.5, description="Per frame, that an attacker becomes benign.")
    kind_change: float = Field(0.02, ge=0, le=0.5, description="Per frame, that the kind of attack changes.")
    budgets: ClassVar[tuple[str, ...]] = ("first_budget", "budget")
    first_budget: int = Field(7, ge=1, le=MAX_BUDGET, description="Most hypotheses in the first frame.")
    budget: int = Field(4, ge=1, le=MAX_BUDGET, description="Most hypotheses in each later frame.")
    naming_bound: float = Field(0.99, ge=0.5, lt=1, description="Probability above which an attacker is named.")
    consensus_threshold: float = Field(DEFAULT_THRESHOLD, gt=0, le=1, description="Jaccard index of a consensus.")
    pose_error_m: float | None = Field(
        None,
        ge=0,
        description="Standard deviation of the teammates' positions to expect, metres; by default "
        f"{DEFAULT_POSE_ERROR_M:g}, or the largest that the detector is calibrated for, if that is less.",
    )
    compare_frames: bool | None = Field(
        None,
        description="Whether boxes that come and go from frame to frame are evidence, as calibrated at 5 frames a "
        "second and with exact poses of the ego; by default if frame_period_ms is at most "
        f"{COMPARABLE_PERIOD_MS:g}.",
    )

    frame_period_ms: float | None = Field(
        None,
        gt=0,
        le=LONGEST_PERIOD_MS,
        description="Time between two frames, to tell by how much a message is late; by default the session's "
        f"frame_period_ms, or {CALIBRATED_PERIOD_MS:g}.",
    )
    judge_objects: bool = Field(
        True, description="Whether single objects are judged by testimony, if the detector has a witness."
    )
    keep_contradicted: bool = Field(
        False, description="Whether boxes that are contradicted stay in the answer, marked; by default they are apart."
    )
    inspections: int = Field(
        4, ge=0, le=MAX_BUDGET, description="Most further hypotheses a frame to see who is behind a false object."
    )

    def at_period(self, frame_period_ms: float) -> Self:
        """With ``compare_frames`` and ``frame_period_ms`` decided."""
        decided = {"compare_frames": frame_period_ms <= COMPARABLE_PERIOD_MS, "frame_period_ms": frame_period_ms}
        return self.model_copy(update={name: value for name, value in decided.items() if getattr(self, name) is None})

    def at_calibration(self, calibration: Calibration) -> Self:
        """With ``pose_error_m`` decided."""
        if self.pose_error_m is not None:
            return self
        most = calibration.levels[-1].pose_error_m
        return self.model_copy(update={"pose_error_m": min(DEFAULT_POSE_ERROR_M, most)})

    def build(self, calibration: Calibration | None) -> GroupTesting:
        """The defence, with the likelihoods of a calibration at the pose error to be expected.

        Raises
        ------
        CalibrationError
            If there is no calibration, or it does not reach so far.
        """
        if calibration is None:
            raise CalibrationError("group_testing needs the calibration of a detector")
        decided = self.at_calibration(calibration)
        model = calibration.at(decided.pose_error_m or 0.0)
        return GroupTesting(model.with_lies if calibration.witnessed and decided.judge_objects else model, decided)


@dataclass(frozen=True)
class GroupTesting:
    """Bayesian group testing over the team, with memory; the number of attackers is not assumed.

    1. The posterior over (who attacks, whose view is complementary, kind of attack) goes one frame on: hijacks, as many
       in a large team as in one of `HIJACKED_OF`, or somebody would always be in doubt there; recoveries. Neither is
       ever impossible: what is remembered is rounded, and from 0 no evidence leads back.
    2. The next subset is the one with the greatest ``max(0, U(m) - best U so far) + .06 bits(m) - .004``: what it gains
       as an answer, and what it is expected to tell. Nothing above 0, the frame's budget, or the deadline ends the
       search. Where the frame before had time for one pass alone, what the first is expected to tell counts
       `choice.LASTING` times.
    3. A decoded subset is evidence by what it keeps, moves and adds compared with the ego alone and with each part and
       superset decoded in this frame (`geometry.measure`), and by what comes and goes in it since the frame before, if
       it was decoded there too (`geometry.changes`). A repeated test weighs less. So does what speaks against somebody
       in the first frame, and where the ego itself is less steady than where the likelihoods were calibrated
       (`Steadiness.trust`). How much less honest messages agree in this world is learned (`Strangeness`).
    4. Where there is testimony, up to ``inspections`` further subsets are decoded: to ask those again that are left
       out, and to see without whom an object is right that is wrong in the answer (`Inspection.next_test`). Lies raise
       a teammate's level (`lies.RULES`) and its probability.
    5. The answer is the decoded subset of greatest utility that is in consensus with the ego, or all trusted. Each box
       of it is judged by testimony: left out, repaired, or kept with its status (`standing.judge`). Whoever is out of
       place (`placing.misplaced`) has no part in it, nor in step 2. If one of the answer turns out to be so, the others
       are decoded besides.
    6. A teammate is named (``distrusted``) once it lied about objects too often (`Lies.guilt`; where the ego is
       unsteady, twice as much) and its probability is at least a half;
       or once its probability passes ``naming_bound``, at least two different subsets speak against it, and its own
       fusions are much less steady than the ego's perception (`Steadiness.names`). It is cleared when the probability
       falls below a half.

    Without testimony step 4 and the judging of step 5 fall away, and whoever is named is named for suspicion and
    unsteadiness together.

    An ego that sees fewer than two boxes gives no verdict: its consensus is none, and the answer falls back on the
    trust list (source ``trusted``). Teammates get onto that list by having been in consensus, and stay while their
    suspicion is at most .1. Exact for teams up to 6; see `Posterior` for larger ones.
    """

    kind: ClassVar[str] = "group_testing"
    reference: ClassVar[Reference] = Reference.EGO

    model: EvidenceModel
    """Of the detector it is used with; see `Calibration.at`."""
    settings: GroupTestingSettings = field(default_factory=GroupTestingSettings)
    """Frames are compared (``compare_frames``) unless they say no. What comes and goes from one frame to the next is
    evidence only for an ego that knows its own pose, at about 5 frames a second: else honest teammates would seem to
    attack.
    """
    evidence: type[Evidence] = Evidence
    """Reads the outcomes; another one than `Evidence` where they are drawn and not decoded."""

    @property
    def asks_witnesses(self) -> bool:
        """Whether objects are judged by testimony."""
        return self.model.lie is not None

    @property
    def lacks_witness(self) -> bool:
        """Whether objects are to be judged, and the detector has no witness for it."""
        return self.settings.judge_objects and not self.asks_witnesses

    @property
    def consensus_threshold(self) -> float:
        """Jaccard index from which on a subset may be answered without trust."""
        return self.settings.consensus_threshold

    def check_team(self, team_size: int) -> None:
        """Any team will do."""

    def initial_state(self, team: Sequence[str]) -> State:
        """The prior.

        Returns
        -------
        dict
            ``posterior``, ``memory`` (see `Posterior.to_state`, `Memory.to_state`); ``trusted``, ``named``, lists of
            teammates; ``suspicion`` by teammate.
        """
        return remember(self._prior(sorted(team)), Memory(), (), ())

    def change_team(self, state: State, team: Sequence[str]) -> State:
        """Those who left are remembered; newcomers start at the prior, those who return at what is left of what was
        known of them.
        """
        posterior, memory = self._revive(state)
        suspicion = dict(zip(posterior.members, posterior.marginals().tolist(), strict=True))
        named = set(named_in(state) or ())
        for name in sorted(suspicion.keys() - set(team)):
            memory.leave(name, suspicion[name], name in named)
            posterior.remove(name)
        named |= self._welcome(posterior, memory, team)
        trusted = [name for name in trusted_in(state) if name in set(team)]
        return remember(posterior, memory, trusted, [name for name in posterior.members if name in named])

    def converse(self, team: Sequence[str], state: State, rng: np.random.Generator) -> Conversation:
        """Steps 1 to 6, one hypothesis a batch."""
        settings = self.settings
        posterior, memory = self._revive(state)
        returned = self._welcome(posterior, memory, team)
        first = memory.frame == 0
        if not first:
            told = settings.hijack, settings.recovery, settings.kind_change
            hijack, recovery, change = (max(hazard, LEAST) for hazard in told)
            hijack *= HIJACKED_OF / max(HIJACKED_OF, len(posterior.members))
            posterior.step(Hazards(hijack, recovery, change))
            memory.strangeness.step()
        posterior.regroup(unresolved(posterior.marginals()))
        period_s = max(LEAST_PERIOD_MS, settings.frame_period_ms or CALIBRATED_PERIOD_MS) / 1e3
        known = Knowledge(self.model, posterior, memory, period_s)
        evidence = self.evidence(known, compare_frames=settings.compare_frames is not False)
        judged = JudgedFrame(known, evidence, tuple(team), frozenset(trusted_in(state)))
        named = returned.union(named_in(state) or ())
        inspection = Inspection(Findings(known, memory.lies, tuple(team), named), settings.keep_contradicted)
        passes, inspections = settings.first_budget if first else settings.budget, settings.inspections
        most = passes + inspections
        clearing = self.asks_witnesses and inspections < FEWEST_TO_ASK  # else nobody might ever be cleared of a lie

        def decode(subset: Hypothesis) -> Asking[bool]:
            tested = yield Batch([subset], partial(_likely, subset, tuple(team), judged, known))
            if tested:
                evidence.learn(tested[0], inspection.learn(tested[0]))
            return bool(tested)

        in_time = True
        while in_time:
            subset = judged.next_test(rng, passes) if passes > 0 else None
            if subset is None and passes > 0 and clearing:
                best = judged.best_answer()
                subset = inspection.asked_again(best)
                if subset is None and not settings.inspections:  # nor might a liar ever be left out of an answer
                    subset = inspection.next_test(best)
            passes -= 1
            if subset is None:
                passes, inspections = 0, inspections - 1
                subset = inspection.next_test(judged.best_answer()) if inspections >= 0 else None
            if subset is None:
                break
            in_time = yield from decode(subset)
        inspection.conclude(judged.best_answer())
        if in_time and len(evidence.outcomes) < most and (subset := judged.in_place()) is not None:
            yield from decode(subset)
        memory.hurried = len(evidence.outcomes) == 1 and (most == 1 or not in_time)
        evidence.compare_singles()
        return judged.decide(named, settings.naming_bound, inspection)

    def _prior(self, team: Sequence[str]) -> Posterior:
        return Posterior(len(self.model.kinds), self.settings.attack_prior, self.settings.attacker_prior, team)

    def _revive(self, state: State) -> tuple[Posterior, Memory]:
        known, memory = state["posterior"], Memory.from_state(state["memory"])
        if len(known["weights"]) != 1 + len(self.model.kinds):  # calibrated again, for other kinds, since
            return self._prior([name for block in known["blocks"] for name in block["members"]]), memory
        return Posterior.from_state(known, self.settings.attack_prior, self.settings.attacker_prior), memory

    def _welcome(self, posterior: Posterior, memory: Memory, team: Sequence[str]) -> frozenset[str]:
        """Let those join who are new in the team. Given are those of them who were named when they left."""
        prior, named = self.settings.attack_prior * self.settings.attacker_prior, list[str]()
        for name in sorted(set(team) - set(posterior.members)):
            suspicion, was_named = memory.welcome(name, prior)
            posterior.add(name, suspicion)
            named += [name] if was_named else []
        return frozenset(named)


def _likely(subset: Hypothesis, team: Hypothesis, judged: JudgedFrame, known: Knowledge) -> Iterator[Hypothesis]:
    """What may be asked for next: a subset, what would be answered now, and the team; each also without one of them,
    the most suspected first.
    """
    suspicion = known.suspicion()
    for whole in (subset, judged.best_answer(), team):
        yield whole
        for left_out in sorted(whole, key=lambda name: -suspicion[name]):
            yield tuple(name for name in whole if name != left_out)
