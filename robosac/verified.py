"""What a defence asks for and decides, held against what was verified in the frame or trusted before it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import TypeVar

import rfc8785

from robosac.answers import Source
from robosac.arguments import by_text
from robosac.budget import DomainError
from robosac.defenses import Decision, Defense, Hypothesis, State, shipped
from robosac.faults import in_one_line
from robosac.provenance import Decoded, UnverifiedAnswer, unfounded

T = TypeVar("T")


def check_team_size(defense: Defense, team_size: int) -> None:
    """Refuse a team for which a defence's settings make no sense, or of which it cannot say so: `DomainError`."""
    _asked(defense, "check_team", lambda: defense.check_team(team_size))


def first_state(defense: Defense, team: Sequence[str]) -> State:
    """What a defence remembers before its first frame; `DomainError` if it fails, or nobody could keep that."""
    return _state(defense, "initial_state", lambda: defense.initial_state(list(team)))


def state_of_team(defense: Defense, state: State, team: Sequence[str]) -> State:
    """What it remembers after teammates joined or left; ``team`` is the new one. It fails as `first_state`."""
    return _state(defense, "change_team", lambda: defense.change_team(state, list(team)))


def _state(defense: Defense, part: str, ask: Callable[[], State]) -> State:
    state = _asked(defense, part, ask)
    if defense.kind in shipped():
        return state
    if not isinstance(state, Mapping):
        raise DomainError(f"{defense.kind}: {part} must return a dict of JSON values, got a {type(state).__name__}")
    _asked(defense, f"{part} must return a dict of JSON values", lambda: rfc8785.dumps(dict(state)))
    return state


def _asked(defense: Defense, part: str, ask: Callable[[], T]) -> T:
    try:
        return ask()
    except DomainError:
        raise
    except Exception as error:  # the user's code may raise anything
        raise DomainError(f"{defense.kind}: {part}: {in_one_line(error)}") from error


def check_asked(defense: Defense, batch: Sequence[Hypothesis], team: Sequence[str]) -> None:
    """Refuse hypotheses of a defence that are none: `TypeError` or `ValueError`. Those that ship are not looked at."""
    if defense.kind in shipped():
        return
    if not isinstance(batch, Iterable):
        raise TypeError(f"{defense.kind}: converse must yield lists of hypotheses, got a {type(batch).__name__}")
    for subset in batch:
        if not isinstance(subset, tuple) or not set(team).issuperset(subset):
            what = f"converse asked for {subset!r}; a hypothesis is a tuple of teammates, who are {', '.join(team)}"
            raise ValueError(f"{defense.kind}: {what}")


def check_objects(defense: Defense, decision: Decision, decoded: Decoded) -> None:
    """Refuse boxes that are not the defence's to answer with: `robosac.provenance.UnverifiedAnswer`."""
    if doubt := next(unfounded(decision, decoded), None):
        raise UnverifiedAnswer(f"{defense.kind} {doubt}")


def check_decided(
    defense: Defense,
    decision: Decision,
    team: Sequence[str],
    verified: Collection[Hypothesis],
    trusted: set[str],
    decoded: Decoded,
) -> None:
    """Nothing reaches the answer that was not verified in this frame or trusted before; nor does trust come from less.
    And what is to be remembered can be.

    Parameters
    ----------
    defense : Defense
    decision : Decision
        Its own.
    team : sequence of str
        Teammates that are in the frame, in order.
    verified : collection of tuple of str
        Subsets in consensus with the ego in this frame.
    trusted : set of str
        The trust list that the frame began with.
    decoded : mapping of subset to (n, 6) ndarray

    Raises
    ------
    TypeError
        If it is no decision.
    UnverifiedAnswer
        If it does not hold.
    """
    if not isinstance(decision, Decision):
        raise TypeError(f"{defense.kind}: converse must return a Decision, got a {type(decision).__name__}")
    allowed = {
        Source.CONSENSUS: bool(decision.accepted) and decision.accepted in verified,
        Source.TRUSTED: bool(decision.accepted) and trusted.issuperset(decision.accepted),
        Source.EGO_ONLY: not decision.accepted,
    }
    if not allowed[decision.source]:
        raise UnverifiedAnswer(f"{defense.kind} answered {decision.source} with {decision.accepted}")
    if sorted([*decision.accepted, *decision.rejected]) != list(team):
        raise UnverifiedAnswer(f"{defense.kind} neither accepted nor rejected some of {team}")
    if not trusted.union(*verified).issuperset(decision.trusted):
        raise UnverifiedAnswer(f"{defense.kind} trusts {list(decision.trusted)} without a consensus")
    check_objects(defense, decision, decoded)
    if defense.kind not in shipped():  # those that ship are known to keep JSON, and theirs may be long
        rfc8785.dumps(dict(decision.state))
        if doubt := next((name for name, why in decision.rejected.items() if not by_text(why.evidence)), None):
            raise UnverifiedAnswer(f"{defense.kind} gives evidence on {doubt} by keys that are no text")
