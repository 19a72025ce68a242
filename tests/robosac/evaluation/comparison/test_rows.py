import numpy as np
import pytest

from robosac.evaluation.average_precision import match
from robosac.evaluation.comparison.playing import Naming, Played
from robosac.evaluation.comparison.rows import NamingFigures, precisions, sum_up
from robosac.evaluation.comparison.settings import NOBODY
from robosac.evaluation.standing import TrueBoxes

TRUTH = np.array([[10.0 * i, 0.0, 4.0, 2.0, 0.0] for i in range(5)])


def sequence(rng, spread, frames=12, infiltrated=()):
    """A sequence whose answers are the truth, the worse the wider the spread."""
    played = Played()
    for index in range(frames):
        truth = TRUTH[: rng.integers(2, 6)]
        found = truth[rng.integers(0, len(truth), 7)] + rng.normal(0.0, spread, (7, 5)) * [1, 1, 0, 0, 0]
        played.matched.append(match(np.column_stack([found, rng.random(7)]), truth))
        played.infiltrated.append(index in infiltrated)
        played.refused.append(index % 2)
        played.honest.append(4)
        played.passes.append(index)
        played.milliseconds.append(float(index))
    return played


@pytest.fixture
def oracle(rng):
    return [sequence(rng, 0.1) for _ in range(4)]


@pytest.fixture
def played(rng):
    return [sequence(rng, 0.2 + 0.1 * n, infiltrated=(0, 7, 11)) for n in range(4)]


def figures(played, oracle):
    return sum_up(NOBODY, "x", played, precisions(oracle)).windows


@pytest.mark.parametrize("first", [0, 5, 10])
@pytest.mark.parametrize("name", ["ap50", "ap70", "ap50_difference", "ap70_difference", "ap70_ratio"])
def test_standard_errors_are_those_of_a_naive_jackknife(first, name, played, oracle):
    estimate = getattr(figures(played, oracle)[first], name)
    without = []
    for left_out in range(4):
        rest = [[s for n, s in enumerate(of) if n != left_out] for of in (played, oracle)]
        without.append(getattr(figures(*rest)[first], name).value)
    squares = [(value - np.mean(without)) ** 2 for value in without]
    assert estimate.error == pytest.approx(np.sqrt(3 / 4 * sum(squares)))
    assert estimate.error > 1e-4


def test_a_window_holds_the_frames_from_its_first_on(played, oracle):
    windows = figures(played, oracle)
    assert {first: w.infiltrated for first, w in windows.items()} == {0: 3 / 12, 5: 2 / 7, 10: 1 / 2}
    for of in (*played, *oracle):
        for frames in (of.matched, of.infiltrated):
            del frames[:5]
    later = figures(played, oracle)
    assert later[0] == windows[5]
    assert later[5] == windows[10]
    assert 10 not in later


def test_a_figure_is_compared_with_the_oracle_on_the_same_sequences(played, oracle):
    own, ideal = figures(played, oracle)[5], figures(oracle, oracle)[5]
    assert own.ap70_difference.value == pytest.approx(own.ap70.value - ideal.ap70.value)
    assert own.ap50_difference.value == pytest.approx(own.ap50.value - ideal.ap50.value)
    assert own.ap70_ratio.value == pytest.approx(own.ap70.value / ideal.ap70.value)
    assert (ideal.ap70_difference.value, ideal.ap70_difference.error) == (0.0, 0.0)
    assert (ideal.ap70_ratio.value, ideal.ap70_ratio.error) == (1.0, 0.0)


def test_a_single_sequence_has_no_standard_error(played, oracle):
    (window, *_) = figures(played[:1], oracle[:1]).values()
    assert window.ap70.error is window.ap70_ratio.error is None


def test_there_is_no_ratio_to_nothing(rng, played):
    blind = [sequence(rng, 1e3) for _ in range(4)]
    assert figures(played, blind)[0].ap70_ratio is None
    assert figures(blind, played)[0].ap70_ratio.value == 0.0


def test_passes_refusals_and_times(played, oracle):
    row = sum_up(NOBODY, "x", played, precisions(oracle), live=True)
    assert (row.passes_first, row.passes_early, row.passes_steady) == (0.0, 2.5, 8.0)
    assert (row.honest_refused, row.milliseconds) == (1 / 8, 5.5)
    assert sum_up(NOBODY, "x", played, precisions(oracle)).milliseconds is None


def test_naming_is_summed_over_sequences(played, oracle):
    namings = [Naming(2, (1, 4), 4, 1, 3), Naming(2, (7,), None, 0, 3), Naming(0, (), None, 0, 3), None]
    for one, naming in zip(played, namings, strict=True):
        one.naming = naming
    row = sum_up(NOBODY, "x", played, precisions(oracle))
    assert row.naming == NamingFigures(0.5, 4.0, 3, 4, 4.0, 7, 1, 9, 1, 3)


def test_shares_of_true_boxes_are_those_of_all_sequences(played, oracle):
    assert sum_up(NOBODY, "x", played, precisions(oracle)).standing is None
    counts = [TrueBoxes(10, 9, 0), TrueBoxes(30, 20, 1), TrueBoxes(20, 20, 0), TrueBoxes(5, 4, 1)]
    for one, count in zip(played, counts, strict=True):
        one.standing = [count, count]
    standing = sum_up(NOBODY, "x", played, precisions(oracle)).standing
    assert standing.true_judged == 130
    for name, share in (("confirmed", 53 / 65), ("contradicted", 2 / 65)):
        figure = getattr(standing, f"true_{name}")
        assert figure.value == pytest.approx(share)
        without = [
            sum(getattr(c, name) for c in counts if c != left_out) / sum(c.judged for c in counts if c != left_out)
            for left_out in counts
        ]
        assert figure.error == pytest.approx(np.sqrt(3 / 4 * ((without - np.mean(without)) ** 2).sum()))
        assert figure.times(1000).error == pytest.approx(1000 * figure.error)
