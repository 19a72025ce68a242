import numpy as np
import pytest

from robosac.defenses.group_testing import sets


def test_marginals_of_a_joint_table_are_its_parts(rng):
    low, high = rng.random((3, 4)), rng.random((3, 8))
    low, high = low / low.sum(axis=1, keepdims=True), high / high.sum(axis=1, keepdims=True)
    both = sets.joint(low, high)
    np.testing.assert_allclose(sets.marginal(both, [0, 1]), low)
    np.testing.assert_allclose(sets.marginal(both, [2, 3, 4]), high)
    third = (sets.bits(5)[3] @ both.T)[:, None]
    np.testing.assert_allclose(sets.marginal(both, [3]), np.hstack([1 - third, third]))


def test_a_marginal_of_two_keeps_how_they_hang_together(rng):
    table = rng.random((1, 16))
    part = sets.marginal(table, [1, 3])
    first, second = sets.bits(4)[1], sets.bits(4)[3]
    for code in range(4):
        chosen = (first == (code & 1)) & (second == code >> 1)
        assert part[0, code] == pytest.approx(table[0, chosen].sum())


def test_packing_fills_bins_without_splitting():
    bins = sets.packed([2, 5, 1, 3, 4], 6)
    assert [sum([2, 5, 1, 3, 4][i] for i in b) for b in bins] == [6, 6, 3]
    assert sorted(i for b in bins for i in b) == list(range(5))
    assert sets.packed([], 6) == []


def test_products_of_all_others():
    each = [np.array([2.0, 3.0]), np.array([5.0, 0.0]), np.array([7.0, 4.0])]
    np.testing.assert_array_equal(sets.products_but(each), [[35, 0], [14, 12], [10, 0]])
    np.testing.assert_array_equal(sets.products_but(each[:1]), [[1, 1]])


def test_touching():
    assert sets.touching(2, 0b01, 0b10).tolist() == [sets.NEITHER, sets.IN_A, sets.IN_D, sets.IN_BOTH]
