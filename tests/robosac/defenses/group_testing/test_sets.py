import numpy as np
import pytest

from robosac.defenses.group_testing import sets
from robosac.defenses.group_testing.sets import ATTACKS, COMPLEMENTARY, PLAIN


def random_table(rng, kinds, n):
    return rng.dirichlet(np.ones(3**n), kinds)


def test_marginals_of_a_joint_table_are_its_parts(rng):
    low, high = random_table(rng, 3, 2), random_table(rng, 3, 3)
    both = sets.joint(low, high)
    np.testing.assert_allclose(sets.marginal(both, [0, 1]), low)
    np.testing.assert_allclose(sets.marginal(both, [2, 3, 4]), high)
    third = [(both * (sets.states(5)[3] == state)).sum(axis=1) for state in range(3)]
    np.testing.assert_allclose(sets.marginal(both, [3]), np.stack(third, axis=1))


def test_a_marginal_of_two_keeps_how_they_hang_together(rng):
    table = random_table(rng, 1, 4)
    part = sets.marginal(table, [1, 3])
    first, second = sets.states(4)[1], sets.states(4)[3]
    for code in range(9):
        chosen = (first == code % 3) & (second == code // 3)
        assert part[0, code] == pytest.approx(table[0, chosen].sum())


def test_at_most_sums_all_that_is_not_above(rng):
    table = random_table(rng, 2, 3)
    below = sets.at_most(table)
    states = sets.states(3).T
    for entry, limits in enumerate(states):
        np.testing.assert_allclose(below[:, entry], table[:, (states <= limits).all(axis=1)].sum(axis=1))


def test_through_is_a_kernel_for_each_member(rng):
    kernel = rng.dirichlet(np.ones(3), 3)
    table = random_table(rng, 2, 2)
    expected = np.einsum("kba,as,bt->kts", table.reshape(2, 3, 3), kernel, kernel).reshape(2, 9)
    np.testing.assert_allclose(sets.through(table, kernel), expected)


def test_the_prior_is_of_independent_attackers_and_of_teams_with_complementary_views():
    table = sets.prior(3, 0.25)[0]
    states = sets.states(3)
    assert table.sum() == pytest.approx(1)
    assert table[(states == ATTACKS).sum(axis=0) == 2].sum() == pytest.approx(3 * 0.25**2 * 0.75)
    nobody = sets.prior(3, 0.0)[0]
    assert nobody[(states == ATTACKS).any(axis=0)].sum() == 0
    share = sets.COMPLEMENTARY_TEAMS * (1 - (1 - sets.COMPLEMENTARY_MEMBERS) ** 3)
    assert nobody[(states == COMPLEMENTARY).any(axis=0)].sum() == pytest.approx(share)


def test_forgetting_views_keeps_who_attacks(rng):
    table = random_table(rng, 2, 3)
    after = sets.forgotten_views(table)
    attackers = sets.attacking(3)
    for subset in range(8):
        chosen = (attackers == [[subset >> i & 1] for i in range(3)]).all(axis=0)
        assert after[:, chosen].sum(axis=1) == pytest.approx(table[:, chosen].sum(axis=1))
    twice = sets.forgotten_views(after)
    np.testing.assert_allclose(twice, after)


def test_who_awakes_was_benign(rng):
    nobody = sets.prior(2, 0.0)
    after = sets.awakened(nobody, 2, 0.1, 0.25)[0]
    alone = 0.1 * 0.9
    together = (1 - 0.9**2) * 0.25 * 0.75 / (1 - 0.75**2)
    assert after.sum() == pytest.approx(1)
    assert after[sets.attacking(2)[0] > sets.attacking(2)[1]].sum() == pytest.approx((alone + together) / 2)
    assert after[sets.unattacked(2) == 1].sum() == pytest.approx(0.9**2)


def test_products_of_all_others():
    each = np.array([[2.0, 3.0], [5.0, 0.0], [7.0, 4.0]])
    np.testing.assert_array_equal(sets.products_but(each), [[35, 0], [14, 12], [10, 0]])
    np.testing.assert_array_equal(sets.products_but(each[:1]), [[1, 1]])


def test_levels_are_the_greatest_states():
    where = sets.levels(2, 0b01, 0b10)
    for entry, (first, second) in enumerate(sets.states(2).T):
        assert where[entry] == 3 * first + second
    assert sets.levels(2, 0b11, 0)[3 * ATTACKS + PLAIN] == 3 * ATTACKS
    assert sets.levels(0, 0, 0).tolist() == [0]


def test_what_is_short_comes_back():
    values = np.array([0.0, 0.25, 1e-9, 0.75])
    np.testing.assert_array_equal(sets.long(sets.short(values), 4), [0, 0.25, 0, 0.75])
    np.testing.assert_array_equal(sets.long([[1, 3], [0.25, 0.75]], 4), [0, 0.25, 0, 0.75])  # as older versions kept it
