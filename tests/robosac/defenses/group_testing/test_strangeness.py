"""Worlds in which honest messages agree less than where they were calibrated."""

import json

import numpy as np
import pytest

from robosac.defenses.group_testing.geometry import PairMeasure
from robosac.defenses.group_testing.model import CHANGE_EDGES, CLEAN, LOSS_EDGES, NOVELTY_EDGES
from robosac.defenses.group_testing.strangeness import PRIOR, STRETCHES, TESTS, Strangeness, stretched
from tests.robosac.defenses.group_testing.conversing import make_model

MODEL = make_model().with_lies
LIES = slice(-3, None)


@pytest.mark.parametrize("edges", [LOSS_EDGES, NOVELTY_EDGES, CHANGE_EDGES])
@pytest.mark.parametrize("factor", STRETCHES)
def test_stretching_moves_probability_upwards_and_loses_none(edges, factor):
    matrix = stretched(edges, factor)
    assert matrix.sum(axis=1) == pytest.approx(np.ones(len(edges) + 1))
    assert matrix[-1, -1] == pytest.approx(1.0)
    assert np.tril(matrix, -1) == pytest.approx(np.zeros_like(matrix))
    if factor == 1.0:
        assert matrix == pytest.approx(np.eye(len(edges) + 1))


def test_a_bin_goes_where_its_values_go():
    assert stretched((1, 2, 4), 2.0)[:3] == pytest.approx(np.array([[0.5, 0.5, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]))


def test_only_what_honest_messages_show_is_stretched():
    shown = PairMeasure(0.35, 0)
    worlds = MODEL.pair(0, 1, shown)
    honest, lies, attacked = worlds[:, 0], worlds[:, LIES], worlds[:, CLEAN:-3]
    assert (honest[1:] > honest[0]).all()
    assert (lies == honest[:, None]).all()
    assert (attacked == attacked[0]).all()
    changes = MODEL.change(1, 20, 6)
    assert (changes[1:, 0] > changes[0, 0]).all()
    assert (changes[:, CLEAN:-3] == changes[0, CLEAN:-3]).all()


def told(strangeness, shown, certain_cell=0):
    cells = np.zeros(MODEL.pairs.shape[0])
    cells[certain_cell] = 1.0
    strangeness.learn("ego", MODEL.pair(0, 1, shown), cells, 1.0)


def test_the_session_learns_how_strange_its_world_is():
    strangeness = Strangeness()
    for _ in range(6):
        told(strangeness, PairMeasure(0.35, 0))
    assert strangeness.weights["ego"][2:].sum() > 0.9
    assert strangeness.weights["ego"].sum() == pytest.approx(1.0)
    again = Strangeness.from_state(json.loads(json.dumps(strangeness.to_state())))
    for test in TESTS:
        assert again.weights[test] == pytest.approx(strangeness.weights[test])


def test_fusions_that_flicker_are_not_made_less_strange_by_those_that_lose_nothing():
    strangeness, cells = Strangeness(), np.zeros(MODEL.pairs.shape[0])
    cells[0] = 1.0
    for _ in range(6):
        told(strangeness, PairMeasure(0.01, 0))
        strangeness.learn("change", MODEL.change(1, 20, 6)[:, : len(cells)], cells, 1.0)
    assert strangeness.weights["ego"][0] > PRIOR[0]
    assert strangeness.weights["change"][0] < 0.1
    assert strangeness.weights["pair"] == pytest.approx(np.array(PRIOR))


def test_what_attackers_show_says_nothing_about_the_world():
    strangeness = Strangeness()
    for _ in range(20):
        told(strangeness, PairMeasure(0.9, 20), certain_cell=CLEAN)
    assert strangeness.weights["ego"] == pytest.approx(np.array(PRIOR))


def test_what_was_learned_fades():
    strangeness = Strangeness({test: np.array([0.0, 0.0, 0.0, 1.0]) for test in TESTS})
    for _ in range(400):
        strangeness.step()
    for test in TESTS:
        assert strangeness.weights[test] == pytest.approx(np.array(PRIOR), abs=0.01)


def test_a_session_kept_by_an_earlier_version_begins_to_learn_anew():
    for test, weights in Strangeness.from_state([0.1, 0.2, 0.3, 0.4]).weights.items():
        assert weights == pytest.approx(np.array(PRIOR)), test
