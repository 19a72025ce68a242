import numpy as np
import pytest

from tests.robosac.defenses.group_testing.conversing import make_model

MODEL = make_model()
ROWS = MODEL.pairs.shape[0]


def mutual_information(table, cells):
    joint = cells[:, None] * table
    apart = joint.sum(axis=1, keepdims=True) * joint.sum(axis=0, keepdims=True)
    seen = joint > 0
    return float((joint[seen] * np.log2(joint[seen] / apart[seen])).sum())


def test_what_a_test_promises_is_the_mutual_information(rng):
    cells = rng.dirichlet(np.full(ROWS, 0.3), 12)
    sizes, witnesses, joining = (rng.integers(1, 9, 12) for _ in range(3))
    told = MODEL.jaccard_information(sizes, cells), MODEL.pair_information(witnesses, joining, cells)
    tables = MODEL.jaccard_tables(sizes), MODEL.pair_tables(witnesses, joining)
    for bits, table in zip(told, tables, strict=True):
        assert bits == pytest.approx([mutual_information(t, c) for t, c in zip(table, cells, strict=True)])


def test_what_is_certain_promises_nothing():
    certain = np.eye(ROWS)[[0, 2]]
    assert MODEL.pair_information(np.array([1, 2]), np.array([1, 1]), certain) == pytest.approx([0, 0], abs=1e-9)
