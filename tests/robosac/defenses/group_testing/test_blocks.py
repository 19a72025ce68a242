import numpy as np
import pytest

from robosac.defenses.group_testing.blocks import Block, halved, packed, together, without


def test_packing_fills_bins_without_splitting():
    bins = packed([2, 5, 1, 3, 4], 6)
    assert [sum([2, 5, 1, 3, 4][i] for i in b) for b in bins] == [6, 6, 3]
    assert sorted(i for b in bins for i in b) == list(range(5))
    assert packed([], 6) == []


@pytest.fixture
def pair(rng):
    return [Block(names, rng.dirichlet(np.ones(3 ** len(names)), 2)) for names in ("abc", "de")]


def test_independent_blocks_are_one_and_two_again(pair):
    both = together(pair)
    assert "".join(both.names) == "abcde"
    for block, again in zip(pair, (both.of(range(3)), both.of(range(3, 5))), strict=True):
        assert list(again.names) == list(block.names)
        np.testing.assert_allclose(again.table, block.table)


def test_blocks_are_halved_until_none_is_too_large(pair):
    parts = halved([together(pair)], 2)
    assert ["".join(block.names) for block in parts] == ["ab", "c", "de"]
    for part in parts:
        np.testing.assert_allclose(part.table.sum(axis=1), 1)
    np.testing.assert_allclose(parts[0].table, pair[0].of([0, 1]).table)


def test_a_block_that_nobody_is_left_in_goes_unless_it_is_the_last(pair):
    alone = without(without(pair, "d"), "e")
    assert [list(block.names) for block in alone] == [list("abc")]
    for name in "abc":
        alone = without(alone, name)
    assert [len(block) for block in alone] == [0]
