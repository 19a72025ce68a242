import numpy as np
import pytest

from robosac.answers import Source, Verdict
from robosac.budget import DomainError
from robosac.defenses import A2CP
from robosac.evaluation.oracle import converse_with_oracle
from tests.robosac.defenses.conversation import converse

TEAM = list("abcde")
# attackers of five, total sampling steps and estimate: the paper's table of attacker ratio estimation
PAPER = [(0, 1, 0.0), (1, 8.2, 0.22), (2, 20.5, 0.42), (3, 37.9, 0.60), (4, 59, 0.80), (5, 77, 1.0)]


def settled(state):
    return all(t >= u for t, u in zip(state["attempts"], state["bounds"], strict=True))


def estimate(attackers, rng, defense=A2CP(), team=TEAM):
    """Frames until everything is settled: total steps, final state."""
    state, steps = defense.initial_state(team), 0
    while not settled(state):
        decision, tested = converse_with_oracle(defense, team, team[:attackers], state, rng)
        assert len(tested) <= defense.sampling_budget
        assert not set(decision.accepted) & set(team[:attackers])
        state, steps = decision.state, steps + len(tested)
    return steps, state


@pytest.mark.parametrize(("attackers", "steps", "ratio"), PAPER)
def test_reproduces_the_papers_estimation_of_the_attacker_ratio(attackers, steps, ratio):
    rng = np.random.default_rng(attackers)
    runs = [estimate(attackers, rng) for _ in range(500)]
    total = np.mean([run[0] for run in runs])
    assert total == pytest.approx(steps, rel=0.15)
    if attackers in (0, 5):
        assert {run[0] for run in runs} == {steps}
    assert np.mean([run[1]["estimate"] for run in runs]) == pytest.approx(ratio, abs=0.05)


def test_bounds_follow_equation_2_with_one_attempt_at_ratio_0():
    state = A2CP().initial_state(TEAM)
    assert state["bounds"] == [1, 9, 19, 27, 21]
    assert state["ratios"] == [0.0, 0.2, 0.4, 0.6, 0.8]
    assert state["estimate"] == 1.0
    assert A2CP(ratios=(0.0, 0.4)).initial_state(TEAM)["bounds"] == [1, 19]
    assert len(A2CP().initial_state(list("abcdefghij"))["bounds"]) == 10


def test_a_consensus_of_everybody_settles_all_at_once(rng):
    decision, tested = converse(A2CP(), [Verdict.CONSENSUS], rng, TEAM)
    assert len(tested) == 1
    assert decision.accepted == tuple(TEAM)
    assert decision.attacker_ratio == 0.0
    assert settled(decision.state)


def test_a_frame_visits_ratios_in_turn_and_retries_the_lower_ones(rng):
    verdicts = [Verdict.DISSENSUS, Verdict.DISSENSUS, Verdict.CONSENSUS, Verdict.DISSENSUS, Verdict.DISSENSUS]
    decision, tested = converse(A2CP(), verdicts, rng, TEAM)
    assert [len(o.teammates) for o in tested] == [5, 4, 3, 4, 4]
    assert decision.accepted == tested[2].teammates
    assert decision.attacker_ratio == 0.4
    assert decision.state["attempts"] == [1, 3, 19, 27, 21]


def test_the_answer_is_the_largest_hypothesis_in_consensus(rng):
    verdicts = [Verdict.DISSENSUS, Verdict.DISSENSUS, Verdict.CONSENSUS, Verdict.CONSENSUS]
    decision, tested = converse(A2CP(), verdicts, rng, TEAM)
    assert [len(o.teammates) for o in tested] == [5, 4, 3, 4]
    assert decision.accepted == tested[3].teammates
    assert decision.attacker_ratio == 0.2


def test_no_evidence_spends_steps_and_moves_no_counter(rng):
    decision, tested = converse(A2CP(), [Verdict.NO_EVIDENCE] * 99, rng, TEAM)
    assert len(tested) == 5
    assert decision.state == A2CP().initial_state(TEAM)
    assert decision.source is Source.EGO_ONLY


def test_when_the_time_is_up_what_was_learned_is_kept(rng):
    decision, tested = converse(A2CP(), [Verdict.DISSENSUS] * 2, rng, TEAM)
    assert len(tested) == 2
    assert decision.state["attempts"] == [1, 1, 0, 0, 0]


def test_once_settled_it_goes_on_at_the_estimate(rng):
    _, state = estimate(2, rng)
    assert state["estimate"] == 0.4
    decision, tested = converse_with_oracle(A2CP(sampling_budget=10), TEAM, ["a", "b"], state, rng)
    assert decision.accepted == ("c", "d", "e")
    assert {len(o.teammates) for o in tested} == {3}
    assert decision.state == state


def test_where_everybody_attacks_nobody_is_asked_any_more(rng):
    _, state = estimate(5, rng)
    decision, tested = converse(A2CP(), [], rng, TEAM, state)
    assert (tested, decision.source, decision.attacker_ratio) == ([], Source.EGO_ONLY, 1.0)


def test_an_incomplete_team_is_answered_but_not_counted(rng):
    state = A2CP().initial_state(TEAM)
    decision, tested = converse(A2CP(), [Verdict.DISSENSUS, Verdict.CONSENSUS], rng, TEAM[:3], state)
    assert max(len(o.teammates) for o in tested) <= 3
    assert decision.accepted == tested[1].teammates
    assert decision.state == state
    decision, tested = converse(A2CP(), [], rng, [], state)
    assert (tested, decision.state) == ([], state)


def test_a_new_team_begins_again(rng):
    _, state = estimate(1, rng)
    assert A2CP().change_team(state, list("abc")) == A2CP().initial_state(list("abc"))
    steps, state = estimate(1, rng, team=list("abcdefgh"))
    assert state["estimate"] == pytest.approx(1 / 8, abs=0.26)
    assert steps > 1


@pytest.mark.parametrize(
    "settings",
    [
        {"sampling_budget": 0},
        {"confidence": 1.0},
        {"consensus_threshold": 0.0},
        {"ratios": ()},
    ],
)
def test_impossible_settings_are_refused(settings):
    with pytest.raises(ValueError, match=next(iter(settings))):
        A2CP(**settings)


@pytest.mark.parametrize("ratios", [(0.4, 0.2), (0.2, 0.2), (0.5, 1.0), (-0.2, 0.2)])
def test_ratios_must_ascend(ratios):
    with pytest.raises(DomainError, match="ratios must ascend"):
        A2CP(ratios=ratios).check_team(5)


def test_ratios_must_fit_the_team():
    A2CP(ratios=(0.0, 0.2, 0.6)).check_team(5)
    with pytest.raises(DomainError, match="whole number of attackers in a team of 4"):
        A2CP(ratios=(0.0, 0.2)).check_team(4)


def test_any_team_size_down_to_none_will_do(rng):
    for size in range(4):
        team = TEAM[:size]
        A2CP().check_team(size)
        decision, _ = converse(A2CP(), [Verdict.CONSENSUS], rng, team)
        assert decision.accepted == tuple(team)
