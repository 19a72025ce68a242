import shutil
from dataclasses import replace

import numpy as np
import pytest

from robosac.boxes import pose_matrix
from robosac.defenses import A2CP, EGO, Halving, OneByOne, SampleConsensus, StaticTeam, Undefended
from robosac.detectors import Message
from robosac.evaluation import recordings
from robosac.evaluation.encounters import acts
from robosac.evaluation.frames import EvaluationFrame, misplaced
from robosac.evaluation.playing import FaultyDefense, play
from robosac.evaluation.recordings import Recordings, decoded, load, record, save
from robosac.scenes import IntersectionScene

SCENE = IntersectionScene(4)
TEAM = ("car-2", "car-3", "rsu")


@pytest.fixture(scope="module")
def recorded(detector, ego_message, benign, attacked, scene_frame):
    truth = scene_frame.truth("car-1")

    def met(messages, attackers):
        return EvaluationFrame(
            detector, ego_message, benign, {n: messages[n] for n in TEAM}, frozenset(attackers), truth
        )

    honest = record(met(benign, []))
    return honest, record(met(attacked, ["car-2"]), honest), met(attacked, ["car-2"])


def test_every_subset_is_as_it_is_decoded(detector, recorded):
    _, frame, met = recorded
    assert len(frame.boxes) == 8
    prepared = detector.prepare(met.ego, met.teammates)
    for subset in ((), ("rsu",), ("car-2", "rsu"), TEAM):
        np.testing.assert_array_equal(frame.detect(subset), prepared.detect(subset).astype(np.float32))


def test_what_no_attacker_touches_is_taken_from_the_honest_frame(recorded):
    honest, frame, _ = recorded
    assert frame.detect(("car-3", "rsu")) is honest.detect(("rsu", "car-3"))
    assert frame.detect(("car-2",)) is not honest.detect(("car-2",))
    assert frame.honest == ("car-3", "rsu")


@pytest.mark.parametrize("whole", [True, False])
def test_frames_survive_a_file(whole, recorded, tmp_path):
    """In a file that is not whole, honest messages are those of the same frames without an attack."""
    honest, frame, _ = recorded
    save(tmp_path / "x.npz", {7: frame, 3: honest}, whole=whole)
    asked = []
    again = load(tmp_path / "x.npz", frame.detector, lambda indices: asked.extend(indices) or [honest, honest])
    assert asked == ([] if whole else [3, 7])
    assert {index: f.attackers for index, f in again.items()} == {3: frozenset(), 7: {"car-2"}}
    for before, after in ((honest, again[3]), (frame, again[7])):
        assert after.team == TEAM
        np.testing.assert_array_equal(after.truth, before.truth)
        for subset, boxes in before.boxes.items():
            np.testing.assert_array_equal(after.detect(subset), boxes)
        for sent, kept in ((before.ego, after.ego), *((before.teammates[n], after.teammates[n]) for n in TEAM)):
            np.testing.assert_array_equal(kept.pose, sent.pose)
            np.testing.assert_array_equal(kept.tensors["features"], sent.tensors["features"])


def test_vehicles_may_have_any_names_in_a_file(recorded, tmp_path):
    honest, _, _ = recorded
    names = dict(zip(TEAM, ("site/1", "site", "50%2F é"), strict=True))
    boxes = {frozenset(names[n] for n in subset): each for subset, each in honest.boxes.items()}
    renamed = decoded(replace(honest, teammates={names[n]: m for n, m in honest.teammates.items()}), boxes)
    save(tmp_path / "x.npz", {0: renamed}, whole=True)
    again = load(tmp_path / "x.npz", honest.detector, lambda _: [])[0]
    assert set(again.team) == set(names.values())
    for name, sent in honest.teammates.items():
        np.testing.assert_array_equal(again.teammates[names[name]].tensors["features"], sent.tensors["features"])


def test_a_recording_gives_testimony_of_the_messages_it_keeps(recorded):
    honest, frame, _ = recorded
    said, before = (each.testify(each.ego, each.teammates) for each in (frame, honest))
    assert said.agents == (EGO, *TEAM)
    assert frame.testify(frame.ego, {}) is said  # read once
    np.testing.assert_array_equal(said.of(["rsu"]).maps, before.of(["rsu"]).maps)
    assert not np.array_equal(said.of(["car-2"]).maps, before.of(["car-2"]).maps)


