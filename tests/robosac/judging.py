"""A defence that judges boxes by rule of thumb: what it takes to try the way of its judgements to the answer."""

from typing import Literal

from robosac.consensus import match
from robosac.defenses import (
    EGO,
    Decision,
    JudgedBox,
    Reason,
    Rejection,
    SampleConsensus,
    Source,
    Standing,
    Support,
    Verdict,
)


class Judging(SampleConsensus):
    """Answers with everybody: weak boxes are contradicted, and the best one is taken from a fusion without the last.

    What the ego sees too is confirmed; for the rest there is the word of the first teammate.
    """

    kind: Literal["judging"] = "judging"
    contradicted_below: float = 0.3

    def converse(self, team, state, rng):
        part = tuple(team[:-1])
        outcomes = yield [tuple(team), part]
        if len(outcomes) < 2 or outcomes[0].verdict is not Verdict.CONSENSUS:
            return Decision((), Source.EGO_ONLY, dict.fromkeys(team, Rejection(Reason.NOT_SAMPLED)), None, state)
        whole, without = outcomes
        seen = set(match(whole.reference, whole.boxes)[1].tolist())
        objects, contradicted = [], []
        for index, box in enumerate(whole.boxes):
            if box[5] < self.contradicted_below:
                support = Support(status=Standing.CONTRADICTED, witnesses=team[-1:], deniers=(EGO, team[1]))
                contradicted.append(JudgedBox(tuple(team), index, support))
            elif index in seen:
                objects.append(JudgedBox(tuple(team), index, confirmed(team[0])))
            else:
                objects.append(JudgedBox(tuple(team), index, alone(team[0])))
        objects[:1] = [JudgedBox(part, 0, repaired(team[0]))] if len(without.boxes) else []
        return Decision(
            tuple(team), Source.CONSENSUS, {}, None, state, objects=tuple(objects), contradicted=tuple(contradicted)
        )


def confirmed(*names: str) -> Support:
    return Support(status=Standing.CONFIRMED, witnesses=(EGO, *names), deniers=())


def alone(name: str) -> Support:
    return Support(status=Standing.SINGLE_WITNESS, witnesses=(name,), deniers=())


def repaired(name: str) -> Support:
    return Support(status=Standing.REPAIRED, witnesses=(name,), deniers=())


def build() -> Judging:
    return Judging()
