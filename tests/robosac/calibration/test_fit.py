import numpy as np
import pytest

from robosac.calibration import TooFewVerdicts, Verdicts, fit
from robosac.calibration.fit import LARGEST_CHANGE_RATIO, LARGEST_RATIO
from robosac.defenses.group_testing import OPEN
from robosac.defenses.group_testing.model import (
    BINS,
    CELLS,
    CHANGE_BINS,
    CHANGE_SIZES,
    CLEAN,
    LOSS_BINS,
    NOVELTY_BINS,
    SIZES,
)

ALONE = [size for size, (a, _) in enumerate(SIZES) if a == 0]


def make_verdicts(honest=2 * NOVELTY_BINS + 2, complementary=3 * NOVELTY_BINS + 5, erase=2 * NOVELTY_BINS):
    """Honest pairs lose little and bring a few boxes, PGD destroys, an eraser brings nothing. Under PGD boxes come and
    go; under an eraser they hold strangely still.
    """
    verdicts = Verdicts(team=5)
    for size in range(len(SIZES)):
        verdicts.pairs[None, 0, size, honest] += 500
        for cell in range(1, 1 + CELLS):
            verdicts.pairs[None, cell, size, complementary] += 500
            verdicts.pairs["pgd", cell, size, 10 * NOVELTY_BINS + 8] += 500
            verdicts.pairs["erase", cell, size, erase] += 500
    for size in range(CHANGE_SIZES):
        verdicts.changes[None, size, 3, 1] += 500
        verdicts.changes["pgd", size, 3, 5] += 500
        verdicts.changes["erase", size, 3, 0] += 500
    return verdicts


def log_ratio(model):
    return np.log(model.pairs[CLEAN:] / model.pairs[:1])


def test_tables_show_what_was_observed():
    model = fit(make_verdicts(), ["pgd", "erase"], 0.2)
    assert model.kinds == ("pgd", "erase", OPEN)
    assert model.pose_error_m == 0.2
    assert (model.pairs[0].argmax(axis=-1) == 2 * NOVELTY_BINS + 2).all()
    assert (model.pairs[1:CLEAN].argmax(axis=-1) == 3 * NOVELTY_BINS + 5).all()
    grid = model.pairs.reshape(-1, len(SIZES), LOSS_BINS, NOVELTY_BINS)
    attacked = slice(CLEAN, CLEAN + CELLS)
    assert (grid.sum(axis=-1)[attacked].argmax(axis=-1) >= 9).all()
    assert (grid.sum(axis=-2)[attacked].argmax(axis=-1) >= 7).all()
    beside = [size for size in range(len(SIZES)) if size not in ALONE]
    assert (model.pairs[-CELLS:, beside, 5 * NOVELTY_BINS :] > 0.5 / BINS).all()
    np.testing.assert_allclose(model.pairs.sum(axis=-1), 1.0)


def test_agreeing_with_the_ego_never_incriminates():
    ratio = log_ratio(fit(make_verdicts(), ["pgd", "erase"], 0.0))[:, ALONE]
    grid = ratio.reshape(*ratio.shape[:2], LOSS_BINS, NOVELTY_BINS)
    assert (np.diff(grid, axis=-1) >= -1e-6).all()
    assert (np.diff(grid, axis=-2) >= -1e-6).all()
    erase = grid[CELLS : 2 * CELLS]
    assert (erase[..., 2, 0] < 0.5).all()
    assert (grid[:CELLS, :, 10, 8] > 2).all()


def test_a_pair_without_the_ego_may_incriminate_by_bringing_nothing():
    ratio = log_ratio(fit(make_verdicts(), ["pgd", "erase"], 0.0))
    beside = [size for size in range(len(SIZES)) if size not in ALONE]
    assert (ratio[CELLS : 2 * CELLS, beside, 2 * NOVELTY_BINS] > 2).all()


def test_no_single_outcome_says_too_much():
    ratio = log_ratio(fit(make_verdicts(), ["pgd", "erase"], 0.0))
    assert np.ptp(ratio, axis=-1).max() <= 2 * LARGEST_RATIO + 1e-9
    assert ratio.max() > 2


@pytest.mark.parametrize(
    ("kind", "cell", "message"),
    [
        ("pgd", 2, "pgd: 1 joining 2, attackers among the joined"),
        (None, 0, "no attack: 1 joining 2"),
    ],
)
def test_what_was_never_seen_is_said(kind, cell, message):
    verdicts = make_verdicts()
    for b in range(BINS):
        del verdicts.pairs[kind, cell, SIZES.index((2, 1)), b]
    with pytest.raises(TooFewVerdicts, match=message):
        fit(verdicts, ["pgd", "erase"], 0.0)


def test_where_nobody_was_complementary_it_makes_no_difference():
    verdicts = make_verdicts()
    for size in range(len(SIZES)):
        del verdicts.pairs[None, 3, size, 3 * NOVELTY_BINS + 5]
    model = fit(verdicts, ["pgd", "erase"], 0.0)
    beside = [size for size in range(len(SIZES)) if size not in ALONE]
    np.testing.assert_array_equal(model.pairs[3, beside], model.pairs[0, beside])
    assert not np.array_equal(model.pairs[2, beside], model.pairs[0, beside])


def test_what_comes_and_goes_incriminates_and_what_stays_does_not():
    model = fit(make_verdicts(), ["pgd", "erase"], 0.0)
    np.testing.assert_allclose(model.changes.sum(axis=-1), 1.0)
    assert (model.changes[0, :, 3].argmax(axis=-1) == 1).all()
    np.testing.assert_array_equal(model.changes[3], model.changes[0])
    ratio = np.log(model.changes[1:3] / model.changes[0])
    assert (np.diff(ratio, axis=-1) >= -1e-9).all()
    assert (ratio[0, :, 2:5, 5] > 2).all()
    assert (ratio[0, :, 2:5, 1] < -1).all()
    assert np.ptp(ratio, axis=-1).max() <= 2 * LARGEST_CHANGE_RATIO + 1e-9
    np.testing.assert_allclose(ratio[:, :, 6], 0.0, atol=0.2)  # so many boxes were never seen
    assert model.changes.shape[-1] == CHANGE_BINS


def test_successive_frames_that_were_never_seen_are_said():
    verdicts = make_verdicts()
    del verdicts.changes["pgd", 2, 3, 5]
    with pytest.raises(TooFewVerdicts, match="pgd: 3 in successive frames"):
        fit(verdicts, ["pgd", "erase"], 0.0)


def test_teams_that_are_larger_than_any_observed_are_judged_like_the_largest():
    verdicts = make_verdicts()
    small = Verdicts(team=3)
    for (kind, cell, size, found), count in verdicts.pairs.items():
        if sum(SIZES[size]) <= 3:
            small.pairs[kind, cell, size, found] += count
    for (kind, size, crowd, change), count in verdicts.changes.items():
        if size < 3:
            small.changes[kind, size, crowd, change] += count
    model = fit(small, ["pgd", "erase"], 0.0)
    for larger, shown in (((0, 5), (0, 3)), ((1, 3), (1, 2)), ((3, 2), (2, 1))):
        np.testing.assert_array_equal(model.pairs[:, SIZES.index(larger)], model.pairs[:, SIZES.index(shown)])
    np.testing.assert_array_equal(model.changes[:, 4], model.changes[:, 2])
    with pytest.raises(TooFewVerdicts, match="no attack: 1 joining 0"):
        fit(Verdicts(), ["pgd"], 0.0)
