import pickle

import numpy as np
import pytest
from typer.testing import CliRunner

from robosac.cli import app
from robosac.detectors import Message
from robosac.evaluation.frames import evaluation_frames
from robosac.scenes import SOURCES, SceneError, View, encoded
from tests.recorded import EGO, moments, write

FRAMES = 6


@pytest.fixture(scope="module")
def path(detector, recorded_moments, tmp_path_factory):
    return write(tmp_path_factory.mktemp("recording") / "one.mcap", detector, recorded_moments)


def test_a_recording_is_a_scene_source(path, recorded_moments, detector):
    source = SOURCES.make(f"recording:{path}")
    (scene,) = pickle.loads(pickle.dumps(source)).scenes("test")  # as where several processes share the work
    assert (list(scene.egos), len(scene.agents), scene.length, scene.frame_period_s) == ([EGO], 6, FRAMES, 0.2)
    frame = scene.frame(1)
    np.testing.assert_array_equal(frame.truth(EGO), recorded_moments[1].truth.boxes)
    assert frame.attackers == ("car-2",)
    for name, view in frame.views.items():
        sent = encoded(view, detector)
        np.testing.assert_array_equal(
            sent.tensors["features"], recorded_moments[1].messages[name].message.tensors["features"]
        )


def test_recorded_attackers_are_attackers_whoever_attacks_besides(path, detector):
    from robosac.attacks import PGD

    source = SOURCES.make(f"recording:{path}")
    rng = np.random.default_rng(0)
    (frame,) = evaluation_frames(detector, source.scenes("test"), 1, PGD(steps=1), 0, rng)
    assert frame.attackers == {"car-2"}
    assert "car-2" in frame.teammates
    assert "car-2" not in frame.benign


def test_a_comparison_runs_on_it(path, tmp_path):
    result = CliRunner().invoke(app, [
        "compare", "--data", f"recording:{path}", "--setting", "honest:0", "--only", "no defence",
        "--only", "group_testing", "--scenes", "1", "--frames", str(FRAMES), "--live", "--out", str(tmp_path),
    ])  # fmt: skip
    assert result.exit_code == 0, result.output
    rows = (tmp_path / "comparison.csv").read_text().splitlines()
    head = rows[0].split(",")
    got = {row["defense"]: row for row in (dict(zip(head, line.split(","), strict=False)) for line in rows[1:])}
    assert {"oracle", "no defence", "group_testing", "ego only"} == got.keys()
    assert float(got["no defence"]["infiltrated"]) == 1.0
    assert float(got["oracle"]["ap50"]) > float(got["no defence"]["ap50"])


def test_a_recording_that_is_not_there_is_told_as_other_files_are():
    with pytest.raises(SceneError, match=r"^nope: No such file or directory$"):
        SOURCES.make("recording:nope")


def test_without_truth_it_is_said_what_is_missing(detector, tmp_path):
    path = write(tmp_path / "blind.mcap", detector, moments(detector, range(1), truth=False))
    (scene,) = SOURCES.make(f"recording:{path}").scenes("test")
    with pytest.raises(SceneError, match=r"blind.mcap, frame 0: no truth was recorded"):
        scene.frame(0).truth(EGO)
    with pytest.raises(SceneError, match="known for car-1 only"):
        scene.frame(0).truth("car-2")
    result = CliRunner().invoke(app, ["evaluate", "--data", f"recording:{path}", "--scenes", "1", "--frames", "1"])
    assert result.exit_code == 2
    assert "no truth was recorded" in " ".join(result.output.replace("│", " ").split())


def test_messages_of_another_layout_are_refused(detector):
    view = View(np.eye(4), np.zeros((0, 3)), message=Message(np.eye(4), {"features": np.zeros((8, 4, 4), np.float16)}))
    with pytest.raises(SceneError, match=r"takes a message with features .*, got features of float16 \[8, 4, 4\]"):
        encoded(view, detector)


def test_what_is_no_recording_is_refused(tmp_path):
    for path, match in (
        ("", "recording:FILE"),
        (tmp_path / "none.mcap", "No such file"),
        (tmp_path, "holds no recording"),
    ):
        with pytest.raises(SceneError, match=match):
            SOURCES.make(f"recording:{path}")
