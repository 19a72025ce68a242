"""How a defence talks to whoever runs it.

A defence is a conversation: a generator that yields a batch of hypotheses (subsets of the team), is sent an `Outcome`
for each that was tested, and returns a `Decision`. It knows nothing of detectors or clocks. If it is sent fewer
outcomes than it proposed hypotheses, the time is up: it must return its decision from what it knows. A
`robosac.defenses.Batch` also tells what it is likely to propose later.

What a defence remembers between frames is its *state*, a plain dict of JSON values that the caller keeps per session.
Most of it only the defence reads. Others read whom it trusts, names and suspects: `remembered` writes that, and
`trusted_in`, `named_in` and `suspicion_in` read it. No other code knows its keys.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Generator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Protocol, TypeVar

import numpy as np

from robosac.answers import Distrust, Reason, Source, Support, Verdict
from robosac.boxes import FloatArray
from robosac.testimony import Testimony

Hypothesis = tuple[str, ...]
State = Mapping[str, Any]
EGO = ""
"""The ego among witnesses and deniers: a defence knows only the ids of teammates, and no vehicle is called so."""


def remembered(
    memory: Mapping[str, Any],
    *,
    trusted: Sequence[str] | None = None,
    named: Sequence[str] | None = None,
    suspicion: Mapping[str, float] | None = None,
) -> State:
    """A state of these parts; what is None is not in it.

    Parameters
    ----------
    memory : mapping
        What the defence alone reads, JSON values.
    trusted : sequence of str, optional
        Teammates whose messages may be used without a test in the next frame. A teammate gets onto that list only by
        having been in consensus, or because the defence's settings say so from the start.
    named : sequence of str, optional
        Teammates held to be attackers; give an empty list for nobody yet.
    suspicion : mapping of teammate id to float, optional
        Probability that each teammate attacks.
    """
    state = dict(memory)
    if trusted is not None:
        state["trusted"] = list(trusted)
    if named is not None:
        state["named"] = list(named)
    if suspicion is not None:
        state["suspicion"] = dict(suspicion)
    return state


def trusted_in(state: State) -> tuple[str, ...]:
    """The trust list of a state; empty where the defence keeps none.

    Raises
    ------
    ValueError
        If there are no names where it should be, as only a damaged log can have it.
    """
    trusted = state.get("trusted", ())
    if not (isinstance(trusted, list | tuple) and all(isinstance(name, str) for name in trusted)):
        raise ValueError("trusted must hold names")
    return tuple(trusted)


def named_in(state: State) -> tuple[str, ...] | None:
    """Teammates held to be attackers; None from a defence that names nobody."""
    return tuple(state["named"]) if "named" in state else None


def suspicion_in(state: State) -> Mapping[str, float] | None:
    """Probability that each teammate attacks, as it is kept between frames; None from a defence that knows none."""
    return state.get("suspicion")


class Reference(StrEnum):
    """What the fusion of a hypothesis is compared with."""

    EGO = "ego"
    """The ego's own perception of the frame."""
    PREVIOUS = "previous"
    """The previous frame's answer, moved on by a frame; saves the pass of the ego's own perception."""


@dataclass(frozen=True)
class Outcome:
    """A tested hypothesis."""

    teammates: Hypothesis
    jaccard_index: float
    """Against the reference, in [0, 1]."""
    verdict: Verdict
    boxes: FloatArray | None = field(default=None, compare=False, repr=False)
    """(n, 6): all that was decoded, with scores; ego frame. None where only the verdict is known."""
    reference: FloatArray | None = field(default=None, compare=False, repr=False)
    """(m, 6): what took part in the comparison on the reference's side."""
    pose: FloatArray | None = field(default=None, compare=False, repr=False)
    """(4, 4): world_from_sensor of the ego. None where it is not known."""
    frame: int = field(default=0, compare=False, repr=False)
    """Its number; frames of successive numbers are one frame period apart."""
    testimony: Testimony | None = field(default=None, compare=False, repr=False)
    """What each message of the frame says by itself, the ego's under `EGO`; the same in all outcomes of a frame. None
    where the detector has no witness, or the defence does not ask for it.
    """
    alone: FloatArray | None = field(default=None, compare=False, repr=False)
    """(k, 6): all that the ego alone sees, with scores; ego frame. None where it was not decoded."""


@dataclass(frozen=True)
class Rejection:
    """Why one teammate was left out."""

    reason: Reason
    evidence: Mapping[str, Any] = field(default_factory=dict)
    """JSON values; for ``dissensus`` the indices of the hypotheses that speak against the teammate and their lowest
    Jaccard index.
    """
    distrust: Distrust | None = None
    """Why, if the reason is ``distrusted``; may be left out of a teammate that the state names."""


@dataclass(frozen=True)
class JudgedBox:
    """A box of this frame, and on whose word it stands."""

    subset: Hypothesis
    """Whose fusion showed it, as it was proposed; empty for the ego alone."""
    index: int
    """Its row among the boxes of that fusion, from 0 on."""
    support: Support
    """Ids are of teammates, or `EGO`."""


@dataclass(frozen=True, eq=False)
class Difference:
    """What one decoded fusion shows otherwise than another, box by box: what a defence counts as evidence."""

    test: str
    """As evidence on a teammate calls it."""
    teammates: Hypothesis
    """Whose fusion shows it."""
    beside: Hypothesis
    """Whose fusion it is compared with: empty for the ego alone, the same for itself in the frame before."""
    places: Callable[[], Mapping[str, FloatArray]]
    """Gives by what happened there, such as ``lost``, the places (n, 2): ego frame, metres. Only pictures call it."""


