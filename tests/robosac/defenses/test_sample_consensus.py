import numpy as np
import pytest

from robosac.answers import Reason, Source, Verdict
from robosac.budget import DomainError
from robosac.defenses import SampleConsensus
from robosac.defenses.sampling import search
from robosac.evaluation.oracle import converse_with_oracle
from tests.robosac.defenses import conversation

TEAM = ["a", "b", "c", "d", "e"]


def converse(defense, verdicts, rng, team=TEAM):
    return conversation.converse(defense, verdicts, rng, team)


def test_the_first_consensus_ends_the_search(rng):
    decision, tested = converse(
        SampleConsensus(sampling_budget=7, collaborators=3), [Verdict.DISSENSUS, Verdict.CONSENSUS], rng
    )
    assert len(tested) == 2
    assert decision.accepted == tested[1].teammates
    assert decision.source is Source.CONSENSUS
    assert set(decision.accepted) | set(decision.rejected) == set(TEAM)
    assert not set(decision.accepted) & set(decision.rejected)


@pytest.mark.parametrize("n", [1, 2, 7])
def test_the_fallback_comes_after_n_steps_and_not_before(n, rng):
    decision, tested = converse(SampleConsensus(sampling_budget=n, collaborators=3), [Verdict.DISSENSUS] * 100, rng)
    assert len(tested) == n
    assert (decision.accepted, decision.source) == ((), Source.EGO_ONLY)


def test_no_evidence_spends_steps_and_earns_nothing(rng):
    decision, tested = converse(SampleConsensus(sampling_budget=3, collaborators=3), [Verdict.NO_EVIDENCE] * 100, rng)
    assert len(tested) == 3
    assert decision.source is Source.EGO_ONLY
    assert {r.reason for r in decision.rejected.values()} == {Reason.NOT_SAMPLED}


def test_when_the_time_is_up_it_answers_with_what_it_has(rng):
    decision, tested = converse(SampleConsensus(sampling_budget=7, collaborators=3), [Verdict.DISSENSUS], rng)
    assert len(tested) == 1
    assert decision.source is Source.EGO_ONLY
    for teammate in TEAM:
        expected = Reason.DISSENSUS if teammate in tested[0].teammates else Reason.NOT_SAMPLED
        assert decision.rejected[teammate].reason is expected


def test_rejections_carry_their_evidence(rng):
    decision, tested = converse(SampleConsensus(sampling_budget=7, collaborators=4), [Verdict.DISSENSUS] * 5, rng)
    for teammate, rejection in decision.rejected.items():
        assert rejection.evidence["hypotheses"] == [i for i, o in enumerate(tested) if teammate in o.teammates]
        assert rejection.evidence["lowest_jaccard_index"] == 0.5


def test_no_subset_is_tested_twice(rng):
    _, tested = converse(SampleConsensus(sampling_budget=50, collaborators=3), [Verdict.DISSENSUS] * 100, rng)
    assert len(tested) == len({o.teammates for o in tested}) == 10


@pytest.mark.parametrize("tests", [0, -1])
def test_a_search_without_a_budget_is_over_at_once(tests, rng):
    assert list(search(["a", "b", "c"], (1, tests), rng, [])) == []


def test_independent_draws_repeat_themselves(rng):
    defense = SampleConsensus.independent(sampling_budget=50, collaborators=3)
    _, tested = converse(defense, [Verdict.DISSENSUS] * 100, rng)
    assert len(tested) == 50 > len({o.teammates for o in tested})


def test_draws_are_uniform_and_follow_the_generator():
    defense = SampleConsensus(sampling_budget=1, collaborators=2)
    counts: dict[tuple[str, ...], int] = {}
    for seed in range(3000):
        _, (outcome,) = converse(defense, [Verdict.DISSENSUS], np.random.default_rng(seed))
        counts[outcome.teammates] = counts.get(outcome.teammates, 0) + 1
    assert len(counts) == 10
    assert max(abs(count - 300) for count in counts.values()) < 5 * np.sqrt(300 * 0.9)
    first, second = (converse(defense, [Verdict.DISSENSUS], np.random.default_rng(7))[1] for _ in range(2))
    assert first == second


def test_an_empty_team_is_answered_by_the_ego_alone(rng):
    decision, tested = converse(SampleConsensus(), [], rng, team=[])
    assert (tested, decision.source, decision.rejected) == ([], Source.EGO_ONLY, {})


@pytest.mark.parametrize("present", range(1, 6))
def test_the_plan_follows_the_teammates_that_are_present(present, rng):
    s, n = SampleConsensus(sampling_budget=7, collaborators=4).plan(present)
    assert s == max(1, present - 1)
    assert 1 <= n <= 7


@pytest.mark.parametrize(
    ("defense", "plan"),
    [
        (SampleConsensus(), (4, 5)),
        (SampleConsensus(sampling_budget=3), (1, 3)),
        (SampleConsensus(collaborators=3), (3, 6)),
        (SampleConsensus.independent(collaborators=3), (3, 10)),
        (SampleConsensus(sampling_budget=9, collaborators=3), (3, 9)),
        (SampleConsensus(attacker_ratio=0.9), (1, 5)),
    ],
)
def test_what_is_not_given_follows_from_the_exact_law(defense, plan):
    assert defense.plan(5) == plan


def test_a_lone_teammate_is_tested_once():
    assert SampleConsensus(collaborators=3).plan(1) == (1, 1)
    SampleConsensus(attacker_ratio=0.9, collaborators=1).check_team(5)


def test_the_lowest_index_is_the_evidence():
    from robosac.defenses import Outcome
    from robosac.defenses.protocol import explain_rejections

    outcomes = [Outcome(("a", "b"), index, Verdict.DISSENSUS) for index in (0.2, 0.1, 0.25)]
    assert explain_rejections(["a"], (), outcomes)["a"].evidence == {
        "hypotheses": [0, 1, 2],
        "lowest_jaccard_index": 0.1,
    }


def test_with_a_perfect_oracle_the_plan_always_finds_the_benign(rng):
    for _ in range(50):
        decision, _ = converse_with_oracle(
            SampleConsensus(attacker_ratio=0.4, collaborators=3), TEAM, {"b", "d"}, {}, rng
        )
        assert decision.accepted == ("a", "c", "e")
        assert {decision.rejected[t].reason for t in "bd"} <= {Reason.DISSENSUS, Reason.NOT_SAMPLED}


@pytest.mark.parametrize(
    "settings",
    [
        {"attacker_ratio": 0.0},
        {"attacker_ratio": 1.0},
        {"confidence": 1.0},
        {"consensus_threshold": 0.0},
        {"consensus_threshold": 1.1},
        {"sampling_budget": 0},
        {"collaborators": 0},
    ],
)
def test_impossible_settings_are_refused(settings):
    with pytest.raises(ValueError, match=next(iter(settings))):
        SampleConsensus(**settings)


def test_a_team_without_enough_benign_teammates_is_refused():
    with pytest.raises(DomainError, match="at most 4 can be collaborators"):
        SampleConsensus(collaborators=5).check_team(5)
    SampleConsensus(collaborators=4).check_team(5)