def same(one, other):
    """Whether two recorded frames are equal to the last bit."""
    return (one.team, one.attackers) == (other.team, other.attackers) and all(
        np.array_equal(boxes, other.boxes[subset]) for subset, boxes in one.boxes.items()
    )


class Counting:
    """The detector, counting what it prepares."""

    def __init__(self, detector, **info):
        self.info = replace(detector.info, **info)
        self.prepared = 0
        self._detector = detector

    def prepare(self, ego, teammates):
        self.prepared += 1
        return self._detector.prepare(ego, teammates)

    def __getattr__(self, name):
        return getattr(self._detector, name)


class Undecodable(Counting):
    """The detector, with a decoder that fails."""

    def detect(self, teammates=()):
        raise ArithmeticError

    def prepare(self, ego, teammates):
        return self


@pytest.fixture
def counting(detector):
    return Counting(detector)


def test_a_sequence_is_as_the_ego_meets_it(detector):
    ticks = []
    (first, last) = Recordings(detector, SCENE).sequence(2, "noise", ["car-3"], lambda: ticks.append(1))
    assert (first.attackers, last.attackers) == ({"car-3"}, {"car-3"})
    assert first.team == ("car-2", "car-3", "car-4", "car-5", "rsu")
    assert len(first.boxes) == 32
    assert not np.array_equal(first.ego.pose, last.ego.pose)
    assert len(ticks) == 2


def test_a_kept_frame_is_not_recorded_again(counting, tmp_path):
    once = Recordings(counting, SCENE, folder=tmp_path).sequence(2, "noise", ["car-3"])
    assert counting.prepared == 4  # two honest ones and two under attack
    again = Recordings(counting, SCENE, folder=tmp_path).sequence(2, "noise", ["car-3"])
    assert counting.prepared == 4
    assert all(map(same, once, again))
    more = Recordings(counting, SCENE, folder=tmp_path).sequence(3, "noise", ["car-3"])
    assert counting.prepared == 6
    assert all(map(same, once, more))
    assert len(list(tmp_path.iterdir())) == 2


def test_a_frame_does_not_depend_on_what_else_is_recorded(detector, tmp_path):
    recordings = Recordings(detector, SCENE, folder=tmp_path)
    recordings.sequence(1)
    recordings.sequence(2, "noise", ["rsu"])
    later = recordings.sequence(2, "noise", ["car-3"])
    assert all(map(same, Recordings(detector, SCENE).sequence(2, "noise", ["car-3"]), later))


def test_campaigns_that_differ_in_their_schedule_share_frames(counting, tmp_path):
    recordings = Recordings(counting, SCENE, folder=tmp_path)
    always = recordings.sequence(12, "noise", ["car-3"])
    honest = recordings.sequence(12)
    before = counting.prepared
    asleep = recordings.sequence(12, "noise@asleep", ["car-3"])
    assert counting.prepared == before
    assert all(one is other for one, other in zip(asleep, [*honest[:10], *always[10:]], strict=True))
    flicker = recordings.sequence(12, "noise@flicker", ["car-3"])
    assert counting.prepared == before
    struck = [frame is at_all_times for frame, at_all_times in zip(flicker, always, strict=True)]
    assert 0 < sum(struck) < 12


def test_turns_are_taken_by_one_at_a_time(detector):
    frames = Recordings(detector, SCENE).sequence(6, "noise@turns", ["car-3", "car-2"])
    assert [sorted(frame.attackers) for frame in frames] == [["car-2"]] * 5 + [["car-3"]]


def test_a_pretence_is_no_schedule():
    assert acts("honest@false-pose", ["rsu"], 1) == [("honest@false-pose", ("rsu",))]
    assert acts("pgd@covering@asleep", ["b", "a"], 11)[9:] == [("honest", ()), ("pgd@covering", ("a", "b"))]
    assert acts("erase@flicker", ["a"], 3)[1] == ("erase", ("a",))
    assert acts("erase", [], 1) == [("honest", ())]


