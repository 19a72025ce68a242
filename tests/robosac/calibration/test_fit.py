import numpy as np
import pytest

from robosac.calibration import TooFewVerdicts, Verdicts, fit
from robosac.calibration.fit import LARGEST_RATIO
from robosac.defenses.group_testing import OPEN
from robosac.defenses.group_testing.model import (
    CELLS,
    JACCARD_BINS,
    JOINING_SIZES,
    LOSS_BINS,
    NOVELTY_BINS,
    SIZES,
    WITNESS_SIZES,
)

BINS = LOSS_BINS * NOVELTY_BINS


def make_verdicts(honest_index=7, pgd_index=1, erase_index=9):
    verdicts = Verdicts()
    for size in range(1, SIZES + 1):
        for kind, index in ((None, honest_index), ("pgd", pgd_index), ("erase", erase_index)):
            verdicts.jaccard[kind, size, index] += 500
    for a in range(1, WITNESS_SIZES + 1):
        for d in range(1, JOINING_SIZES + 1):
            verdicts.pairs[None, 0, a, d, 2 * NOVELTY_BINS] += 500
            for cell in range(1, CELLS + 1):
                verdicts.pairs["pgd", cell, a, d, 10 * NOVELTY_BINS] += 500
                verdicts.pairs["erase", cell, a, d, 5 * NOVELTY_BINS] += 500
    return verdicts


def test_tables_show_what_was_observed():
    model = fit(make_verdicts(), ["pgd", "erase"], 0.2)
    assert model.kinds == ("pgd", "erase", OPEN)
    assert model.pose_error_m == 0.2
    assert (model.jaccard[0].argmax(axis=-1) == 7).all()
    assert (model.jaccard[1, :, :3].sum(axis=-1) > 0.8).all()
    assert (model.pairs[0].argmax(axis=-1) == 2 * NOVELTY_BINS).all()
    loss = model.pairs.reshape(-1, WITNESS_SIZES, JOINING_SIZES, LOSS_BINS, NOVELTY_BINS).sum(axis=-1)
    assert (loss[1 : 1 + CELLS].argmax(axis=-1) == 9).all()
    for table in (model.jaccard, model.pairs):
        np.testing.assert_allclose(table.sum(axis=-1), 1.0)


def test_agreeing_with_the_ego_never_incriminates():
    model = fit(make_verdicts(), ["pgd", "erase"], 0.0)
    ratio = np.log(model.jaccard[1:] / model.jaccard[:1])
    assert (np.diff(ratio, axis=-1) <= 1e-9).all()
    np.testing.assert_allclose(ratio[1, :, 8:], ratio[1, :, 6:7] * np.ones(2), atol=0.2)
    assert (ratio[0, :, 1] > 2).all()


def test_no_single_outcome_says_too_much():
    model = fit(make_verdicts(), ["pgd", "erase"], 0.0)
    spread = np.log(model.pairs[1:] / model.pairs[:1])
    assert spread.max() - spread.min() < 2 * LARGEST_RATIO + 1
    assert spread.max() > 2


def test_what_was_never_seen_is_said():
    verdicts = make_verdicts()
    for b in range(JACCARD_BINS):
        del verdicts.jaccard["pgd", 3, b]
    with pytest.raises(TooFewVerdicts, match="no verdicts of pgd, size 3"):
        fit(verdicts, ["pgd", "erase"], 0.0)
