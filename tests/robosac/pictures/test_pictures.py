"""A short sequence, drawn; what is drawn is what was decided."""

import numpy as np
import pytest
from matplotlib.collections import PolyCollection
from PIL import Image

from robosac.answers import Standing, Verdict
from robosac.consensus import at_least
from robosac.defenses import read_settings
from robosac.figures import check_film, new_figure
from robosac.pictures import above
from robosac.pictures.film import draw_film, draw_moment
from robosac.pictures.frame import MOST_TESTS, frame_figure
from robosac.pictures.moments import Scenario, moments
from robosac.pictures.suspicion import FUSED, LEFT_OUT, NAMED, suspicion_figure
from robosac.scenes import SOURCES, one_scene

FRAMES = 3


@pytest.fixture(scope="module")
def scenario(detector):
    """With an attack that costs little."""
    source = SOURCES.make("synthetic")
    return Scenario(
        detector, source, one_scene(source, "test", 0, FRAMES), "tests.robosac.pictures.quick:attack", 1, FRAMES
    )


@pytest.fixture(scope="module")
def met(scenario):
    return scenario.met()


@pytest.fixture(scope="module")
def played(scenario, met):
    return moments(scenario, met, read_settings({"kind": "group_testing"}))


@pytest.fixture(scope="module")
def sampled(scenario, met):
    return moments(scenario, met, read_settings({"kind": "sample_consensus"}))


def outlines(axes, line):
    """How many boxes of a kind of line there are."""
    colour = above.BLUE if line is None else line.colour
    wanted = np.array([int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)])
    return sum(
        len(part.get_paths())
        for part in axes.collections
        if isinstance(part, PolyCollection)
        and not len(part.get_facecolor())
        and np.allclose(part.get_edgecolor()[0, :3], wanted)
        and np.isclose(part.get_linewidth()[0], line.width)
    )


def marked(axes, kind):
    """Places of the marks of a kind."""
    shape, colour, _ = above.MARKS[kind]
    lines = [line for line in axes.get_lines() if line.get_marker() == shape]
    return sum(
        len(line.get_xdata()) for line in lines if colour in (line.get_markeredgecolor(), line.get_markerfacecolor())
    )


def test_the_scenario_is_that_of_a_comparison(scenario, met):
    (attacker,) = scenario.controlled
    assert {name for frame in met for name in frame.attackers} == {attacker}
    assert scenario.title == f"synthetic, scene 0: {attacker} attacks by tests.robosac.pictures.quick:attack"


def test_a_frame_has_a_panel_for_each_test_with_its_verdict(played):
    moment = played[1]
    view, team, own, *panels = frame_figure(moment, "").axes
    tests = moment.result.hypotheses
    shown = [axes for axes in panels if axes.axison]
    assert len(shown) == len(tests) <= MOST_TESTS
    assert outlines(own, above.OWN) == len(moment.fused())
    for axes, test in zip(shown, tests, strict=True):
        title = axes.get_title()
        assert f"{test.verdict.value.replace('_', ' ')}, agreement {test.jaccard_index:.2f}" in title
        assert (" *" in title) == (not moment.met.attackers.isdisjoint(test.teammates))
        assert outlines(axes, above.FUSED) == len(at_least(test.boxes, moment.met.info.consensus_score))
    assert {test.verdict for test in tests} >= {Verdict.CONSENSUS}
    assert f"fused with {', '.join(moment.result.accepted)}" in view.get_title()
    assert [label.get_text().rstrip("*") for label in team.get_yticklabels()] == list(moment.met.team)


def test_boxes_of_the_answer_are_drawn_as_they_stand(played):
    moment = played[-1]
    view = frame_figure(moment, "").axes[0]
    statuses = [each.status for each in moment.answer.support]
    certain = moment.answer.boxes[:, 5] >= moment.met.info.consensus_score
    for standing, line in above.STANDINGS.items():
        if standing is not Standing.CONTRADICTED:
            told = [kept for kept, status in zip(certain, statuses, strict=True) if status is standing]
            assert outlines(view, line) == sum(told)
    assert sum(certain) > 5


