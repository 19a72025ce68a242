"""Boxes that are the same but for how sums are rounded."""

from itertools import chain, combinations

import numpy as np

NEAR_M = 0.1


def check_alike(found, expected):
    """Nearly all boxes of one are in the other: sums are rounded otherwise, and what is near a threshold may go."""
    assert abs(len(found) - len(expected)) <= 1 + len(expected) // 20
    apart = np.abs(found[:, None, :2] - expected[None, :, :2]).max(axis=2).min(axis=1)
    assert (apart > NEAR_M).sum() <= 1 + len(expected) // 20


def subsets_of(team):
    return list(chain.from_iterable(combinations(team, size) for size in range(len(team) + 1)))
