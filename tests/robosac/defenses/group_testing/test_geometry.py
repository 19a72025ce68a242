import numpy as np
import pytest

from robosac.defenses.group_testing.geometry import measure
from tests.robosac.defenses.group_testing.conversing import SEEN


def test_what_stays_is_no_loss_and_nothing_new():
    pair = measure(SEEN, SEEN)
    assert (pair.loss, pair.novelty) == (pytest.approx(0.0), 0)


def test_what_vanishes_is_loss():
    assert measure(SEEN, SEEN[:6]).loss == pytest.approx(0.25)
    assert measure(SEEN, SEEN[:0]).loss == 1.0


def test_what_moves_is_loss_and_not_new():
    moved = SEEN + [2.0, 0, 0, 0, 0, 0]
    pair = measure(SEEN, moved)
    assert (pair.loss, pair.novelty) == (pytest.approx(2 / 3), 0)


def test_what_was_nowhere_is_new_if_it_is_claimed_with_confidence():
    far = SEEN[:3] + [0, 30.0, 0, 0, 0, 0]
    assert measure(SEEN, np.vstack([SEEN, far])).novelty == 3
    faint = far * [1, 1, 1, 1, 1, 0.2]
    assert measure(SEEN, np.vstack([SEEN, faint])).novelty == 0


def test_two_few_witnesses_are_no_evidence():
    faint = SEEN * [1, 1, 1, 1, 1, 0.4]
    assert measure(SEEN[:1], SEEN) is None
    assert measure(faint, SEEN) is None