Judged = tuple[tuple[JudgedBox, ...], tuple[JudgedBox, ...]]
"""Boxes of an answer, and those that are left out of it because they are contradicted."""


@dataclass(frozen=True)
class Decision:
    """What a defence concludes about a frame."""

    accepted: Hypothesis
    """The subset whose fusion is the answer; empty for ``ego_only``. For ``consensus`` it must be one that was in
    consensus in this frame, for ``trusted`` all of it must be on the trust list that the frame began with.
    """
    source: Source
    rejected: Mapping[str, Rejection]
    """By teammate id: every teammate of the frame that is not accepted."""
    attacker_ratio: float | None
    """Assumed or estimated share of attackers in the team."""
    state: State
    """To be handed to the next frame's conversation; see `remembered`."""
    suspicion: Mapping[str, float] | None = None
    """By teammate id: probability that each teammate of the session attacks; None from a defence that knows none."""
    objects: tuple[JudgedBox, ...] | None = None
    """The boxes of the answer, each from the accepted subset or a part of it. None: all boxes of the accepted subset,
    as they were decoded.
    """
    contradicted: tuple[JudgedBox, ...] = ()
    """Boxes that are left out of ``objects`` and told apart from them."""
    judge: Callable[[FloatArray, Testimony], Judged] | None = field(default=None, compare=False, repr=False)
    """From a defence that judges boxes, but has not seen those of the accepted subset: gives ``objects`` and
    ``contradicted`` by all boxes (n, 6) of that subset, ego frame, and the frame's testimony. It is asked where there
    is testimony.
    """
    differences: tuple[Difference, ...] = field(default=(), compare=False, repr=False)
    """What was found by comparing fusions, from a defence that compares them box by box. For whoever looks on: it is
    neither answered nor kept.
    """

    @property
    def trusted(self) -> tuple[str, ...]:
        """Teammates that the next frame may use without a test."""
        return trusted_in(self.state)

    @property
    def named(self) -> tuple[str, ...] | None:
        """Teammates held to be attackers; None from a defence that names nobody."""
        return named_in(self.state)


_Result = TypeVar("_Result")
Asking = Generator[Sequence[Hypothesis], Sequence[Outcome], _Result]
"""A part of a conversation: yields batches of hypotheses, is sent their outcomes, and returns what came of it."""
Conversation = Asking[Decision]


class Defense(Protocol):
    """A defence's settings and its conversation. Implementations are immutable.

    One that has a true ``asks_witnesses`` is given testimony with every outcome, where the detector has a witness.
    """

    @property
    def kind(self) -> str:
        """Its name in settings and logs."""

    @property
    def consensus_threshold(self) -> float:
        """Jaccard index from which on a hypothesis is in consensus."""

    @property
    def reference(self) -> Reference:
        """What hypotheses are compared with."""

    def initial_state(self, team: Sequence[str]) -> State:
        """State of a session with this team before its first frame."""

    def change_team(self, state: State, team: Sequence[str]) -> State:
        """State after teammates joined or left; ``team`` is the new one."""

    def check_team(self, team_size: int) -> None:
        """Raise `robosac.budget.DomainError` if the settings make no sense for a team of this size."""

    def converse(self, team: Sequence[str], state: State, rng: np.random.Generator) -> Conversation:
        """The conversation about one frame with the teammates present in it."""


def explain_rejections(
    team: Sequence[str],
    accepted: Collection[str],
    outcomes: Sequence[Outcome],
    otherwise: Rejection = Rejection(Reason.NOT_SAMPLED),
) -> dict[str, Rejection]:
    """A reason for every teammate that is not accepted, from the outcomes of the frame.

    Those that no outcome speaks against are rejected as ``otherwise`` says.
    """
    rejected = {}
    for teammate in team:
        if teammate in accepted:
            continue
        against = [i for i, o in enumerate(outcomes) if teammate in o.teammates and o.verdict is Verdict.DISSENSUS]
        if against:
            lowest = min(outcomes[i].jaccard_index for i in against)
            rejected[teammate] = Rejection(Reason.DISSENSUS, {"hypotheses": against, "lowest_jaccard_index": lowest})
        else:
            rejected[teammate] = otherwise
    return rejected


def conclude(
    team: Sequence[str],
    accepted: Hypothesis,
    outcomes: Sequence[Outcome],
    state: State,
    *,
    attacker_ratio: float | None = None,
    accused: Mapping[str, Rejection] | None = None,
) -> Decision:
    """The decision of a defence that trusts nobody: a subset in consensus, or, if that is empty, the ego alone.

    Parameters
    ----------
    team, accepted, outcomes, state, attacker_ratio
        As in `explain_rejections` and `Decision`.
    accused : mapping of teammate id to Rejection, optional
        Why some are left out, where the outcomes alone do not say it.
    """
    said = {name: why for name, why in (accused or {}).items() if name not in accepted}
    return Decision(
        accepted=accepted,
        source=Source.CONSENSUS if accepted else Source.EGO_ONLY,
        rejected=explain_rejections(team, accepted, outcomes) | said,
        attacker_ratio=attacker_ratio,
        state=state,
    )
