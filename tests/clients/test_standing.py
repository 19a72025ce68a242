"""How boxes stand: in the fleet's summary, its live table and its picture."""

import io
import json

import numpy as np
import pytest
from matplotlib.image import imread
from rich.console import Console

from clients.screen import Screen
from clients.simulation import Fleet
from clients.standing import Standings, shown
from clients.summary import FleetSummary
from robosac.answers import FrameAnswer, Standing
from robosac.attacks import PGD
from robosac.figures import new_figure
from robosac.fusion import fuse
from robosac.scenes import IntersectionScene
from robosac.scenes.drawing import FOUND_COLOUR, STANDING_COLOURS, draw_answer
from tests.robosac.judging import Judging
from tests.robosac.test_answers import FIELDS


def answer_of(statuses, contradicted=(), known=True):
    boxes = [[5.0 * i, 0.0, 4.0, 2.0, 0.0, score] for i, (_, score) in enumerate(statuses)]
    support = [{"status": status, "witnesses": ["b"], "deniers": []} for status, _ in statuses]
    out = [
        {"status": "contradicted", "witnesses": [], "deniers": ["a"], "box": [0.0, 9.0 * i, 4.0, 2.0, 0.0, score]}
        for i, score in enumerate(contradicted)
    ]
    judged = {"support": support, "contradicted": out} if known else {"support": None, "contradicted": None}
    return FrameAnswer.model_validate({**FIELDS, "boxes": boxes, **judged})


SOME = [("confirmed", 0.9), ("confirmed", 0.8), ("single_witness", 0.7), ("repaired", 0.2)]


def test_boxes_are_counted_by_status():
    standings = Standings()
    assert (standings.as_dict(), standings.sentence()) == (None, None)
    standings.add(answer_of(SOME, known=False))
    assert standings.as_dict() is None
    standings.add(answer_of(SOME, contradicted=[0.5, 0.4]))
    standings.add(answer_of([("disputed", 0.9)], contradicted=[0.5]))
    assert standings.as_dict() == {
        "answered": {"confirmed": 2, "single_witness": 1, "disputed": 1, "repaired": 1, "contradicted": 0},
        "contradicted_left_out": 3,
    }
    assert standings.sentence() == (
        "Boxes answered: 2 confirmed (40.0%), 1 single witness (20.0%), 1 disputed (20.0%), 1 repaired (20.0%). "
        "Contradicted and left out: 3."
    )


def test_answers_without_boxes_have_no_shares():
    standings = Standings()
    standings.add(answer_of([]))
    assert standings.sentence() == "Boxes answered: none. Contradicted and left out: 0."


def test_the_live_table_says_how_many_boxes_were_left_out():
    assert shown(answer_of(SOME)) == "4"
    assert shown(answer_of(SOME, contradicted=[0.5, 0.4])) == "4 [red]-2[/red]"


def drawn(answer, least=0.3):
    axes = new_figure(3, 3).add_subplot()
    draw_answer(axes, answer, least)
    return [(line.get_color(), line.get_linestyle(), line.get_label()) for line in axes.get_lines()]


def test_a_picture_has_boxes_by_their_standing_and_contradicted_ones_dashed():
    lines = drawn(answer_of(SOME, contradicted=[0.5, 0.1]))
    colours = STANDING_COLOURS
    assert [line[:2] for line in lines] == [
        (colours[Standing.CONFIRMED], "-"),
        (colours[Standing.CONFIRMED], "-"),
        (colours[Standing.SINGLE_WITNESS], "-"),
        (colours[Standing.CONTRADICTED], "--"),
    ]
    labels = [label for *_, label in lines if not label.startswith("_")]
    assert labels == ["confirmed (2)", "single witness (1)", "contradicted (1)"]
    assert len(set(colours.values())) == len(Standing) == len(colours)


def test_a_picture_of_boxes_that_nobody_judged_has_one_colour():
    assert {line[:2] for line in drawn(answer_of(SOME, known=False))} == {(FOUND_COLOUR, "-")}
    assert drawn(answer_of([])) == []


@pytest.mark.parametrize("defense", [Judging(), None])
def test_the_report_of_a_fleet_has_it_where_it_is_known(defense, detector, tmp_path):
    fleet = Fleet(IntersectionScene(3), detector, 1, 0, PGD(steps=1), seed=0)
    (frame,) = fleet.sense(0)
    result = fuse(detector, defense or Judging.__base__(), frame.message, frame.sent, rng=np.random.default_rng(0))
    answer = result.answer(0, {}, {"total": 1.0}, frame.ego_id)
    summary = FleetSummary(detector)
    summary.add(frame, answer, 10.0)
    console = Console(file=io.StringIO(), width=200)
    summary.print(console)
    assert imread(summary.write(tmp_path, {})).std() > 0.01
    boxes = json.loads((tmp_path / "summary.json").read_text())["boxes"]
    if defense is None:
        assert boxes is None
        assert "Boxes answered" not in console.file.getvalue()
    else:
        assert sum(boxes["answered"].values()) == len(answer.boxes)
        assert boxes["contradicted_left_out"] == len(answer.contradicted) > 0
        assert "Boxes answered" in console.file.getvalue()
    screen = Screen(console, 1)
    screen.add(3, frame, answer, 10.0)
    console.print(screen.live.get_renderable())
    assert (f"-{len(answer.contradicted or ())} " in console.file.getvalue()) == (defense is not None)