def test_the_evidence_on_boxes_is_that_of_the_defence(played):
    moment = played[1]
    _, _, _, *panels = frame_figure(moment, "").axes
    seen = set()
    for axes, test in zip(panels, moment.result.hypotheses, strict=False):
        places = {}
        for difference in moment.result.differences:
            if set(difference.teammates) == set(test.teammates):
                for kind, where in difference.places().items():
                    places.setdefault(kind, set()).update(map(tuple, where.round(1).tolist()))
        assert places
        for kind, where in places.items():
            assert marked(axes, kind) == len(where), kind
            seen |= {kind} if where else set()
    assert {"moved", "added"} <= seen


def test_a_defence_that_judges_no_boxes_is_drawn_too(sampled):
    view, team, _, *panels = frame_figure(sampled[0], "").axes
    assert outlines(view, above.ANSWERED) == len(sampled[0].found)
    assert "knows no suspicion" in team.get_title()
    for axes, test in zip(panels, sampled[0].result.hypotheses, strict=False):
        matched = len(test.reference) - marked(axes, "lost")
        others = marked(axes, "lost") + marked(axes, "added")
        assert test.jaccard_index == pytest.approx(matched / (matched + others))


def test_suspicion_and_fates_are_those_of_the_frames(played):
    lines, fates, *_ = suspicion_figure(played, "").axes
    drawn = {line.get_label().rstrip("*"): line.get_ydata() for line in lines.get_lines()}
    assert drawn.keys() == set(played[0].met.team)
    for name, values in drawn.items():
        assert list(values) == [moment.result.suspicion[name] for moment in played]
    assert max(drawn[name][-1] for name in played[0].met.attackers) > 0.9
    rows = [label.get_text().rstrip("*") for label in fates.get_yticklabels()]
    for (_, colour, _), wanted in (
        (FUSED, lambda moment, name: name in moment.result.accepted),
        (NAMED, lambda moment, name: name in moment.named),
        (LEFT_OUT, lambda moment, name: name not in (*moment.result.accepted, *moment.named)),
    ):
        marks = [line for line in fates.get_lines() if line.get_color() == colour]
        places = {(rows[int(y)], int(x)) for line in marks for x, y in zip(*line.get_data(), strict=True)}
        assert places == {(name, m.number) for m in played for name in m.met.team if wanted(m, name)}


def test_without_suspicion_there_are_only_fates(sampled):
    (fates,) = suspicion_figure(sampled, "").axes
    assert len(fates.get_yticklabels()) == 5


def test_a_film_has_both_sides_and_as_many_frames(played, tmp_path):
    figure = new_figure(9, 6)
    draw_moment(figure, played, 1, "scene", "group_testing")
    left, right, below = figure.axes
    found, false = outlines(left, above.FOUND), outlines(left, above.FALSE)
    everybody = played[1].fused(*played[1].met.team)
    assert found + false == len(everybody)
    assert f"{found} of {len(played[1].met.truth)} found, {false} not there" in left.get_xlabel()
    assert outlines(right, above.FOUND) + outlines(right, above.FALSE) == len(played[1].found)
    assert outlines(right, above.FOUND) > found
    assert all(len(line.get_ydata()) == 2 for line in below.get_lines())
    draw_film(played, tmp_path / "x.gif", "scene", "group_testing", fps=4)
    with Image.open(tmp_path / "x.gif") as film:
        assert (film.n_frames, film.info["duration"], film.info["loop"]) == (FRAMES, 250, 0)
        first = np.asarray(film.convert("RGB"))
        film.seek(FRAMES - 1)
        assert np.abs(first.astype(int) - np.asarray(film.convert("RGB"))).mean() > 1


@pytest.mark.parametrize(("name", "why"), [("x.png", "ends with .gif or .mp4"), ("x", "no suffix")])
def test_a_film_of_another_suffix_is_refused(name, why, tmp_path):
    with pytest.raises(ValueError, match=why):
        check_film(tmp_path / name)
