import numpy as np
import pytest

from robosac.attacks import PGD, Erase
from robosac.evaluation import BoundsReport, NoFrames, Sampling, evaluate_bounds
from robosac.evaluation.frames import evaluation_frames
from robosac.scenes import IntersectionScene


def evaluate(detector, attack, scenes, frames, attackers=1, tick=lambda: None, **options) -> BoundsReport:
    rng = np.random.default_rng([0, 0])
    met = evaluation_frames(detector, list(map(IntersectionScene, range(scenes))), frames, attack, attackers, rng)
    return evaluate_bounds(met, attack, Sampling(attackers, **options), tick)


@pytest.fixture(scope="module")
def report(request):
    detector = request.getfixturevalue("detector")
    ticks = []
    report = evaluate(detector, PGD(), 6, 2, repeats=4, tick=lambda: ticks.append(1))
    assert len(ticks) == report.frames == 12
    return report


def test_the_ordering_of_the_paper_holds(report):
    ap = {row.name: row.ap50 for row in report.rows}
    assert ap["all benign"] > ap["3 benign"] > ap["ego only"] > ap["no defence"] + 0.15
    assert ap["Algorithm 1, N = 7"] > ap["Algorithm 1, N = 1"] > ap["ego only"] - 0.02
    assert ap["no subset twice, N = 7"] >= 0.95 * ap["3 benign"]


def test_steps_and_success_follow_the_exact_law(report):
    rows = {row.name: row for row in report.rows}
    assert rows["Algorithm 1, N = 1"].mean_steps == 1.0
    assert rows["Algorithm 1, N = 1"].success_rate == pytest.approx(0.4, abs=0.2)
    assert rows["Algorithm 1, N = 7"].mean_steps == pytest.approx(2.4, abs=0.8)
    assert rows["no subset twice, N = 7"].success_rate >= 0.95
    assert rows["sample_consensus"].success_rate >= 0.95
    assert rows["ego only"].mean_steps is None


def test_rows_do_not_depend_on_what_else_is_evaluated(detector):
    def rows(**options):
        return {row.name: row for row in evaluate(detector, PGD(steps=3), 1, 2, **options).rows}

    few, many = rows(budgets=(1,), repeats=1), rows(budgets=(7, 1), repeats=3)
    for name in ("all benign", "3 benign", "ego only", "no defence"):
        assert few[name] == many[name]


def test_an_attack_that_passes_is_counted_as_infiltration(detector):
    report = evaluate(detector, Erase(), 2, 1, repeats=5, budgets=(7,))
    assert report.miss_rate > 0.9
    assert report.rows[2].infiltrated > 0.3
    honest = evaluate(detector, Erase(), 1, 1, attackers=0, budgets=(7,))
    assert honest.rows[2].infiltrated == 0.0
    assert honest.miss_rate is None


def test_the_cars_take_turns_as_ego(detector):
    frames = evaluation_frames(detector, map(IntersectionScene, range(2)), 3, PGD(steps=1), 1, np.random.default_rng(0))
    everybody = {"car-1", "car-2", "car-3", "car-4", "car-5", "rsu"}
    assert [(everybody - set(frame.benign)).pop() for frame in frames] == [
        "car-1", "car-2", "car-3", "car-4", "car-5", "car-1",
    ]  # fmt: skip


def test_the_attack_is_measured_against_the_features(detector):
    report = evaluate(detector, PGD(steps=1, epsilon=0.25), 1, 1, budgets=(1,))
    (frame,) = evaluation_frames(detector, [IntersectionScene(0)], 1, PGD(steps=1), 1, np.random.default_rng(0))
    magnitudes = np.concatenate([message.tensors["features"].ravel() for message in frame.benign.values()])
    assert report.perturbation_to_feature_ratio == pytest.approx(0.25 / np.percentile(np.abs(magnitudes), 95))


def test_the_consensus_test_is_counted_over_all_hypotheses(report):
    assert report.benign_hypotheses == 12 * 4
    assert report.attacked_hypotheses == 12 * 6
    assert report.false_alarm_rate <= 0.1
    assert report.miss_rate <= 0.1


def test_frames_without_enough_teammates_are_counted_apart(detector):
    frames = list(evaluation_frames(detector, [IntersectionScene(0)], 2, PGD(steps=1), 1, np.random.default_rng(0)))
    report = evaluate_bounds([None, frames[0], None], PGD(), Sampling(budgets=(1,), repeats=1))
    assert (report.frames, report.skipped) == (1, 2)
    with pytest.raises(NoFrames):
        evaluate_bounds([None], PGD())
