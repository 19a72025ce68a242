"""Worlds in which honest messages agree less than where they were calibrated."""

import json

import numpy as np
import pytest

from robosac.defenses.group_testing.geometry import PairMeasure
from robosac.defenses.group_testing.model import CHANGE_EDGES, CLEAN, LOSS_EDGES, NOVELTY_EDGES
from robosac.defenses.group_testing.strangeness import PRIOR, STRETCHES, Strangeness, stretched
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
    strangeness.learn(MODEL.pair(0, 1, shown), cells, 1.0)


def test_the_session_learns_how_strange_its_world_is():
    strangeness = Strangeness()
    for _ in range(6):
        told(strangeness, PairMeasure(0.35, 0))
    assert strangeness.weights[2:].sum() > 0.9
    assert strangeness.weights.sum() == pytest.approx(1.0)
    again = Strangeness.from_state(json.loads(json.dumps(strangeness.to_state())))
    assert again.weights == pytest.approx(strangeness.weights)


def test_what_attackers_show_says_nothing_about_the_world():
    strangeness = Strangeness()
    for _ in range(20):
        told(strangeness, PairMeasure(0.9, 20), certain_cell=CLEAN)
    assert strangeness.weights == pytest.approx(np.array(PRIOR))


def test_what_was_learned_fades():
    strangeness = Strangeness(np.array([0.0, 0.0, 0.0, 1.0]))
    for _ in range(400):
        strangeness.step()
    assert strangeness.weights == pytest.approx(np.array(PRIOR), abs=0.01)
