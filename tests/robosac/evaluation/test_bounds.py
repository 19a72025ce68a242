import pytest

from robosac.attacks import PGD
from robosac.evaluation import evaluate_bounds


@pytest.fixture(scope="module")
def report(request):
    detector = request.getfixturevalue("detector")
    ticks = []
    report = evaluate_bounds(
        detector, PGD(), seeds=range(6), frames_per_scene=2, repeats=4, tick=lambda: ticks.append(1)
    )
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
    assert rows["ego only"].mean_steps is None


def test_the_consensus_test_is_counted_over_all_hypotheses(report):
    assert report.benign_hypotheses == 12 * 4
    assert report.attacked_hypotheses == 12 * 6
    assert report.false_alarm_rate <= 0.1
    assert report.miss_rate <= 0.1
