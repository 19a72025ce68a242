from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robosac.budget import (
    DomainError,
    attackers_in_team,
    clean_probability,
    eq1_collaborators,
    eq2_budget,
    exact_budget,
    exact_collaborators,
)
from robosac.defenses import SampleConsensus
from robosac.evaluation.oracle import simulate_sampling

# eta, s, N by Eq. 2, success at that N, mean steps 1/q, N for 0.99 by the exact law, mean and most steps if distinct
TABLE_1 = [
    (0.2, 1, 3, 0.992, 1.25, 3, 1.20, 2),
    (0.2, 2, 5, 0.990, 1.67, 6, 1.57, 5),
    (0.2, 3, 7, 0.972, 2.50, 10, 2.20, 7),
    (0.2, 4, 9, 0.866, 5.00, 21, 3.00, 5),
    (0.4, 1, 6, 0.996, 1.67, 6, 1.50, 3),
    (0.4, 2, 11, 0.980, 3.33, 13, 2.75, 8),
    (0.4, 3, 19, 0.865, 10.0, 44, 5.50, 10),
    (0.6, 1, 10, 0.994, 2.50, 10, 2.00, 4),
    (0.6, 2, 27, 0.942, 10.0, 44, 5.50, 10),
    (0.8, 1, 21, 0.991, 5.00, 21, 3.00, 5),
]


@pytest.mark.parametrize(("eta", "s", "n", "success", "mean", "n_exact", "_", "__"), TABLE_1)
def test_formulas_give_table_1(eta, s, n, success, mean, n_exact, _, __):
    attackers = attackers_in_team(5, eta)
    q = clean_probability(5, attackers, s)
    assert eq2_budget(s, eta) == n
    assert exact_budget(5, attackers, s, distinct=False) == n_exact
    assert 1 - (1 - q) ** n == pytest.approx(success, abs=6e-4)
    assert 1 / q == pytest.approx(mean, abs=6e-3)


@pytest.mark.parametrize(("eta", "s", "n", "_", "mean", "__", "mean_distinct", "most_distinct"), TABLE_1)
def test_algorithm_1_with_a_perfect_oracle_reproduces_table_1(eta, s, n, _, mean, __, mean_distinct, most_distinct):
    attackers, runs = attackers_in_team(5, eta), 1000
    q = clean_probability(5, attackers, s)

    independent = SampleConsensus.independent(attacker_ratio=eta, sampling_budget=10_000, collaborators=s)
    steps = simulate_sampling(independent, 5, attackers, runs, np.random.default_rng(1))
    assert abs(steps.mean() - 1 / q) <= 3 * np.sqrt((1 - q) / q**2 / runs)
    succeeded, expected = (steps <= n).mean(), 1 - (1 - q) ** n
    assert abs(succeeded - expected) <= 3 * np.sqrt(expected * (1 - expected) / runs)

    distinct = SampleConsensus(attacker_ratio=eta, sampling_budget=10_000, collaborators=s)
    steps = simulate_sampling(distinct, 5, attackers, runs, np.random.default_rng(2))
    assert abs(steps.mean() - mean_distinct) <= 3 * steps.std() / np.sqrt(runs) + 0.005
    assert steps.max() == most_distinct


def test_the_figures_of_the_paper():
    assert eq1_collaborators(5, 0.1) == 4
    assert eq2_budget(5, 0.2) == 12


@given(st.integers(1, 60), st.floats(0.01, 0.95), st.floats(0.5, 0.999))
def test_equations_1_and_2_are_inverse(n, eta, p):
    s = eq1_collaborators(n, eta, p)
    if s >= 1:
        assert eq2_budget(s, eta, p) <= n
    assert eq2_budget(s + 1, eta, p) > n


@given(st.integers(1, 7), st.data())
def test_the_exact_budget_is_the_least_that_suffices(size, data):
    attackers = data.draw(st.integers(0, size - 1))
    s = data.draw(st.integers(1, size - attackers))
    p = data.draw(st.sampled_from([0.5, 0.9, 0.99]))
    subsets = list(combinations(range(size), s))
    bad = sum(any(member < attackers for member in subset) for subset in subsets)

    def failure(n: int) -> float:
        return float(np.prod([(bad - i) / (len(subsets) - i) for i in range(n)]))

    n = exact_budget(size, attackers, s, p)
    assert n <= bad + 1
    assert failure(n) <= 1 - p + 1e-9
    assert n == 1 or failure(n - 1) > 1 - p


