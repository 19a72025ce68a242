"""What defences share that test groups of teammates in every frame anew, whatever the attacker ratio."""

from __future__ import annotations

from collections.abc import Collection, Generator, Sequence
from dataclasses import dataclass

from robosac.answers import Source, Verdict
from robosac.consensus import DEFAULT_THRESHOLD
from robosac.defenses.protocol import Decision, Hypothesis, Outcome, Reference, Rejection, State, explain_rejections
from robosac.defenses.sampling import check_threshold


@dataclass(frozen=True)
class Memoryless:
    """Settings and state of such a defence.

    Parameters
    ----------
    consensus_threshold : float
        Jaccard index from which on two perceptions agree.
    reference : Reference
        What hypotheses are compared with.

    Raises
    ------
    DomainError
        If an argument is outside its range.
    """

    consensus_threshold: float = DEFAULT_THRESHOLD
    reference: Reference = Reference.EGO

    def __post_init__(self) -> None:
        check_threshold(self.consensus_threshold)

    def initial_state(self, team: Sequence[str]) -> State:  # noqa: ARG002
        """Nothing is remembered between frames."""
        return {}

    def change_team(self, state: State, team: Sequence[str]) -> State:  # noqa: ARG002
        """Nothing is remembered between frames."""
        return state

    def check_team(self, team_size: int) -> None:
        """Any team will do."""


def unite(
    team: Sequence[str], passed: Collection[str], outcomes: list[Outcome]
) -> Generator[Sequence[Hypothesis], Sequence[Outcome], Hypothesis]:
    """Fuse all that passed their tests, and verify that fusion too.

    Several groups, each in consensus, need not be in consensus together. If they are not, or the time is up, the answer
    is the largest hypothesis in consensus among them (of several the one with the highest Jaccard index).

    Parameters
    ----------
    team : sequence of str
    passed : collection of str
    outcomes : list of Outcome
        Of this frame; the last test is appended.

    Returns
    -------
    tuple of str
        Verified in this frame; empty if nothing was.
    """
    together = tuple(name for name in team if name in passed)
    if together and all(outcome.teammates != together for outcome in outcomes):
        outcomes.extend((yield [together]))
    verified = [o for o in outcomes if o.verdict is Verdict.CONSENSUS and set(o.teammates) <= set(together)]
    best = max(verified, key=lambda o: (len(o.teammates), o.jaccard_index), default=None)
    return best.teammates if best is not None else ()


def decide(
    team: Sequence[str],
    accepted: Hypothesis,
    outcomes: Sequence[Outcome],
    state: State,
    accused: dict[str, Rejection] | None = None,
) -> Decision:
    """The decision with this answer; ``accused`` says why, where the outcomes alone don't."""
    reasons = explain_rejections(team, accepted, outcomes) | {
        name: reason for name, reason in (accused or {}).items() if name not in accepted
    }
    return Decision(
        accepted=accepted,
        source=Source.CONSENSUS if accepted else Source.EGO_ONLY,
        rejected=reasons,
        attacker_ratio=None,
        state=state,
    )
