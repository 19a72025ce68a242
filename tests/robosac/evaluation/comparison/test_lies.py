import csv

import numpy as np
import pytest

from robosac.defenses import OneByOne, Undefended
from robosac.evaluation.comparison import Extent, Plan, Setting, compare_defenses, write_comparison
from robosac.evaluation.comparison.playing import Played
from robosac.evaluation.comparison.rows import ObjectFigures, _objects
from robosac.evaluation.objects import Judged, ObjectHistory
from tests.few import Few

GHOST, FROZEN = Setting("ghost", 1), Setting("frozen", 1)


@pytest.fixture(scope="module")
def compared(detector, tmp_path_factory):
    extent = Extent((GHOST, FROZEN), scenes=2, frames=6)
    defenses = {"no defence": Undefended(), "one_by_one": OneByOne()}
    plan = Plan(detector, defenses, extent, data=Few(), recordings=tmp_path_factory.mktemp("recordings"))
    return plan, compare_defenses(plan)


def test_a_ghost_is_judged_in_every_row(compared):
    _, rows = compared
    at = {row.defense: row.objects for row in rows if row.setting == GHOST}
    assert at["oracle"].held.value == at["ego only"].held.value == 0.0
    assert at["no defence"].held.value > 0.5
    assert at["no defence"].longest > 3
    assert {figures.sequences_shown for figures in at.values()} == {2}
    assert at["no defence"].flagged is at["no defence"].confirmed is None
    assert at["no defence"].shown_named == 0


def test_a_replay_lies_about_no_object(compared):
    _, rows = compared
    assert [row.objects for row in rows if row.setting == FROZEN] == [None] * 4


def test_the_report_has_a_table_of_objects(compared, tmp_path):
    plan, rows = compared
    text = write_comparison(rows, plan, tmp_path, "").read_text()
    section = text.partition("## Objects")[2].partition("\n## ")[0]
    assert "| ghost x 1 | no defence | " in section
    assert "frozen" not in section
    with (tmp_path / "comparison.csv").open() as file:
        lines = {(line["campaign"], line["defense"]): line for line in csv.DictReader(file)}
    ghost, frozen = lines["ghost", "no defence"], lines["frozen", "no defence"]
    assert float(ghost["held"]) > 0.5
    assert ghost["held_se"]
    assert (frozen["held"], frozen["longest"], ghost["flagged"]) == ("", "", "")
    assert ghost["sequences_shown"] == "2"


def test_standard_errors_of_shares_are_those_of_a_naive_jackknife():
    rng = np.random.default_rng(0)
    sequences = [
        ObjectHistory([(Judged(0, told, flagged, "disputed"),)] * int(rng.integers(1, 9)))
        for told, flagged in rng.integers(2, size=(5, 2)).astype(bool).tolist()
    ]
    figures = _objects(sequences)

    def share(some):
        lies = [lie for history in some for frame in history.judged for lie in frame]
        return np.mean([lie.holds for lie in lies])

    without = np.array([share([s for n, s in enumerate(sequences) if n != left_out]) for left_out in range(5)])
    assert figures.held.value == pytest.approx(share(sequences))
    assert figures.held.error == pytest.approx(np.sqrt(4 / 5 * ((without - without.mean()) ** 2).sum()))
    assert isinstance(figures, ObjectFigures)
    assert (figures.confirmed.value, figures.disputed.value) == (0.0, 1.0)
    assert _objects([Played().objects]) is None
