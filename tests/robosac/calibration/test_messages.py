"""What honest messages hold, measured, kept beside the weights, and used by sessions."""

import json
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from robosac.boxes import pose_matrix
from robosac.calibrated import calibration_of, screening_for
from robosac.calibration.messages import add, measure
from robosac.cli import app
from robosac.defenses.group_testing import CalibrationError
from robosac.detectors import DetectorInfo, Message, TensorSpec
from robosac.scenes import View
from robosac.screening import Bounds, Screening
from robosac.session import Session

SHAPE = (4, 16, 16)
INFO = DetectorInfo("fake", {"teammate": {"x": TensorSpec("float32", SHAPE)}}, (0, 0, 1, 1), 1.0, "0", 0.5)


class Fake:
    """Its message is a map of the world from the first point, with noise from the second, and a spare tensor."""

    info = INFO

    def encode(self, points, pose):
        world, noise = (np.random.default_rng(int(seed)).normal(size=SHAPE) for seed in points[:, 0])
        return Message(pose, {"x": (world + points[1, 1] * noise).astype(np.float32), "spare": np.ones(3)})


class Scene:
    """Car a stands still, car b drives; there is so much noise in their maps."""

    def __init__(self, noise=0.1, length=None):
        self.noise, self.length, self.asked = noise, length, []

    def frame(self, index):
        self.asked.append(index)

        def view(x, world):
            return View(pose_matrix(x, 0, 0, 0), np.array([[world, 0, 0], [90 + index, self.noise, 0]]))

        return SimpleNamespace(views={"a": view(0.0, 1), "b": view(5.0 * index, 2 + index)})


def test_honest_messages_are_measured():
    measured = measure(Fake(), [Scene()])
    assert set(measured) == {"x"}
    assert 3.0 < measured["x"].largest < 6.0
    assert measured["x"].rms == pytest.approx(1.0, abs=0.1)
    assert measured["x"].still == pytest.approx(0.99, abs=0.005)
    assert measure(Fake(), [Scene(0.3)])["x"].still == pytest.approx(0.917, abs=0.03)
    louder = measure(Fake(), [Scene(), Scene(2.0), Scene()])["x"]
    assert louder.rms == pytest.approx(np.sqrt(5), abs=0.2)
    assert louder.still == measured["x"].still


def test_where_nobody_stands_still_only_the_same_bytes_are_a_repetition():
    scene = Scene()
    assert measure(Fake(), [scene], frames=1)["x"].still == 1.0
    short = Scene(length=2)
    measure(Fake(), [short], frames=4)
    assert short.asked == [0, 1]


def test_what_was_measured_is_added_and_all_else_stays(tmp_path, detector):
    path = tmp_path / "x.calibration.json"
    shutil.copy(detector.info.calibration, path)
    before = json.loads(path.read_text())
    add(path, detector.info.weights_digest, {"features": Bounds(7.0, 0.5, 0.98)}, "a command")
    after = json.loads(path.read_text())
    assert after == {
        **before,
        "messages": {"features": {"largest": 7.0, "rms": 0.5, "still": 0.98}},
        "messages_command": "a command",
    }
    info = replace(detector.info, calibration=path)
    assert screening_for(info) == Screening({"features": Bounds(7.0, 0.5, 0.98)})
    assert len(calibration_of(info).levels) == len(before["levels"])


def test_bounds_of_other_weights_are_neither_added_nor_used(tmp_path, detector):
    path = tmp_path / "x.calibration.json"
    shutil.copy(detector.info.calibration, path)
    with pytest.raises(CalibrationError, match="belongs to weights"):
        add(path, "0" * 64, {}, "")
    assert screening_for(replace(detector.info, calibration=path, weights_digest="0" * 64)) == Screening()


@pytest.mark.parametrize("content", [None, "?", "[]", '{"weights_digest": "0", "messages": {"x": {}}}'])
def test_without_a_file_that_says_it_nothing_is_known(content, tmp_path):
    path = tmp_path / "x.json"
    if content is not None:
        path.write_text(content)
    assert screening_for(replace(INFO, calibration=path)) == Screening()
    if content is None or not content.startswith("{"):
        with pytest.raises(CalibrationError, match="cannot be read" if content is None else "no calibration"):
            add(path, "0", {}, "")


def test_a_calibration_of_before_knows_no_bounds(tmp_path, detector):
    content = json.loads(detector.info.calibration.read_text())
    del content["messages"]
    path = tmp_path / "old.calibration.json"
    path.write_text(json.dumps(content))
    assert screening_for(replace(detector.info, calibration=path)) == Screening()


def test_a_session_has_the_bounds_of_the_shipped_detector(detector):
    bounds = Session(detector, ["a"]).screening.bounds["features"]
    assert 3.0 < bounds.largest < 6.0
    assert 0.2 < bounds.rms < 0.3
    assert 0.99 < bounds.still < 0.998


def test_the_command_adds_them(tmp_path, detector):
    path = tmp_path / "x.calibration.json"
    shutil.copy(detector.info.calibration, path)
    result = CliRunner().invoke(app, ["calibrate", "--messages-only", "--scenes", "1", "--out", str(path)])
    assert result.exit_code == 0, result.output
    shipped, made = screening_for(detector.info).bounds, screening_for(replace(detector.info, calibration=path)).bounds
    assert 0.5 < made["features"].largest / shipped["features"].largest <= 1.0
    assert json.loads(path.read_text())["messages_command"].startswith("robosac calibrate")
    nowhere = CliRunner().invoke(app, ["calibrate", "--messages-only", "--scenes", "1", "--out", str(tmp_path / "no")])
    assert nowhere.exit_code == 2
    assert "no cannot be read: No such file" in " ".join(nowhere.output.replace("│", "").split())
