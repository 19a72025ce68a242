import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from robosac.attacks import GaussianNoise
from robosac.boxes import pose_matrix
from robosac.calibrated import calibration_of
from robosac.calibration import Recipe, TooFewVerdicts, calibrate
from robosac.calibration.verdicts import Trial, Verdicts, complementary, validation_stretches
from robosac.cli import app
from robosac.defenses.group_testing import Calibration, CalibrationError, GroupTestingSettings
from robosac.detectors import DetectorInfo, Message
from robosac.detectors.embedded import SHIPPED_WEIGHTS, EmbeddedDetector
from robosac.evaluation import recordings
from robosac.evaluation.frames import EvaluationFrame
from robosac.evaluation.playing import play
from robosac.scenes import IntersectionScene
from tests.robosac.defenses.group_testing.conversing import SEEN, make_model, shifted

INFO = DetectorInfo("fake", {"ego": {}, "teammate": {}}, (-32, -32, 32, 32), 2.0, "0", 0.5)


def recorded(attackers=()):
    team = ("a", "b", "c")
    subsets = [(), ("a",), ("b",), ("c",), ("a", "b"), ("a", "c"), ("b", "c"), team]
    boxes = {frozenset(s): shifted(s) if set(attackers) & set(s) else SEEN for s in subsets}
    message = Message(pose_matrix(0, 0, 0, 0), {})
    return recordings.decoded(
        EvaluationFrame(
            SimpleNamespace(info=INFO), message, {}, dict.fromkeys(team, message), frozenset(attackers), SEEN[:, :5]
        ),
        boxes,
    )


def test_verdicts_of_an_honest_frame_are_all_counted():
    verdicts = Verdicts()
    verdicts.add(recorded(), None)
    assert sum(verdicts.pairs.values()) == 7 + 12
    assert {cell for _, cell, *_ in verdicts.pairs} == {0}


def test_of_an_attacked_frame_what_the_attacker_is_part_of():
    verdicts = Verdicts()
    verdicts.add(recorded(["a"]), "pgd")
    cells = {cell: sum(n for (_, c, *_), n in verdicts.pairs.items() if c == cell) for cell in (0, 1, 2, 3)}
    assert cells == {0: 0, 1: 5 + 4, 2: 5, 3: 0}
    assert {kind for kind, *_ in verdicts.pairs} == {"pgd"}


def test_successive_frames_show_what_comes_and_goes():
    honest, attacked = Verdicts(), Verdicts()
    honest.add_stretch([recorded(), recorded()], None)
    assert sum(honest.pairs.values()) == 2 * (7 + 12)
    assert honest.changes == {(None, 0, 0, 0): 3, (None, 1, 0, 0): 3, (None, 2, 0, 0): 1}
    moved = recorded(["a"])
    boxes = {s: b + [0, 9.0, 0, 0, 0, 0] if "a" in s else b for s, b in moved.boxes.items()}
    attacked.add_stretch([moved, replace(moved, boxes=boxes)], "pgd")
    assert attacked.changes == {("pgd", 0, 0, 6): 1, ("pgd", 1, 0, 6): 2, ("pgd", 2, 0, 6): 1}


def test_a_stretch_is_the_same_ego_and_attackers_in_successive_frames(detector):
    scene, rng = IntersectionScene(1000), np.random.default_rng(0)
    stretches = list(validation_stretches(detector, [scene], Trial({"noise": GaussianNoise()}, [2], 0.0, 2), rng))
    assert [kind for kind, _ in stretches] == [None, "noise"] * 2
    for number, (_, stretch) in enumerate(stretches):
        start, ego = number // 2 * 10, f"car-{number // 2 + 1}"
        for offset, frame in enumerate(stretch):
            np.testing.assert_array_equal(frame.ego.pose, scene.frame(start + offset).views[ego].pose)
            assert frame.attackers == stretch[0].attackers
            assert len(frame.attackers) == (2 if number % 2 else 0)


def test_a_calibration_survives_a_file(tmp_path):
    model = make_model()
    calibration = Calibration("x", "0" * 64, {"command": "none"}, (model, replace(model, pose_error_m=0.2)))
    calibration.write(tmp_path / "x.json")
    again = Calibration.read(tmp_path / "x.json")
    assert (again.detector, again.weights_digest, again.recipe) == ("x", "0" * 64, {"command": "none"})
    for before, after in zip(calibration.levels, again.levels, strict=True):
        assert after.kinds == before.kinds
        np.testing.assert_allclose(after.pairs, before.pairs, atol=1e-5)
        np.testing.assert_allclose(after.changes, before.changes, atol=1e-5)
    assert again.at(0.0).pose_error_m == 0.0
    assert again.at(0.1).pose_error_m == 0.2
    with pytest.raises(CalibrationError, match=r"up to a pose error of 0\.2 m, 0\.3 m is asked for"):
        again.at(0.3)


@pytest.mark.parametrize("damage", ["not json", "{}", '{"format": 1}', "[1]", "wrong shape", "negative"])
def test_a_damaged_calibration_is_refused(tmp_path, damage):
    path = tmp_path / "x.json"
    Calibration("x", "0", {}, (make_model(),)).write(path)
    content = json.loads(path.read_text())
    if damage == "wrong shape":
        content["levels"][0]["kinds"].append("more")
        damage = json.dumps(content)
    elif damage == "negative":
        content["levels"][0]["pairs"][0][0][0] = -1.0
        damage = json.dumps(content)
    path.write_text(damage)
    with pytest.raises(CalibrationError, match="is no calibration"):
        Calibration.read(path)


