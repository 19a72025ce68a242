import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from robosac.cli import app
from robosac.scenes.v2xsim import V2XSim

GUIDE = Path(__file__).parents[4] / "docs" / "v2x-sim.md"


@pytest.fixture
def root(tmp_path, parity):
    """The golden data's agents as samples of one frame."""
    root = tmp_path / "V2X-Sim-det" / "test"
    for agent in range(6):
        folder = root / f"agent{agent}" / "8_0"
        folder.mkdir(parents=True)
        sample = {
            "voxel_indices_0": parity[f"voxel_indices_{agent}"].astype(np.int32),
            "trans_matrices": parity["trans_matrices"][agent],
            "allocation_mask": np.zeros((256, 256, 6), dtype=bool),
            "reg_loss_mask": np.zeros((256, 256, 6, 1), dtype=bool),
            "reg_target_sparse": np.zeros((0, 1, 6), dtype=np.float32),
            "gt_max_iou": np.array([[100, 90, 0, 1]]),
        }
        np.save(folder / "0.npy", sample)
    return root


def test_samples_make_the_messages_of_the_golden_data(root, v2xsim, team):
    (scene,) = V2XSim(root).scenes("test")
    frame = scene.frame(0)
    for agent, expected in enumerate(team):
        view = frame.views[f"agent{agent}"]
        message = v2xsim.encode(view.points, view.pose)
        np.testing.assert_allclose(message.pose[:, :2], expected.pose[:, :2], atol=1e-9)
        np.testing.assert_allclose(message.pose[:2, 3], expected.pose[:2, 3], atol=1e-9)
        np.testing.assert_array_equal(message.tensors["features"], expected.tensors["features"])


def test_the_guides_example_runs(root, weights, tmp_path, monkeypatch, capsys):
    shutil.copy(weights, tmp_path / "v2x-sim-mean.safetensors")
    monkeypatch.chdir(tmp_path)
    (example,) = re.findall(r"```python\n(.*?)```", GUIDE.read_text(), re.DOTALL)
    exec(compile(example, str(GUIDE), "exec"), {})
    assert re.fullmatch(r"0 (ego_only|consensus) \(.*\) \d+ boxes of 1\n", capsys.readouterr().out)


def evaluate(root, weights, *options):
    arguments = ["evaluate", "--data", f"v2x-sim:{root}", "--weights", weights, "--attack", "noise", *options]
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_evaluate_runs_on_samples(root, weights, tmp_path):
    lonely = root / "agent1" / "9_5"
    shutil.copytree(root / "agent1" / "8_0", lonely)
    assert [(scene.number, scene.length) for scene in V2XSim(root).scenes("test")] == [(8, 1), (9, 1)]
    result = evaluate(root, weights, "--frames", 1, "--collaborators", 4, "--out", tmp_path)
    assert result.exit_code == 0, result.output
    assert "Skipped 1" in result.output
    report = json.loads((tmp_path / "bounds.json").read_text())
    assert (report["frames"], report["skipped"]) == (1, 1)
    assert (report["benign_hypotheses"], report["attacked_hypotheses"]) == (1, 4)
    assert report["settings"]["detector"] == "v2x-sim-mean"


@pytest.mark.parametrize(
    ("break_it", "complaint"),
    [
        (shutil.rmtree, "is no folder"),
        (lambda root: [shutil.rmtree(root / f"agent{k}") for k in range(1, 6)], "at most 0 teammates, not 1"),
        (lambda root: (root / "agent3" / "8_0" / "0.npy").write_bytes(b"cos\nsystem\n"), "agent3/8_0/0.npy"),
    ],
)
def test_evaluate_explains_bad_samples(break_it, complaint, root, weights):
    break_it(root)
    result = evaluate(root, weights)
    assert result.exit_code == 2
    shown = "".join(result.output.replace("│", "").split())
    assert complaint.replace(" ", "") in shown
