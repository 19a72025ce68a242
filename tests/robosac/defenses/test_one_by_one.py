from itertools import combinations

import numpy as np
import pytest

from robosac.answers import Reason, Source, Verdict
from robosac.defenses import OneByOne, Outcome
from robosac.evaluation.oracle import converse_with_oracle
from tests.robosac.defenses.conversation import converse

TEAM = list("abcde")


def test_with_a_perfect_oracle_exactly_the_attackers_are_left_out(rng):
    for count in range(6):
        for attackers in combinations(TEAM, count):
            decision, tested = converse_with_oracle(OneByOne(), TEAM, attackers, {}, rng)
            honest = tuple(name for name in TEAM if name not in attackers)
            assert decision.accepted == honest
            assert len(tested) == 5 + (len(honest) > 1)
            assert {name: r.reason for name, r in decision.rejected.items()} == dict.fromkeys(
                attackers, Reason.DISSENSUS
            )


def test_the_order_is_random(rng):
    orders = {
        tuple(o.teammates for o in converse(OneByOne(), [Verdict.DISSENSUS] * 5, rng, TEAM)[1]) for _ in range(50)
    }
    assert len(orders) > 30


def test_if_they_do_not_agree_together_the_best_of_them_is_the_answer(rng):
    conversation = OneByOne().converse(TEAM, {}, rng)
    batch = next(conversation)
    indices = {"a": 0.2, "b": 0.5, "c": 0.8, "d": 0.6, "e": 0.1}
    singles = [
        Outcome(s, indices[s[0]], Verdict.CONSENSUS if indices[s[0]] >= 0.3 else Verdict.DISSENSUS) for s in batch
    ]
    (together,) = conversation.send(singles)
    assert together == ("b", "c", "d")
    with pytest.raises(StopIteration) as stop:
        conversation.send([Outcome(together, 0.25, Verdict.DISSENSUS)])
    decision = stop.value.value
    assert (decision.accepted, decision.source) == (("c",), Source.CONSENSUS)
    assert decision.rejected["b"].evidence["hypotheses"] == [5]


@pytest.mark.parametrize("time_for", range(6))
def test_when_the_time_is_up_it_answers_with_one_that_passed(time_for, rng):
    decision, tested = converse(OneByOne(), [Verdict.CONSENSUS] * time_for, rng, TEAM)
    assert len(tested) == time_for
    assert len(decision.accepted) == min(time_for, 1)
    assert sorted([*decision.accepted, *decision.rejected]) == TEAM


def test_those_without_evidence_are_not_fused(rng):
    decision, tested = converse(OneByOne(), [Verdict.NO_EVIDENCE] * 5, rng, TEAM)
    assert (len(tested), decision.source) == (5, Source.EGO_ONLY)
    assert {r.reason for r in decision.rejected.values()} == {Reason.NOT_SAMPLED}


def test_it_runs_against_a_detector(detector, ego_message, attacked):
    import robosac

    result = robosac.fuse(detector, OneByOne(), ego_message, attacked, rng=np.random.default_rng(0))
    assert result.fault is None
    assert result.accepted == ("car-3", "car-4", "car-5", "rsu")
    assert result.sampling_steps == 6
