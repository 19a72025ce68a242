import numpy as np
import pytest

from robosac.defenses.group_testing.model import (
    BINS,
    CELLS,
    CHANGE_BINS,
    CHANGE_EDGES,
    CHANGE_SIZES,
    CLEAN,
    CROWD_BINS,
    CROWD_EDGES,
    LIE,
    SIZES,
    CalibrationError,
    EvidenceModel,
    size_row,
)
from robosac.defenses.group_testing.posterior import Posterior
from tests.robosac.defenses.group_testing.conversing import make_model

KINDS = 3
ROWS = CLEAN + CELLS * KINDS


@pytest.fixture
def model(rng):
    """Likelihoods without any order, reckoned with bin by bin."""
    changes = rng.dirichlet(np.ones(CHANGE_BINS), (1 + KINDS, CHANGE_SIZES, CROWD_BINS))
    return EvidenceModel(0.0, ("x", "y", "z"), rng.dirichlet(np.ones(BINS), (ROWS, len(SIZES))), changes, coarse=(1, 1))


def mutual_information(table, cells):
    """Between the outcome and the part of the pair that attackers are in."""
    parts = [range(CLEAN), *(range(CLEAN + cell, ROWS, CELLS) for cell in range(CELLS))]
    joint = np.array([(cells[list(part), None] * table[list(part)]).sum(axis=0) for part in parts])
    apart = joint.sum(axis=1, keepdims=True) * joint.sum(axis=0, keepdims=True)
    seen = joint > 0
    return float((joint[seen] * np.log2(joint[seen] / apart[seen])).sum())


def test_what_a_test_promises_is_the_mutual_information(model, rng):
    cells = rng.dirichlet(np.full(ROWS, 0.3), 12)
    a, d = rng.integers(0, 9, 12), rng.integers(1, 9, 12)
    expected = [mutual_information(t, c) for t, c in zip(model.tables(a, d), cells, strict=True)]
    assert model.information(a, d, cells) == pytest.approx(expected)
    assert max(expected) > 0.1


def test_coarser_bins_promise_less_but_not_nothing(model, rng):
    cells = rng.dirichlet(np.full(ROWS, 0.3), 12)
    a, d = np.full(12, 2), np.ones(12, dtype=int)
    exact = model.information(a, d, cells)
    coarse = EvidenceModel(0.0, model.kinds, model.pairs, model.changes).information(a, d, cells)
    assert (coarse <= exact).all()
    assert (coarse > 0).all()


@pytest.mark.parametrize("truth", [0, 1, CLEAN, CLEAN + 4])
def test_what_is_certain_promises_nothing(truth):
    certain = np.eye(ROWS)[[truth]]
    assert make_model().information(np.array([1]), np.array([1]), certain) == pytest.approx([0], abs=1e-9)


def test_neither_the_kind_nor_whose_view_is_complementary_is_worth_knowing(model):
    a, d = np.array([1, 1]), np.array([1, 1])
    which = np.zeros((2, ROWS))
    which[0, [CLEAN, CLEAN + CELLS]] = 0.5  # d attacks, in one of two ways
    which[1, [0, 1]] = 0.5  # nobody does, and d is complementary or not
    assert model.information(a, d, which) == pytest.approx([0, 0], abs=1e-9)


def test_larger_sizes_count_as_the_largest_told_apart():
    a, d = np.array([0, 0, 1, 3, 9]), np.array([1, 7, 3, 2, 9])
    assert [SIZES[row] for row in size_row(a, d)] == [(0, 1), (0, 5), (1, 3), (3, 2), (3, 2)]


@pytest.mark.parametrize("size", [1, 3, 5, 9])
def test_changes_are_as_likely_as_calibrated(model, size):
    boxes, changes = CROWD_EDGES[1], CHANGE_EDGES[2] + 1
    likelihood = model.change(size, boxes, changes)[0]
    table = model.changes[:, min(size, CHANGE_SIZES) - 1, 2, 3]
    assert likelihood[:CLEAN] == pytest.approx([table[0]] * CLEAN)
    assert likelihood[CLEAN:].reshape(KINDS, CELLS) == pytest.approx(np.repeat(table[1:, None], CELLS, axis=1))


def test_what_changes_promise_is_the_mutual_information(model, rng):
    cells = rng.dirichlet(np.full(ROWS, 0.3), 12)
    cells.reshape(12, ROWS)[:, [c for c in range(CLEAN, ROWS) if (c - CLEAN) % CELLS]] = 0.0  # nobody is in a
    cells /= cells.sum(axis=1, keepdims=True)
    sizes, boxes = rng.integers(1, 9, 12), rng.integers(0, 50, 12)
    expected = []
    for size, number, cell in zip(sizes, boxes, cells, strict=True):
        table = np.array([model.change(size, number, c)[0] for c in (0, *CHANGE_EDGES)]).T
        expected.append(mutual_information(table, cell))
    assert model.change_information(sizes, boxes, cells) == pytest.approx(expected)
    assert max(expected) > 0.1


def test_lies_look_like_nobody_attacks(model, rng):
    """Whatever a whole fusion shows, it says nothing of lies: for the other kinds all is as before."""
    lying = model.with_lies
    assert lying.kinds == (*model.kinds, LIE)
    a, d = rng.integers(0, 9, 12), rng.integers(1, 9, 12)
    tables = lying.tables(a, d)
    np.testing.assert_array_equal(tables[:, :ROWS], model.tables(a, d))
    np.testing.assert_array_equal(tables[:, ROWS:], np.repeat(tables[:, :1], CELLS, axis=1))
    likelihood = lying.change(2, CROWD_EDGES[1], CHANGE_EDGES[2])[0]
    np.testing.assert_array_equal(likelihood[:ROWS], model.change(2, CROWD_EDGES[1], CHANGE_EDGES[2])[0])
    np.testing.assert_array_equal(likelihood[ROWS:], likelihood[:CELLS])


def test_honest_looks_clear_nobody_of_lies():
    """They raise the odds of "clean" and of a lie alike, and lower those of the other kinds."""
    model = make_model().with_lies
    posterior = Posterior(len(model.kinds), 0.5, 0.25, ["a", "b"])
    rows = np.array([[False, False], [True, False]])

    def cells():
        found = posterior.cells(*posterior.masks(rows)[:, :, None].swapaxes(0, 1))[0]
        return found[:CLEAN].sum(), found[CLEAN:].reshape(-1, CELLS).sum(axis=1)

    clean, kinds = cells()
    best = int(model.tables(np.array([0]), np.array([1]))[0, 0].argmax())
    for _ in range(3):
        posterior.update(*rows, np.log(model.tables(np.array([0]), np.array([1]))[0, :, best]))
    after, left = cells()
    lie, pgd = model.kinds.index(LIE), model.kinds.index("pgd")
    assert left[lie] / after == pytest.approx(kinds[lie] / clean)
    assert left[pgd] / after < 0.1 * kinds[pgd] / clean


@pytest.mark.parametrize("table", ["pairs", "changes"])
def test_tables_that_are_none_are_refused(model, table):
    tables = {"pairs": model.pairs, "changes": model.changes}
    with pytest.raises(CalibrationError, match=f"{table} must have the shape"):
        EvidenceModel(0.0, model.kinds, **{**tables, table: tables[table][1:]})
    with pytest.raises(CalibrationError, match=f"{table} must hold positive probabilities that sum to 1"):
        EvidenceModel(0.0, model.kinds, **{**tables, table: tables[table] * 2})
