"""Group testing: find out who attacks, name them, and answer with everybody else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from robosac.budget import DomainError
from robosac.consensus import DEFAULT_THRESHOLD
from robosac.defenses.group_testing.candidates import unresolved
from robosac.defenses.group_testing.frame import JudgedFrame
from robosac.defenses.group_testing.memory import Memory
from robosac.defenses.group_testing.model import Calibration, CalibrationError, EvidenceModel
from robosac.defenses.group_testing.posterior import Hazards, Posterior
from robosac.defenses.protocol import Conversation, Defense, Reference, State, named_in, remembered, trusted_in
from robosac.defenses.sampling import MAX_BUDGET, check_budget, check_threshold
from robosac.defenses.settings import DefenseSettings

DEFAULT_HAZARDS = Hazards(hijack=0.003, recovery=0.001, change=0.02)
DEFAULT_FIRST_BUDGET = 7
DEFAULT_LATER_BUDGET = 4
DEFAULT_NAMING_BOUND = 0.99
DEFAULT_POSE_ERROR_M = 0.2
"""To reckon with more error than there is costs some sharpness; with less, it names honest teammates."""
COMPARABLE_PERIOD_MS = 250.0
"""Longest period of frames of which one is like the next, as calibrated at 200 ms."""


def default_pose_error_m(calibration: Calibration) -> float:
    """The pose error to expect where none is given: `DEFAULT_POSE_ERROR_M`, if the calibration goes so far."""
    return min(DEFAULT_POSE_ERROR_M, calibration.levels[-1].pose_error_m)


class GroupTestingSettings(DefenseSettings):
    """Bayesian group testing with memory: finds attackers of an unknown number, and names them."""

    needs_calibration = True

    kind: Literal["group_testing"] = "group_testing"
    attack_prior: float = Field(0.5, gt=0, lt=1, description="Probability beforehand that anybody attacks.")
    attacker_prior: float = Field(
        0.25, gt=0, lt=1, description="Probability of each teammate to attack if anybody does."
    )
    hijack: float = Field(
        DEFAULT_HAZARDS.hijack, ge=0, le=0.5, description="Per frame, that a benign teammate becomes an attacker."
    )
    recovery: float = Field(
        DEFAULT_HAZARDS.recovery, ge=0, le=0.5, description="Per frame, that an attacker becomes benign."
    )
    kind_change: float = Field(
        DEFAULT_HAZARDS.change, ge=0, le=0.5, description="Per frame, that the kind of attack changes."
    )
    first_budget: int = Field(
        DEFAULT_FIRST_BUDGET, ge=1, le=MAX_BUDGET, description="Most hypotheses in the first frame."
    )
    budget: int = Field(DEFAULT_LATER_BUDGET, ge=1, le=MAX_BUDGET, description="Most hypotheses in each later frame.")
    naming_bound: float = Field(
        DEFAULT_NAMING_BOUND, ge=0.5, lt=1, description="Probability above which an attacker is named."
    )
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

    def at_period(self, frame_period_ms: float) -> Self:
        """With ``compare_frames`` decided."""
        if self.compare_frames is not None:
            return self
        return self.model_copy(update={"compare_frames": frame_period_ms <= COMPARABLE_PERIOD_MS})

    def at_calibration(self, calibration: Calibration) -> Self:
        """With ``pose_error_m`` decided."""
        if self.pose_error_m is not None:
            return self
        return self.model_copy(update={"pose_error_m": default_pose_error_m(calibration)})

    def build(self, calibration: Calibration | None) -> Defense:
        if calibration is None:
            raise CalibrationError("group_testing needs the calibration of a detector")
        others = self.model_dump(exclude={"kind", "hijack", "recovery", "kind_change"}, exclude_none=True)
        hazards = Hazards(self.hijack, self.recovery, self.kind_change)
        return GroupTesting.calibrated(calibration, hazards=hazards, **others)


@dataclass(frozen=True)
class GroupTesting:
    """Bayesian group testing over the team, with memory; the number of attackers is not assumed.

    1. The posterior over (who attacks, whose view is complementary, kind of attack) goes one frame on: hijacks,
       recoveries.
    2. The next subset is the one with the greatest ``max(0, U(m) - best U so far) + .06 bits(m) - .004``: what it gains
       as an answer, and what it is expected to tell. Nothing above 0, the frame's budget, or the deadline ends the
       search.
    3. A decoded subset is evidence by what it keeps, moves and adds compared with the ego alone and with each part and
       superset decoded in this frame (`geometry.measure`), and by what comes and goes in it since the frame before, if
       it was decoded there too (`geometry.changes`). A repeated test weighs less.
    4. The answer is the decoded subset of greatest utility that is in consensus with the ego, or all trusted.
    5. A teammate is named (``distrusted``) once its probability passes ``naming_bound`` and at least two different
       subsets speak against it; it is cleared when the probability falls below a half.

    An ego that sees fewer than two boxes gives no verdict: its consensus is none, and the answer falls back on the
    trust list (source ``trusted``). Teammates get onto that list by having been in consensus, and stay while their
    suspicion is at most .1. Exact for teams up to 6; see `Posterior` for larger ones.

    Parameters
    ----------
    model : EvidenceModel
        Of the detector it is used with; see `Calibration.at`.
    attack_prior : float
        Probability, before the first frame, that anybody attacks; in (0, 1).
    attacker_prior : float
        Probability of each teammate to attack if anybody does; in (0, 1).
    hazards : Hazards
        Per frame; each in [0, 0.5].
    first_budget, budget : int
        Most hypotheses tested in the first frame, and in later ones.
    naming_bound : float
        In [0.5, 1).
    consensus_threshold : float
        Jaccard index from which on a subset may be answered without trust.
    compare_frames : bool
        Whether what comes and goes from one frame to the next is evidence. Calibrated at 5 frames a second, with an
        ego that knows its own pose: where frames are farther apart, or the ego's pose jumps, honest teammates would
        seem to attack.

    Raises
    ------
    DomainError
        If an argument is outside its range.
    """

    kind: ClassVar[str] = "group_testing"
    reference: ClassVar[Reference] = Reference.EGO

    model: EvidenceModel
    attack_prior: float = 0.5
    attacker_prior: float = 0.25
    hazards: Hazards = DEFAULT_HAZARDS
    first_budget: int = DEFAULT_FIRST_BUDGET
    budget: int = DEFAULT_LATER_BUDGET
    naming_bound: float = DEFAULT_NAMING_BOUND
    consensus_threshold: float = DEFAULT_THRESHOLD
    compare_frames: bool = True

    def __post_init__(self) -> None:
        for name in ("attack_prior", "attacker_prior"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise DomainError(f"{name} must lie strictly between 0 and 1, got {getattr(self, name)}")
        for name, hazard in vars(self.hazards).items():
            if not 0.0 <= hazard <= 0.5:
                raise DomainError(f"the hazard of {name} must be in [0, 0.5], got {hazard}")
        if not 0.5 <= self.naming_bound < 1.0:
            raise DomainError(f"naming_bound must be in [0.5, 1), got {self.naming_bound}")
        check_budget(self.first_budget)
        check_budget(self.budget)
        check_threshold(self.consensus_threshold)

    @classmethod
    def calibrated(cls, calibration: Calibration, pose_error_m: float | None = None, **settings: Any) -> GroupTesting:
        """With the likelihoods of a calibration at the pose error to be expected, metres.

        Raises
        ------
        CalibrationError
            If the calibration does not reach so far.
        """
        expected = default_pose_error_m(calibration) if pose_error_m is None else pose_error_m
        return cls(calibration.at(expected), **settings)

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
        posterior = Posterior.of(len(self.model.kinds), self.attack_prior, self.attacker_prior, sorted(team))
        return _state(posterior, Memory(), (), ())

    def change_team(self, state: State, team: Sequence[str]) -> State:
        """Those who left are remembered; newcomers start at the prior, those who return at what is left of what was
        known of them.
        """
        posterior, memory = self._revive(state)
        self._sync(posterior, memory, joined=team, kept=team)
        kept = [[name for name in of if name in set(team)] for of in (trusted_in(state), named_in(state) or ())]
        return _state(posterior, memory, *kept)

    def converse(self, team: Sequence[str], state: State, rng: np.random.Generator) -> Conversation:
        """Steps 1 to 5, one hypothesis a batch."""
        posterior, memory = self._revive(state)
        self._sync(posterior, memory, joined=team, kept=None)
        first = memory.frame == 0
        if not first:
            posterior.step(self.hazards)
        posterior.regroup(unresolved(posterior.marginals()))
        judged = JudgedFrame(
            self.model, posterior, memory, tuple(team), frozenset(trusted_in(state)), compare_frames=self.compare_frames
        )
        for passes in range(self.first_budget if first else self.budget, 0, -1):
            subset = judged.next_test(rng, passes)
            if subset is None:
                break
            tested = yield [subset]
            if not tested:
                break
            judged.learn(tested[0])
        decision = judged.decide(frozenset(named_in(state) or ()), self.naming_bound)
        memory.frame += 1
        return decision.with_state(_state(posterior, memory, decision.trusted, decision.named))

    def _revive(self, state: State) -> tuple[Posterior, Memory]:
        known, kinds, priors = state["posterior"], len(self.model.kinds), (self.attack_prior, self.attacker_prior)
        if len(known["weights"]) != 1 + kinds:  # calibrated again, for other kinds, since
            members = [name for block in known["blocks"] for name in block["members"]]
            return Posterior.of(kinds, *priors, members), Memory.from_state(state["memory"])
        return Posterior.from_state(known, *priors), Memory.from_state(state["memory"])

    def _sync(self, posterior: Posterior, memory: Memory, joined: Sequence[str], kept: Sequence[str] | None) -> None:
        known = set(posterior.members)
        if known == set(joined):
            return
        suspicion = dict(zip(posterior.members, map(float, posterior.marginals()), strict=True))
        for name in sorted(known - set(joined if kept is None else kept)) if kept is not None else ():
            memory.leave(name, suspicion[name])
            posterior.remove(name)
        for name in sorted(set(joined) - known):
            posterior.add(name, memory.welcome(name, self.attack_prior * self.attacker_prior))


def _state(posterior: Posterior, memory: Memory, trusted: Sequence[str], named: Sequence[str]) -> State:
    return remembered(
        {"posterior": posterior.to_state(), "memory": memory.to_state()},
        trusted=trusted,
        named=named,
        suspicion=dict(sorted(zip(posterior.members, posterior.marginals().round(6).tolist(), strict=True))),
    )
