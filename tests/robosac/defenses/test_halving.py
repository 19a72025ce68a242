from itertools import combinations
from math import ceil, log2

import numpy as np
import pytest

from robosac.answers import Reason, Source, Verdict
from robosac.defenses import Halving
from robosac.evaluation.oracle import converse_with_oracle
from tests.robosac.defenses.conversation import converse

TEAM = list("abcdefgh")


@pytest.mark.parametrize("size", [1, 2, 5, 8])
def test_with_a_perfect_oracle_exactly_the_attackers_are_left_out(size, rng):
    team = TEAM[:size]
    for count in range(size + 1):
        for attackers in combinations(team, count):
            decision, tested = converse_with_oracle(Halving(), team, attackers, {}, rng)
            assert decision.accepted == tuple(name for name in team if name not in attackers)
            assert {r.reason for r in decision.rejected.values()} <= {Reason.DISSENSUS}
            assert set(decision.rejected) == set(attackers)
            assert len(tested) <= 2 * count * ceil(log2(size)) + 2
            subsets = [o.teammates for o in tested]
            assert len(set(subsets)) == len(subsets)


def test_a_team_without_attackers_costs_one_test(rng):
    decision, tested = converse_with_oracle(Halving(), TEAM, [], {}, rng)
    assert (len(tested), decision.accepted, decision.source) == (1, tuple(TEAM), Source.CONSENSUS)


def test_the_union_is_verified_and_else_the_largest_group_is_the_answer(rng):
    def judge(subset):
        return Verdict.CONSENSUS if "a" not in subset and len(subset) < 7 else Verdict.DISSENSUS

    decision, tested = converse(Halving(), judge, rng, TEAM)
    assert tested[-1].teammates == tuple("bcdefgh")  # all that passed apart do not agree together
    verified = [o.teammates for o in tested if o.verdict is Verdict.CONSENSUS]
    assert decision.accepted in verified
    assert len(decision.accepted) == max(map(len, verified)) == 4


def test_groups_are_split_at_random_into_halves(rng):
    firsts = set()
    for _ in range(200):
        _, tested = converse(Halving(), [Verdict.DISSENSUS, Verdict.CONSENSUS, Verdict.CONSENSUS], rng, TEAM[:5])
        left, right = (o.teammates for o in tested[1:3])
        assert sorted([*left, *right]) == TEAM[:5]
        assert (len(left), len(right)) == (2, 3)
        assert list(left) == sorted(left)
        firsts.add(left)
    assert len(firsts) == 10


def test_no_evidence_earns_nothing_and_is_not_split(rng):
    decision, tested = converse(Halving(), [Verdict.NO_EVIDENCE], rng, TEAM)
    assert (len(tested), decision.source) == (1, Source.EGO_ONLY)
    assert {r.reason for r in decision.rejected.values()} == {Reason.NOT_SAMPLED}


@pytest.mark.parametrize("time_for", range(6))
def test_when_the_time_is_up_it_answers_with_a_group_that_passed(time_for, rng):
    verdicts = [Verdict.DISSENSUS, Verdict.CONSENSUS, Verdict.DISSENSUS, Verdict.CONSENSUS, Verdict.DISSENSUS]
    decision, tested = converse(Halving(), verdicts[:time_for], rng, TEAM)
    assert len(tested) == time_for
    verified = [o.teammates for o in tested if o.verdict is Verdict.CONSENSUS]
    assert decision.accepted == max(verified, key=len, default=())
    assert len(decision.accepted) == (0 if time_for < 2 else 4)
    assert sorted([*decision.accepted, *decision.rejected]) == TEAM


def test_an_empty_team_is_answered_by_the_ego_alone(rng):
    decision, tested = converse(Halving(), [], rng, [])
    assert (tested, decision.source, decision.rejected) == ([], Source.EGO_ONLY, {})


def test_it_runs_against_a_detector(detector, ego_message, attacked):
    import robosac

    result = robosac.fuse(detector, Halving(), ego_message, attacked, rng=np.random.default_rng(0))
    assert result.fault is None
    assert result.accepted == ("car-3", "car-4", "car-5", "rsu")


def test_an_impossible_threshold_is_refused():
    with pytest.raises(ValueError, match="consensus_threshold"):
        Halving(consensus_threshold=0.0)
