import json

import numpy as np
import pytest

import robosac
from robosac.answers import Reason, Source
from robosac.boxes import pose_matrix
from robosac.budget import DomainError
from robosac.deadline import Deadline
from robosac.defenses import GroupTesting, Reference, SampleConsensus, StaticTeam
from robosac.detectors import Message
from robosac.session import Session
from tests.robosac.test_fusion import EGO, TEAM, FakeDetector

TEMPORAL = SampleConsensus(sampling_budget=7, collaborators=3, reference=Reference.PREVIOUS)


def seen(result):
    return result.source, result.accepted, [o.teammates for o in result.hypotheses], result.boxes.tolist()


def test_a_session_remembers_whom_it_trusts_and_what_it_answered():
    session = Session(FakeDetector("c"), tuple(TEAM), StaticTeam(), rng=np.random.default_rng(0))
    first = session.answer(0, EGO, TEAM)
    assert (first.source, session.state["trusted"]) == (Source.CONSENSUS, list(first.accepted))
    assert session.previous.frame == 0
    again = session.answer(1, EGO, TEAM)
    assert (again.source, again.accepted, again.sampling_steps) == (Source.TRUSTED, first.accepted, 0)


def test_what_is_decided_counts_only_once_it_is_remembered():
    session = Session(FakeDetector("c"), tuple(TEAM), StaticTeam())
    before = session.save()
    result = session.decide(0, EGO, TEAM, np.random.default_rng(0))
    assert session.save() == before
    session.remember(result)
    assert session.save() != before


def test_the_previous_answer_is_the_reference_of_the_next_frame():
    detector = FakeDetector()
    session = Session(detector, tuple(TEAM), TEMPORAL)
    for number in range(2):
        session.answer(number, EGO, TEAM)
    assert detector.decoded.count(()) == 1


@pytest.mark.parametrize("defense", [StaticTeam(recheck_every=2), TEMPORAL])
def test_a_session_that_was_saved_goes_on_as_if_it_had_not_been(defense):
    poses = [pose_matrix(0.5 * i, 0, 0, 0) for i in range(6)]
    whole = Session(FakeDetector("c"), tuple(TEAM), defense, rng=np.random.default_rng(1))
    expected = [seen(whole.answer(i, Message(pose, {}), TEAM)) for i, pose in enumerate(poses)]
    rng, saved, answers = np.random.default_rng(1), None, []
    for i, pose in enumerate(poses):
        session = Session(FakeDetector("c"), tuple(TEAM), defense, saved, rng=rng)
        answers.append(seen(session.answer(i, Message(pose, {}), TEAM)))
        saved = json.loads(json.dumps(session.save()))
    assert answers == expected
    assert whole.previous.motion.shape == (5, 2)


def test_a_deadline_cuts_a_frame_of_a_session_short():
    detector = FakeDetector("abcde", pass_s=1.0)
    session = Session(detector, tuple(TEAM), SampleConsensus())
    assert session.answer(0, EGO, TEAM, Deadline(3.0, clock=detector.clock)).out_of_time


def test_who_leaves_is_trusted_no_more():
    session = Session(FakeDetector(), tuple(TEAM), StaticTeam())
    session.answer(0, EGO, TEAM)
    leaver, *_ = session.state["trusted"]
    session.change_team([name for name in TEAM if name != leaver])
    assert leaver not in session.state["trusted"]


def test_by_default_attackers_are_named(detector, ego_message, attacked):
    session = robosac.Session(detector, sorted(attacked), rng=np.random.default_rng(0))
    assert isinstance(session.defense, GroupTesting)
    for number in range(3):
        answer = session.answer(number, ego_message, attacked)
        assert "car-2" not in answer.accepted
    assert answer.named == ("car-2",)
    assert answer.rejected["car-2"].reason is Reason.DISTRUSTED


def test_a_recording_does_not_say_which_defence_is_the_default():
    with pytest.raises(TypeError, match="which defence"):
        Session(FakeDetector(), tuple(TEAM))


@pytest.mark.parametrize(
    ("name", "fault"),
    [("", "is empty"), ("\ud800", "cannot be written as UTF-8: '\\\\ud800'"), (7, "is no text: 7")],
)
def test_an_id_that_cannot_be_one_is_told_before_any_frame(name, fault):
    session = Session(FakeDetector(), tuple(TEAM), StaticTeam())
    with pytest.raises(DomainError, match=f"team: id 1 {fault}"):
        Session(FakeDetector(), ["a", name], StaticTeam())
    with pytest.raises(DomainError, match=f"team: id 1 {fault}"):
        session.change_team(["a", name])
    with pytest.raises(DomainError, match=f"teammates: id 1 {fault}"):
        session.answer(0, EGO, {"a": TEAM["a"], name: TEAM["b"]})


def test_nobody_is_in_a_team_twice():
    with pytest.raises(DomainError, match="team: id 2 is there twice: 'a'"):
        Session(FakeDetector(), ["a", "b", "a"], StaticTeam())


@pytest.mark.parametrize("name", ["車-1", "\x00", " ", "x" * 10_000, "ego"])
def test_any_other_text_is_an_id(name, detector, messages):
    team = dict(zip([name, "a", "b"], list(messages.values())[1:], strict=False))
    session = robosac.Session(detector, list(team), rng=np.random.default_rng(0))
    answer = session.answer(0, messages["car-1"], team)
    assert (answer.fault, name in answer.suspicion) == (None, True)
    assert robosac.Session(detector, list(team), saved=json.loads(json.dumps(session.save()))).state == session.state
