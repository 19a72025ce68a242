"""What a decision's record says against itself."""

from __future__ import annotations

from collections.abc import Collection, Iterator

from robosac.answers import Reason, Source, Verdict
from robosac.audit.events import FrameAnswered


def contradictions(
    answer: FrameAnswered,
    *,
    ego_id: str | None,
    threshold: float | None,
    trusted: Collection[str] | None,
    team: Collection[str] | None,
) -> Iterator[str]:
    """Everything that cannot be true together in a record. What needs an argument that is None is not checked.

    Parameters
    ----------
    answer : FrameAnswered
    ego_id : str or None
    threshold : float or None
        Jaccard index from which on a hypothesis is in consensus.
    trusted : collection of str or None
        The trust list before the frame.
    team : collection of str or None
        The teammates enrolled in the frame.
    """
    yield from _of_answer(answer, trusted)
    yield from _of_hypotheses(answer, threshold)
    yield from _of_messages(answer, ego_id)
    if team is not None:
        yield from _of_team(answer, set(team))


def _of_answer(answer: FrameAnswered, trusted: Collection[str] | None) -> Iterator[str]:
    accepted = set(answer.accepted)
    verified = [set(o.teammates) for o in answer.hypotheses if o.verdict is Verdict.CONSENSUS]
    if answer.source is Source.EGO_ONLY:
        if accepted:
            yield f"an ego-only answer with {_listed(accepted)}"
    elif not accepted:
        yield f"an answer from {answer.source} that accepts nobody"
    elif answer.source is Source.CONSENSUS:
        if accepted not in verified:
            yield f"no hypothesis of {_listed(accepted)} is in consensus"
    elif trusted is not None and not accepted <= set(trusted):
        yield f"{_listed(accepted - set(trusted))} accepted as trusted, but not on the trust list before"
    if trusted is not None:
        gained = set(answer.trusts) - set(trusted).union(*verified)
        if gained:
            yield f"{_listed(gained)} on the trust list without a consensus"


def _of_hypotheses(answer: FrameAnswered, threshold: float | None) -> Iterator[str]:
    if answer.sampling_steps != len(answer.hypotheses):
        yield f"{answer.sampling_steps} sampling steps, but {len(answer.hypotheses)} hypotheses"
    tested: set[str] = set().union(*(o.teammates for o in answer.hypotheses))
    contradicted: set[str] = set().union(*(o.teammates for o in answer.hypotheses if o.verdict is Verdict.DISSENSUS))
    blamed = {
        name
        for name, why in answer.rejected.items()
        # one that is judged by rank has passed the threshold perhaps, but not gone untested
        if why.reason is Reason.DISSENSUS and name not in (tested if hasattr(why, "p_value") else contradicted)
    }
    if blamed:
        yield f"{_listed(blamed)} rejected for a dissensus, but in no hypothesis of that verdict"
    if threshold is None:
        return
    for i, outcome in enumerate(answer.hypotheses):
        agrees = outcome.jaccard_index >= threshold
        if outcome.verdict is not Verdict.NO_EVIDENCE and agrees != (outcome.verdict is Verdict.CONSENSUS):
            yield f"hypothesis {i} is in {outcome.verdict} at {outcome.jaccard_index:g}; the threshold is {threshold:g}"


def _of_messages(answer: FrameAnswered, ego_id: str | None) -> Iterator[str]:
    accepted, rejected = set(answer.accepted), set(answer.rejected)
    if accepted & rejected:
        yield f"{_listed(accepted & rejected)} both accepted and rejected"
    silent = accepted.union(*(o.teammates for o in answer.hypotheses)) - set(answer.messages)
    if silent:
        yield f"{_listed(silent)} fused without a message"
    alike = {id(support): support for support in answer.support or ()}  # one object for many boxes
    supports = (*alike.values(), *(answer.contradicted or ()))
    told: set[str] = set().union(*(s.witnesses for s in supports), *(s.deniers for s in supports))
    unheard = told - set(answer.messages)
    if unheard:
        yield f"boxes stand or fall on the word of {_listed(unheard)}, without a message"
    if ego_id is None:
        return
    if ego_id not in answer.messages:
        yield f"no message of the ego, {ego_id}"
    ignored = set(answer.messages) - accepted - rejected - {ego_id}
    if ignored:
        yield f"{_listed(ignored)} neither accepted nor rejected"


def _of_team(answer: FrameAnswered, team: set[str]) -> Iterator[str]:
    strangers = set(answer.accepted).union(*(o.teammates for o in answer.hypotheses)) - team
    if strangers:
        yield f"{_listed(strangers)} fused without being enrolled"
    unmentioned = team - set(answer.accepted) - set(answer.rejected) - set(answer.messages)
    if unmentioned:
        yield f"{_listed(unmentioned)} enrolled, but neither accepted nor rejected"


def _listed(names: Collection[str]) -> str:
    return ", ".join(sorted(names))
