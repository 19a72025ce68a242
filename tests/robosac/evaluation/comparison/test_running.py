import shutil
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from robosac.cli import app
from robosac.defenses import OneByOne, SampleConsensus
from robosac.detectors.embedded import SHIPPED_WEIGHTS
from robosac.evaluation.comparison import Extent, Plan, Setting, compare_defenses
from robosac.evaluation.comparison.playing import play_scene
from robosac.evaluation.playing import FaultyDefense
from tests.few import Few
from tests.robosac.evaluation.comparison.test_comparison import Broken

DEFENSES = {"sampling": SampleConsensus(), "one_by_one": OneByOne()}


@pytest.fixture(scope="module")
def plan(detector, tmp_path_factory):
    extent = Extent((Setting("noise", 1), Setting("noise@turns", 2)), scenes=2, frames=6)
    return Plan(detector, DEFENSES, extent, data=Few(), recordings=tmp_path_factory.mktemp("recordings"))


def test_the_number_of_jobs_changes_nothing(plan):
    ticks = []
    together = compare_defenses(plan, 2, lambda: ticks.append(1))
    assert len(ticks) == 24
    assert together == compare_defenses(plan)


def test_a_defence_that_fails_in_another_process_stops_the_comparison(plan):
    with pytest.raises(FaultyDefense, match="worse, frame 0: RuntimeError: broken"):
        compare_defenses(replace(plan, defenses={"worse": Broken()}, live=True, recordings=None), 2)


def test_live_and_recorded_answers_are_the_same(plan):
    scene = plan.scenes()[1]
    live = play_scene(replace(plan, live=True, recordings=None), scene)
    recorded = play_scene(plan, scene)
    assert live.keys() == recorded.keys()
    for row, one in live.items():
        other = recorded[row]
        assert (one.passes, one.infiltrated, one.refused) == (other.passes, other.infiltrated, other.refused)
        for mine, its in zip(one.matched, other.matched, strict=True):
            np.testing.assert_allclose(mine.scores, its.scores, atol=1e-6)
            np.testing.assert_allclose(mine.iou, its.iou, atol=1e-4)


def test_only_live_defences_are_timed(plan):
    live = replace(plan, live=True, recordings=None, extent=Extent((Setting("noise", 1),), scenes=1, frames=6))
    oracle, sampling, one_by_one, alone = compare_defenses(live)
    assert oracle.milliseconds is alone.milliseconds is None
    assert sampling.milliseconds > 0.0
    assert one_by_one.milliseconds > 0.0
    recorded = compare_defenses(replace(plan, extent=live.extent))
    assert [row.milliseconds for row in recorded] == [None] * 4


@pytest.mark.parametrize("column", ["group_testing", "one_by_one"])
def test_it_is_said_that_no_objects_are_judged(column, tmp_path):
    weights = tmp_path / "own.safetensors"
    for path in (SHIPPED_WEIGHTS, SHIPPED_WEIGHTS.with_suffix(".calibration.json")):
        shutil.copy(path, weights.with_suffix("".join(path.suffixes)))
    short = ["--setting", "honest:0", "--scenes", "1", "--frames", "6", "--live"]
    arguments = ["compare", "--detector", str(weights), "--only", column, *short, "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(app, arguments, env={"COLUMNS": "200"})
    assert result.exit_code == 0, result.output
    told = "intersection-mean has no witness, so group testing judges no single objects with it: robosac witness makes"
    told_in = told in result.output, told in (tmp_path / "out" / "comparison.md").read_text()
    assert told_in == ((column == "group_testing"),) * 2