def test_exact_collaborators_is_the_most_that_a_budget_buys():
    assert exact_collaborators(5, 1, 7) == 4
    assert exact_collaborators(5, 1, 7, distinct=False) == 2
    assert exact_collaborators(5, 4, 1) == 0
    assert exact_collaborators(5, 5, 3) == 0


def test_an_attacker_free_team_needs_one_hypothesis():
    assert exact_budget(5, 0, 5) == exact_budget(5, 0, 5, distinct=False) == 1


def test_large_teams_are_planned_at_once():
    import time

    started = time.process_time()
    assert exact_collaborators(63, 13, 7) == 3
    assert exact_budget(63, 32, 20) > 10**6
    assert exact_budget(30, 10, 5) == exact_budget(30, 10, 5, distinct=False) == 40
    for size in (36, 63, 1000):
        SampleConsensus(attacker_ratio=0.5, collaborators=size // 2).plan(size)
        SampleConsensus().plan(size)
    assert time.process_time() - started < 1.0


def test_beyond_what_can_be_enumerated_the_bound_still_suffices():
    total, clean = 142506, 15504  # C(30, 5), C(20, 5): just beyond
    n = exact_budget(30, 10, 5)
    assert np.prod([(total - clean - i) / (total - i) for i in range(n)]) <= 0.01


def test_a_fraction_of_an_attacker_counts_as_one():
    assert attackers_in_team(100, 0.07) == 7
    assert [attackers_in_team(5, eta) for eta in (0.0, 0.01, 0.2, 0.21, 0.6, 1.0)] == [0, 1, 1, 2, 3, 5]


@pytest.mark.parametrize("eta", [0.0, 1.0, -0.1, 1.1, float("nan")])
def test_ratios_outside_the_open_interval_are_refused(eta):
    with pytest.raises(DomainError, match="attacker_ratio"):
        eq1_collaborators(5, eta)
    with pytest.raises(DomainError, match="attacker_ratio"):
        eq2_budget(3, eta)


@pytest.mark.parametrize("p", [0.0, 1.0])
def test_certainty_is_refused(p):
    for call in (lambda: eq1_collaborators(5, 0.2, p), lambda: eq2_budget(3, 0.2, p), lambda: exact_budget(5, 1, 3, p)):
        with pytest.raises(DomainError, match="confidence"):
            call()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: eq1_collaborators(0, 0.2), "sampling_budget"),
        (lambda: exact_collaborators(5, 1, 0), "sampling_budget"),
        (lambda: eq2_budget(0, 0.2), "collaborators"),
        (lambda: exact_budget(5, 1, 6), "collaborators must be between 1 and the team size 5"),
        (lambda: exact_budget(5, 2, 4), "at most 3 collaborators"),
        (lambda: exact_budget(5, 6, 1), "attackers"),
        (lambda: clean_probability(0, 0, 1), "team_size"),
        (lambda: attackers_in_team(0, 0.2), "team_size"),
        (lambda: attackers_in_team(5, 1.2), "attacker_ratio"),
        (lambda: eq2_budget(10_000, 0.9), "too small"),
        (lambda: eq2_budget(320, 0.9), "too small"),
        (lambda: eq1_collaborators(5, 1e-320), "too close"),
        (lambda: eq1_collaborators(5, 0.2, 5e-324), "too close"),
    ],
)
def test_other_arguments_outside_the_domain_are_refused(call, message):
    with pytest.raises(DomainError, match=message):
        call()


@pytest.mark.parametrize("count", [7.5, 7.0, float("nan"), "7", None])
def test_a_count_is_a_whole_number(count):
    calls = {
        "sampling_budget": [lambda: eq1_collaborators(count, 0.2), lambda: exact_collaborators(5, 1, count)],
        "collaborators": [lambda: eq2_budget(count, 0.2), lambda: exact_budget(5, 1, count)],
        "attackers": [lambda: clean_probability(5, count, 1)],
        "team_size": [lambda: attackers_in_team(count, 0.2), lambda: exact_budget(count, 1, 1)],
    }
    for name, of_name in calls.items():
        for call in of_name:
            with pytest.raises(DomainError, match=f"^{name} must be a whole number"):
                call()
    assert eq1_collaborators(np.int64(7), 0.2) == 3


@pytest.mark.parametrize("confidence", [0, 1, 2.0, float("nan"), "0.9", None])
def test_a_confidence_is_checked_wherever_it_is_asked_for(confidence):
    for call in (eq1_collaborators, eq2_budget):
        with pytest.raises(DomainError, match=r"^confidence"):
            call(7, 0.2, confidence)
    for call in (exact_budget, exact_collaborators):
        with pytest.raises(DomainError, match=r"^confidence"):
            call(5, 1, 3, confidence)
