import dataclasses
from types import SimpleNamespace

import pytest

from robosac.defenses import build, read_settings
from robosac.detectors.base import DetectorInfo, TensorSpec
from robosac.playback.comparing import Compared
from robosac.playback.replay import replay
from robosac.recording.reading import RecordingError, sessions
from tests.recorded import moments, write


@pytest.fixture(scope="module")
def some(recorded_moments):
    return recorded_moments[:4]


@pytest.fixture(scope="module")
def session(detector, some, tmp_path_factory):
    (session,) = sessions(write(tmp_path_factory.mktemp("recording") / "one.mcap", detector, some))
    return session


def test_recorded_decisions_come_out_the_same(session, detector):
    replayed = list(replay(session, detector))
    assert [each.differing for each in replayed] == [()] * 4
    assert replayed[-1].answer.suspicion["car-2"] > 0.9


def test_so_they_do_after_a_gap(detector, some, tmp_path):
    (session,) = sessions(write(tmp_path / "gap.mcap", detector, [some[0], some[3]]))
    assert [each.differing for each in replay(session, detector)] == [(), ()]


def test_so_they_do_where_a_file_goes_on_from_its_own_frames_and_others_are_in_between(detector, tmp_path):
    write(tmp_path / "here.mcap", detector, moments(detector, (0, 2, 4), attacker="car-2"))
    write(tmp_path / "there.mcap", detector, moments(detector, (1, 3), attacker="car-3"))
    (session,) = sessions(tmp_path)
    assert [frame.decided.before is None for frame in session.frames] == [False, False, True, True, True]
    replayed = list(replay(session, detector))
    assert [(each.frame.number, each.differing) for each in replayed] == [(number, ()) for number in range(5)]


def test_a_recording_that_was_changed_does_not(session, detector):
    frame = session.frames[0]
    boxes = frame.answer.boxes.copy()
    boxes[0, 0] += 0.01
    changed = dataclasses.replace(frame, answer=frame.answer.model_copy(update={"boxes": boxes}))
    (only,) = replay(dataclasses.replace(session, frames=[changed]), detector)
    assert only.differing == ("boxes",)


@pytest.mark.parametrize(
    "previous",
    [{}, {"frame": 0, "boxes": [[1, 2]], "motion": []}, {"frame": 0, "boxes": [[0, 0, 4, 2, 0, 0.9]], "motion": []}],
)
def test_what_was_remembered_and_cannot_be_is_told_with_its_frame(session, detector, previous):
    frame = session.frames[0]
    before = frame.decided.before.model_copy(update={"previous": previous})
    changed = dataclasses.replace(frame, decided=frame.decided.model_copy(update={"before": before}))
    with pytest.raises(RecordingError, match=r"one\.mcap, frame 0: no previous answer"):
        list(replay(dataclasses.replace(session, frames=[changed]), detector))


def test_a_state_that_no_defence_left_makes_another_answer(session, detector):
    frame = session.frames[0]
    before = frame.decided.before.model_copy(update={"state": {"log_ratios": "none"}})
    changed = dataclasses.replace(frame, decided=frame.decided.model_copy(update={"before": before}))
    (only,) = replay(dataclasses.replace(session, frames=[changed]), detector)
    assert only.differing


def test_another_defence_decides_otherwise(session, detector):
    undefended = build(read_settings({"kind": "none"}), None)
    compared = Compared()
    for each in replay(session, detector, undefended):
        assert len(each.answer.accepted) == 5
        compared.add(each)
    assert (compared.same, compared.infiltrated[1], compared.with_truth) == (0, 4, 4)
    first, *_, made = compared.lines(0)
    assert first == "  0 of 4 answers are the same"
    assert "a recorded attacker in 4 of 4 answers" in made


def test_a_defence_that_is_not_known_is_named(session, detector):
    opening = session.opening.model_copy(update={"defense": {"kind": "nonesuch"}})
    with pytest.raises(RecordingError, match="make no defence"):
        list(replay(dataclasses.replace(session, opening=opening), detector))


def test_the_layout_of_messages_is_compared_before_the_defence(session):
    tensors = {"map": TensorSpec("float32", (2, 3))}
    info = DetectorInfo("other", {"ego": tensors, "teammate": tensors}, (0, 0, 1, 1), 1.0, "", 0.1)
    with pytest.raises(RecordingError, match=r"other takes a message with map of float32 \[2, 3\], got feat"):
        next(replay(session, SimpleNamespace(info=info)))


def test_a_team_that_changed_is_the_one_that_decides(detector, some, tmp_path):
    smaller = [dataclasses.replace(m, team=m.team[:-1], fused=m.fused[:-1]) for m in some[:1]]
    (session,) = sessions(write(tmp_path / "team.mcap", detector, [*smaller, some[1]]))
    undefended = build(read_settings({"kind": "none"}), None)
    assert [len(each.answer.accepted) for each in replay(session, detector, undefended)] == [4, 5]