def test_a_detector_without_calibration_says_so(tmp_path):
    with pytest.raises(CalibrationError, match="fake is not calibrated"):
        calibration_of(INFO)
    weights = tmp_path / "copy.safetensors"
    weights.write_bytes(SHIPPED_WEIGHTS.read_bytes())
    assert EmbeddedDetector(weights).info.calibration is None
    beside = tmp_path / "copy.calibration.json"
    Calibration("intersection-mean", "f" * 64, {}, (make_model(),)).write(beside)
    info = EmbeddedDetector(weights).info
    assert info.calibration == beside
    with pytest.raises(CalibrationError, match="belongs to weights with the digest ffffffffffff"):
        calibration_of(info)


def test_the_shipped_detector_is_calibrated(detector):
    calibration = calibration_of(detector.info)
    assert calibration.weights_digest == detector.info.weights_digest
    assert calibration.recipe["scenes"] >= 40
    assert [level.pose_error_m for level in calibration.levels] == sorted(calibration.recipe["pose_errors_m"])
    sure = [b for b in calibration.recipe["reliability"]["0"] if b["low"] >= 0.99 or b["high"] <= 0.01]
    assert all(abs(b["predicted"] - b["observed"]) < 0.05 for b in sure)


def test_the_shipped_detector_finds_an_attacker(detector, ego_message, attacked):
    defense = GroupTestingSettings().build(calibration_of(detector.info))
    frame = EvaluationFrame(detector, ego_message, {}, attacked, frozenset({"car-2"}), np.empty((0, 5)))
    results = [answer.result for answer in play(defense, [frame] * 3, np.random.default_rng(0))]
    assert all("car-2" not in r.accepted for r in results)
    assert results[-1].suspicion["car-2"] > 0.95
    assert max(p for name, p in results[-1].suspicion.items() if name != "car-2") < 0.5
    assert set(results[-1].accepted) == set(attacked) - {"car-2"}
    assert results[-1].named == ("car-2",)
    assert {name for r in results for name in r.state["memory"]["lies"]["levels"]} == {"car-2"}


@pytest.mark.parametrize(
    "settings",
    [
        {"attacks": ()},
        {"attackers": (0,)},
        {"pose_errors_m": (-0.1,)},
        {"scenes": 0},
        {"check_scenes": -1},
        {"attackers": (1,)},
    ],
)
def test_recipes_that_cannot_be(settings):
    with pytest.raises(ValueError, match="must"):
        Recipe(**settings)


def test_the_command_writes_a_calibration(tmp_path):
    out = tmp_path / "x.json"
    arguments = ["--scenes", "1", "--check-scenes", "1", "--stretches", "1", "--pose-error", "0", "--attack", "noise"]
    result = CliRunner().invoke(app, ["calibrate", "--out", str(out), *arguments])
    assert result.exit_code == 0, result.output
    assert "scenes held out" in " ".join(result.output.split())
    calibration = Calibration.read(out)
    assert calibration.levels[0].kinds == ("noise", "open")
    assert "--attack noise" in calibration.recipe["command"]
    assert calibration.recipe["reliability"]["0"]
    assert set(json.loads(out.read_text())["messages"]) == {"features"}


@pytest.mark.parametrize(
    ("missing", "in_vain"), [("attackers among the joined", True), ("attackers among the joining", False)]
)
def test_where_more_scenes_may_not_help_it_is_said(missing, in_vain, detector, monkeypatch):
    def fit(*_):
        raise TooFewVerdicts(f"never observed: noise: 1 joining 1, {missing}")

    monkeypatch.setattr("robosac.calibration.making.fit", fit)
    monkeypatch.setattr("robosac.calibration.making.collect", list)
    with pytest.raises(TooFewVerdicts) as refused:
        calibrate(detector, Recipe(attacks=("noise",), scenes=2, check_scenes=0), "the command")
    told = f"2 are too few (never observed: noise: 1 joining 1, {missing}): try 6"
    more = ". A fusion is judged by its boxes of score 0.5: where an attack leaves fewer than 2 of them, no number of"
    assert str(refused.value) == told + f"{more} scenes will do" * in_vain


def test_the_command_names_an_unknown_attack(tmp_path):
    result = CliRunner().invoke(app, ["calibrate", "--out", str(tmp_path / "x.json"), "--attack", "nonesuch"])
    assert result.exit_code == 2
    assert "no attack 'nonesuch'" in " ".join(result.output.split())


def test_a_teammate_that_adds_a_box_to_every_fusion_is_complementary():
    frame = recorded()
    boxes = {s: np.vstack([b, b[:1] + [0, 40, 0, 0, 0, 0]]) if "c" in s else b for s, b in frame.boxes.items()}
    seen = replace(frame, boxes=boxes)
    assert complementary(frame) == frozenset()
    assert complementary(seen) == {"c"}
    verdicts = Verdicts()
    verdicts.add(seen, None)
    cells = {cell: sum(n for (_, c, *_), n in verdicts.pairs.items() if c == cell) for cell in (0, 1, 2, 3)}
    assert cells == {0: 19, 1: 5 + 4, 2: 5, 3: 0}
    assert complementary(replace(seen, boxes={s: b if s else b[:0] for s, b in boxes.items()})) == {"c"}
    sometimes = {s: b if len(s) < 3 else frame.boxes[s] for s, b in boxes.items()}
    assert complementary(replace(seen, boxes=sometimes)) == frozenset()
