"""Drives a defence by hand."""

from collections.abc import Callable, Iterable

from robosac.answers import Verdict
from robosac.defenses import Outcome


def converse(defense, verdicts: Iterable[Verdict] | Callable[[tuple[str, ...]], Verdict], rng, team, state=None):
    """Answer a defence with these verdicts, then with silence: the time is up."""
    judge = verdicts if callable(verdicts) else None
    given = iter(()) if judge else iter(verdicts)
    conversation = defense.converse(team, defense.initial_state(team) if state is None else state, rng)
    tested: list[Outcome] = []
    try:
        batch = next(conversation)
        while True:
            if judge:
                outcomes = [Outcome(subset, 0.5, judge(subset)) for subset in batch]
            else:
                outcomes = [Outcome(subset, 0.5, verdict) for subset, verdict in zip(batch, given, strict=False)]
            tested += outcomes
            batch = conversation.send(outcomes)
    except StopIteration as stop:
        return stop.value, tested
