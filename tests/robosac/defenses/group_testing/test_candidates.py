import numpy as np
import pytest

from robosac.defenses.group_testing.candidates import (
    MOST_WITNESSES,
    SUSPECTS_AT_ONCE,
    UNRESOLVED,
    WITNESSES,
    candidates,
    least_first,
)
from robosac.defenses.group_testing.choice import LIKELY_HONEST
from robosac.defenses.group_testing.model import CELLS, CLEAN
from robosac.defenses.group_testing.posterior import BLOCK, Posterior

KINDS = 2
NOTHING = np.zeros((0, 20), dtype=bool)


def learn(posterior, subset, log_ratio):
    """Evidence that somebody of a subset attacks, or that nobody does."""
    told = np.zeros(CLEAN + CELLS * KINDS)
    told[CLEAN:] = log_ratio
    posterior.update(subset, np.zeros_like(subset), told)


@pytest.fixture
def halfway():
    """Twenty teammates: somebody attacks, the first eight are cleared."""
    posterior = Posterior(KINDS, 0.5, 0.25, [f"v{i:02d}" for i in range(20)])
    learn(posterior, np.arange(20) >= 18, 6.0)
    for index in range(8):
        learn(posterior, np.arange(20) == index, -8.0)
    return posterior


def test_a_small_team_has_all_its_subsets_but_those_decoded():
    posterior = Posterior(KINDS, 0.5, 0.25, list("abcde"))
    decoded = np.array([[True, False, False, True, False]])
    found = candidates(posterior, np.ones(5, dtype=bool), decoded)
    assert len(np.unique(found, axis=0)) == len(found) == 2**5 - 2
    assert not (found == decoded).all(axis=1).any()


def test_groups_of_a_larger_team_are_small_and_within_a_block(halfway):
    present = np.ones(20, dtype=bool)
    present[19] = False
    found = candidates(halfway, present, NOTHING)
    likely_honest = present & (halfway.marginals() < LIKELY_HONEST)
    as_answer = (found == likely_honest).all(axis=1)
    assert (as_answer.sum(), likely_honest.sum()) == (1, 18)
    found = found[~as_answer]
    doubtful = halfway.marginals() >= UNRESOLVED[0]
    block = np.repeat(np.arange(4), [len(block) for block in halfway.blocks()])
    groups = found[(found & doubtful).any(axis=1)] & doubtful
    assert len(groups) > 20
    assert groups.sum(axis=1).max() == SUSPECTS_AT_ONCE
    assert all(len(set(block[row])) == 1 for row in groups)
    assert not found[:, 19].any()
    assert max(map(len, halfway.blocks())) <= BLOCK


def test_witnesses_decoded_before_are_in_every_group_test(halfway):
    doubtful = halfway.marginals() >= UNRESOLVED[0]
    witnesses = np.arange(20)[None] < WITNESSES
    found = candidates(halfway, np.ones(20, dtype=bool), witnesses)
    tests = found[(found & doubtful).any(axis=1)]
    assert (tests & witnesses).sum(axis=1).min() == WITNESSES
    many = np.arange(20)[None] < MOST_WITNESSES + 1
    alone = candidates(halfway, np.ones(20, dtype=bool), many)
    assert ((alone & ~doubtful).sum(axis=1) == 0).any()


def test_answers_are_small_or_hold_all_cleared_while_somebody_is_in_doubt(halfway):
    def sizes():
        good = halfway.marginals() < UNRESOLVED[0]
        found = candidates(halfway, np.ones(20, dtype=bool), NOTHING)
        return {int(row.sum()) for row in found if not (row & ~good).any()}, int(good.sum())

    found, cleared = sizes()
    assert cleared == 8
    assert max(found - {cleared}) == WITNESSES
    assert cleared in found
    for index in range(8, 18):
        learn(halfway, np.arange(20) == index, -9.0)
    for index in (18, 19):
        learn(halfway, np.arange(20) == index, 12.0)
    found, cleared = sizes()
    assert max(found - {cleared}) > MOST_WITNESSES


def test_where_nobody_is_cleared_no_answer_is_empty():
    doubtful = Posterior(KINDS, 0.5, 0.25, [f"v{i:02d}" for i in range(20)])
    assert not (doubtful.marginals() < UNRESOLVED[0]).any()
    assert candidates(doubtful, np.ones(20, dtype=bool), NOTHING).any(axis=1).all()


def test_what_only_rounding_tells_apart_stays_in_order():
    values = np.array([0.3, 0.1, 0.1 - 1e-16, 0.1 + 1e-16, 0.1 - 1e-6])
    assert least_first(values).tolist() == [4, 1, 2, 3, 0]
