from dataclasses import replace

import numpy as np
import pytest

from robosac.attacks import PGD
from robosac.boxes import pose_matrix
from robosac.defenses import SampleConsensus, StaticTeam, Undefended
from robosac.detectors import Message
from robosac.evaluation.frames import EvaluationFrame, misplaced
from robosac.evaluation.playing import Tally, play
from robosac.evaluation.recordings import load, record, record_sequence, save

TEAM = ("car-2", "car-3", "rsu")


@pytest.fixture(scope="module")
def recorded(detector, ego_message, benign, attacked, scene_frame):
    truth = scene_frame.truth("car-1")

    def met(messages, attackers):
        return EvaluationFrame(ego_message, benign, {n: messages[n] for n in TEAM}, frozenset(attackers), truth)

    honest = record(detector, met(benign, []))
    return honest, record(detector, met(attacked, ["car-2"]), honest), met(attacked, ["car-2"])


def test_every_subset_is_as_it_is_decoded(detector, recorded):
    _, frame, met = recorded
    assert len(frame.boxes) == 8
    prepared = detector.prepare(met.ego, met.received)
    for subset in ((), ("rsu",), ("car-2", "rsu"), TEAM):
        np.testing.assert_array_equal(frame.detect(subset), prepared.detect(subset))


def test_what_no_attacker_touches_is_taken_from_the_honest_frame(recorded):
    honest, frame, _ = recorded
    assert frame.detect(("car-3", "rsu")) is honest.detect(("rsu", "car-3"))
    assert frame.detect(("car-2",)) is not honest.detect(("car-2",))
    assert frame.benign == {"car-3", "rsu"}


def test_frames_survive_a_file(recorded, tmp_path):
    honest, frame, _ = recorded
    save(tmp_path / "x.npz", [honest, frame])
    again = load(tmp_path / "x.npz", frame.info)
    assert [f.attackers for f in again] == [frozenset(), {"car-2"}]
    for before, after in zip((honest, frame), again, strict=True):
        assert after.team == TEAM
        np.testing.assert_array_equal(after.pose, before.pose)
        np.testing.assert_array_equal(after.truth, before.truth)
        for subset, boxes in before.boxes.items():
            np.testing.assert_allclose(after.detect(subset), boxes, rtol=1e-6, atol=1e-5)


def test_a_sequence_keeps_its_attackers(detector):
    frames = list(record_sequence(detector, 4, 1, PGD(steps=1), ["car-3"], np.random.default_rng(0)))
    assert [f.attackers for f in frames] == [{"car-3"}]
    assert len(frames[0].boxes) == 32


def test_playing_counts_passes_infiltration_and_precision(recorded):
    honest, frame, _ = recorded
    sequence = [honest, frame, frame]
    tally = Tally(steady_from=1)
    tally.add(sequence, play(Undefended(), sequence, np.random.default_rng(0)))
    assert tally.infiltrated == [True, True]
    assert tally.ap.at(0.5) == tally.undefended.at(0.5) < tally.oracle.at(0.5)
    assert (tally.first, tally.early, tally.steady) == ([0], [], [0, 0])
    assert (tally.honest, tally.honest_named, tally.attackers, tally.unnamed) == (2, 0, 1, 1)
    tally.add(sequence, play(SampleConsensus(), sequence, np.random.default_rng(0)))
    assert tally.first[1] >= 1


def test_state_goes_from_frame_to_frame(recorded):
    honest, _, _ = recorded
    results = play(StaticTeam(collaborators=2), [honest] * 3, np.random.default_rng(0))
    assert [r.source.value for r in results] == ["consensus", "trusted", "trusted"]


def test_a_fault_is_no_answer(recorded):
    honest, _, _ = recorded
    broken = replace(honest, boxes={frozenset(): honest.detect()})
    with pytest.raises(RuntimeError, match="frame 0: KeyError"):
        play(SampleConsensus(collaborators=1), [broken], np.random.default_rng(0))


def test_a_wrong_pose_moves_the_sender_by_as_much(rng):
    message = Message(pose_matrix(3, 4, 1.6, 0.5), {})
    assert misplaced(message, 0.0, rng) is message
    wrong = np.array([misplaced(message, 0.2, rng).pose for _ in range(400)])
    assert wrong[:, :2, 3].std(axis=0) == pytest.approx([0.2, 0.2], rel=0.15)
    np.testing.assert_array_equal(wrong[:, 2, 3], 1.6)
    np.testing.assert_allclose(np.linalg.det(wrong[:, :3, :3]), 1.0)
