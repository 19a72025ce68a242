import pytest
import torch
from typer.testing import CliRunner

from robosac.cli import app
from robosac.detectors import load
from robosac.detectors.v2xsim.network import published_shapes
from robosac.detectors.weights_file import read_weights

runner = CliRunner()


def checkpoint(tmp_path, **changes):
    """A checkpoint as published: training state beside the model, and tensors that detection does not use."""
    generator = torch.Generator().manual_seed(1)
    state = {f"module.{k}": torch.rand(shape, generator=generator) * 0.1 for k, shape in published_shapes().items()}
    state["module.decoder.conv_pre_1.weight"] = torch.zeros(32, 13, 3, 3)
    state["module.u_encoder.bn1_1.num_batches_tracked"] = torch.tensor(7)
    for name, tensor in changes.items():
        key = f"module.{name.replace('__', '.')}"
        if tensor is None:
            del state[key]
        else:
            state[key] = tensor
    path = tmp_path / "epoch_100.pth"
    torch.save({"epoch": 100, "model_state_dict": state, "optimizer_state_dict": {"state": {}}, "loss": 0.5}, path)
    return path, state


def said(result):
    return " ".join(result.output.replace("│", "").split())


@pytest.mark.parametrize("fusion", ["mean", "sum"])
def test_a_checkpoint_becomes_a_weights_file(fusion, tmp_path):
    path, state = checkpoint(tmp_path)
    out = tmp_path / "new" / "v2x.safetensors"
    result = runner.invoke(app, ["convert-checkpoint", str(path), str(out), "--fusion", fusion])
    assert result.exit_code == 0, result.output
    assert f"v2x-sim-{fusion}, 31" in result.output
    assert load(str(out)).info.name == f"v2x-sim-{fusion}"
    tensors, recipe = read_weights(out)
    assert recipe["detector"] == f"v2x-sim-{fusion}"
    assert tensors.keys() == published_shapes().keys()
    assert all(torch.equal(tensor, state[f"module.{name}"]) for name, tensor in tensors.items())


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"classification__bn1__running_var": None}, "classification.bn1.running_var missing"),
        (
            {"classification__conv2__weight": torch.zeros(6, 32, 1, 1)},
            "classification.conv2.weight must have the shape [12, 32, 1, 1], got [6, 32, 1, 1]",
        ),
    ],
)
def test_a_checkpoint_of_another_network_is_explained(changes, complaint, tmp_path):
    path, _ = checkpoint(tmp_path, **changes)
    out = tmp_path / "out.safetensors"
    result = runner.invoke(app, ["convert-checkpoint", str(path), str(out)])
    assert result.exit_code == 2
    assert complaint in said(result)
    assert not out.exists()


class Hostile:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return type(self.path).mkdir, (self.path,)


def test_a_checkpoint_runs_nothing(tmp_path):
    path = tmp_path / "hostile.pth"
    torch.save({"model_state_dict": Hostile(tmp_path / "made")}, path)
    result = runner.invoke(app, ["convert-checkpoint", str(path), str(tmp_path / "out.safetensors")])
    assert result.exit_code == 2
    assert "not a checkpoint of tensors and plain values" in said(result)
    assert "weights_only" not in said(result)  # nobody is told to let it run
    assert not (tmp_path / "made").exists()


@pytest.mark.parametrize(
    ("content", "complaint"),
    [([1, 2], "holds no model_state_dict"), ({"model_state_dict": 5}, "holds no model_state_dict"), ({}, "missing")],
)
def test_other_files_are_no_checkpoints(content, complaint, tmp_path):
    torch.save(content, tmp_path / "x.pth")
    result = runner.invoke(app, ["convert-checkpoint", str(tmp_path / "x.pth"), str(tmp_path / "x.safetensors")])
    assert result.exit_code == 2
    assert complaint in said(result)


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["/nowhere.pth", "x"], "that can be read: No such file"),
        (["x.pth", "x", "--fusion", "median"], "known: mean, max, sum"),
    ],
)
def test_bad_arguments_are_explained(arguments, complaint):
    result = runner.invoke(app, ["convert-checkpoint", *arguments])
    assert result.exit_code == 2
    assert complaint in said(result)