def test_other_weights_seeds_and_poses_are_not_mixed_up(detector, tmp_path):
    others = [
        Recordings(detector, SCENE, folder=tmp_path),
        Recordings(Counting(detector, weights_digest="1" * 64), SCENE, folder=tmp_path),
        Recordings(detector, SCENE, folder=tmp_path, seed=1),
        Recordings(detector, SCENE, folder=tmp_path, pose_error_m=0.2),
    ]
    plain, _, seeded, misled = (recordings.sequence(1, "noise", ["car-3"])[0] for recordings in others)
    assert len(list(tmp_path.iterdir())) == 8
    assert not same(plain, seeded)
    np.testing.assert_array_equal(plain.detect(("rsu",)), seeded.detect(("rsu",)))
    assert not np.array_equal(plain.detect(("rsu",)), misled.detect(("rsu",)))
    np.testing.assert_array_equal(plain.detect(), misled.detect())


@pytest.mark.parametrize("suffix", ["calibration.json", "witness.safetensors"])
def test_what_was_made_with_another_calibration_or_witness_is_not_used(detector, suffix, tmp_path):
    info = detector.info
    beside = {"calibration": info.calibration, "witness": info.witness}
    part = suffix.partition(".")[0]
    beside[part] = tmp_path / suffix
    shutil.copy(getattr(info, part), beside[part])
    counting = Counting(detector, **beside)
    folder = tmp_path / "recordings"

    def recorded_anew():
        before = counting.prepared
        Recordings(counting, SCENE, folder=folder).sequence(1, "noise", ["car-3"])
        return counting.prepared > before

    assert [recorded_anew(), recorded_anew()] == [True, False]
    beside[part].write_bytes(beside[part].read_bytes() + b" ")
    assert [recorded_anew(), recorded_anew()] == [True, False]
    beside[part].unlink()
    assert [recorded_anew(), recorded_anew()] == [True, False]


def test_what_other_code_of_this_package_recorded_is_not_used(counting, tmp_path, monkeypatch):
    Recordings(counting, SCENE, folder=tmp_path).sequence(1, "noise", ["car-3"])
    monkeypatch.setattr(recordings, "package_code", lambda: "another")
    before = counting.prepared
    Recordings(counting, SCENE, folder=tmp_path).sequence(1, "noise", ["car-3"])
    assert counting.prepared > before


def test_passes_are_fused_subsets_each_counted_once(recorded):
    _, frame, _ = recorded

    def passes(defense):
        return [answer.passes for answer in play(defense, [frame] * 3, np.random.default_rng(0))]

    assert passes(Undefended()) == [1, 1, 1]
    assert passes(StaticTeam(collaborators=2))[1:] == [1, 1]  # trusted, and not tested
    assert passes(OneByOne()) == [4, 4, 4]
    asked = []
    spied = replace(frame, boxes=_Spied(frame.boxes, asked))
    for defense in (A2CP(), Halving(), SampleConsensus.independent()):
        for seed in range(5):
            asked.clear()
            (answer,) = play(defense, [spied], np.random.default_rng(seed))
            assert answer.passes == sum(map(bool, asked))


class _Spied(dict):
    def __init__(self, boxes, asked):
        super().__init__(boxes)
        self._asked = asked

    def __getitem__(self, subset):
        self._asked.append(subset)
        return super().__getitem__(subset)


def test_state_goes_from_frame_to_frame(recorded):
    honest, _, _ = recorded
    answers = play(StaticTeam(collaborators=2), [honest] * 3, np.random.default_rng(0))
    assert [answer.result.source.value for answer in answers] == ["consensus", "trusted", "trusted"]
    assert all(answer.milliseconds > 0.0 for answer in answers)


def test_a_fault_is_no_answer(recorded):
    honest, _, _ = recorded
    broken = replace(honest, detector=Undecodable(honest.detector), boxes={frozenset(): honest.detect()})
    with pytest.raises(FaultyDefense, match="frame 0: ArithmeticError"):
        play(SampleConsensus(collaborators=1), [broken], np.random.default_rng(0))


def test_a_wrong_pose_moves_the_sender_by_as_much(rng):
    message = Message(pose_matrix(3, 4, 1.6, 0.5), {})
    assert misplaced(message, 0.0, rng) is message
    wrong = np.array([misplaced(message, 0.2, rng).pose for _ in range(400)])
    assert wrong[:, :2, 3].std(axis=0) == pytest.approx([0.2, 0.2], rel=0.15)
    np.testing.assert_array_equal(wrong[:, 2, 3], 1.6)
    np.testing.assert_allclose(np.linalg.det(wrong[:, :3, :3]), 1.0)
    yaw = np.rad2deg(np.arctan2(wrong[:, 1, 0], wrong[:, 0, 0]) - 0.5)
    assert yaw.std() == pytest.approx(0.4, rel=0.15)
