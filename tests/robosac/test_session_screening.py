"""Sessions whose teammates send what they, or others, sent before."""

import json
import logging

import numpy as np

from robosac.answers import Reason
from robosac.boxes import pose_matrix
from robosac.defenses import StaticTeam, Undefended
from robosac.detectors import Message
from robosac.screening import MEMORY, Bounds, Screening
from robosac.session import Session, changed_team
from tests.robosac.fusing import FakeDetector

SHAPE = (4, 16, 16)


def frames(count, frozen=("c",), seed=0):
    """What the ego and three teammates send; all drive, and some of them send their first map again and again."""
    rng = np.random.default_rng(seed)
    first = {name: rng.normal(size=SHAPE).astype(np.float16) for name in ("", *"abc")}
    for i in range(count):
        sent = {n: m if n in frozen else rng.normal(size=SHAPE).astype(np.float16) for n, m in first.items()}
        messages = {
            name: Message(pose_matrix(4.0 * i, 9.0 * number, 1.9, 0.0), {"features": tensor})
            for number, (name, tensor) in enumerate(sent.items())
        }
        yield messages.pop(""), messages


def test_a_teammate_that_repeats_itself_is_rejected_and_the_defence_never_meets_it():
    detector = FakeDetector()
    session = Session(detector, [*"abc"], Undefended())
    answers = [session.answer(i, *messages) for i, messages in enumerate(frames(4))]
    assert answers[0].accepted == ("a", "b", "c")
    for frame, result in enumerate(answers[1:], 1):
        assert (result.accepted, set(result.rejected)) == (("a", "b"), {"c"})
        assert result.rejected["c"].reason is Reason.REPEATED
        assert result.rejected["c"].evidence == {"of_frame": 0, "moved_m": 4.0 * frame, "correlation": 1.0}
        assert result.timings_ms["screening"] > 0
    assert detector.decoded[1:] == [("a", "b")] * 3
    answer = answers[1].answer(1, {}, {})
    assert answer.rejected["c"]["moved_m"] == 4.0


def test_a_session_without_the_tests_takes_all_and_remembers_nothing_of_messages():
    session = Session(FakeDetector(), [*"abc"], Undefended(), screening=None)
    for i, messages in enumerate(frames(3)):
        assert session.answer(i, *messages).accepted == ("a", "b", "c")
    assert MEMORY not in session.state


def test_what_the_tests_remember_is_saved_and_hidden_from_the_defence():
    class Watching(StaticTeam):
        def converse(self, team, state, rng):
            assert MEMORY not in state
            return (yield from super().converse(team, state, rng))

    saved, refused = None, []
    for i, messages in enumerate(frames(4)):
        session = Session(FakeDetector(), [*"abc"], Watching(), saved)
        result = session.answer(i, *messages)
        assert result.fault is None
        refused.append("c" in result.rejected and result.rejected["c"].reason is Reason.REPEATED)
        saved = json.loads(json.dumps(session.save()))
    assert refused == [False, True, True, True]
    assert set(saved["state"][MEMORY]) == {"", "a", "b", "c"}


def test_a_change_of_the_team_forgets_nothing_that_was_sent():
    session = Session(FakeDetector(), [*"abc"], StaticTeam())
    sent = list(frames(2))
    session.answer(0, *sent[0])
    session.change_team([*"bc"])
    ego, others = sent[1]
    result = session.answer(1, ego, {name: others[name] for name in "bc"})
    assert result.rejected["c"].reason is Reason.REPEATED
    assert changed_team(session.defense, {"trusted": ["b"], "frames_since_check": 0}, ["b"]).keys().isdisjoint({MEMORY})


def test_what_was_sent_counts_even_where_the_fusion_failed(caplog):
    detector = FakeDetector()
    session = Session(detector, [*"abc"], Undefended())
    sent = list(frames(2))
    detector.broken = "detect"
    with caplog.at_level(logging.CRITICAL):
        assert session.answer(0, *sent[0]).fault
    detector.broken = ""
    assert session.answer(1, *sent[1]).rejected["c"].reason is Reason.REPEATED


def test_who_is_refused_is_rejected_for_it_also_where_the_fusion_fails(caplog):
    session = Session(FakeDetector(broken="detect"), [*"abc"], Undefended())
    with caplog.at_level(logging.CRITICAL):
        results = [session.answer(i, *messages) for i, messages in enumerate(frames(2))]
    reasons = {name: why.reason for name, why in results[1].rejected.items()}
    assert reasons == {"a": Reason.NOT_SAMPLED, "b": Reason.NOT_SAMPLED, "c": Reason.REPEATED}


def test_a_copy_of_the_egos_map_is_answered_with_the_egos_id():
    session = Session(FakeDetector(), [*"abc"], Undefended())
    ego, others = next(frames(1))
    result = session.answer(0, ego, {**others, "b": Message(others["b"].pose, ego.tensors)})
    answer = result.answer(0, {}, {}, "car-1")
    assert (answer.rejected["b"].reason, answer.rejected["b"]["of"]) == (Reason.COPIED, "car-1")
    assert [(each.vehicle, each.other) for each in answer.alike] == [("car-1", "b")]


def test_an_implausible_message_is_refused_where_bounds_are_known():
    session = Session(FakeDetector(), [*"abc"], Undefended(), screening=Screening({"features": Bounds(3.0, 1.0, 0.99)}))
    ego, others = next(frames(1))
    loud = Message(others["a"].pose, {"features": others["a"].tensors["features"] * np.float16(4)})
    result = session.answer(0, ego, {**others, "a": loud})
    assert (result.accepted, result.rejected["a"].reason) == (("b", "c"), Reason.IMPLAUSIBLE)
