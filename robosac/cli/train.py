"""``robosac train``: make the embedded detector's weights."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import torch
import typer
from rich.console import Console
from rich.progress import TaskID, TextColumn

from robosac.cli.blame import check_known, failing
from robosac.cli.options import Seed, progress
from robosac.cli.outputs import Force, make_folder, tell
from robosac.detectors.embedded import ADVERSARIAL_WEIGHTS, SHIPPED_WEIGHTS
from robosac.detectors.weights_file import read_weights
from robosac.training.adversary import AdversaryConfig
from robosac.training.export import export_weights, shipped_tensors
from robosac.training.loop import TrainingConfig, train_network
from robosac.training.validation import GAINS, HARM, choose_operating_point, validation_frames

_DEFAULTS = TrainingConfig()
_ADVERSARIAL_STEPS = 900
_ADVERSARIAL_RATE = 1e-3


def run(
    out: Annotated[Path, typer.Option(help="Folder for the checkpoint and the weights.")],
    seed: Seed = _DEFAULTS.seed,
    steps: Annotated[int | None, typer.Option(min=100, help="Optimiser steps; 2600, or 900 if adversarial.")] = None,
    scenes: Annotated[int, typer.Option(min=1, help="Training scenes, five frames each.")] = _DEFAULTS.scenes,
    adversarial: Annotated[str | None, typer.Option(help="pgd: go on from the shipped weights, under attack.")] = None,
    threads: Annotated[int, typer.Option(min=1, help="CPU threads.")] = 1,
    force: Force = False,
) -> None:
    """Train the embedded detector on generated scenes. Checkpoints come every 50 steps; the same command goes on
    from there.
    """
    check_known([adversarial or "pgd"], ["pgd"], "--adversarial")
    torch.set_num_threads(threads)
    console = Console()
    plan = (_plain if adversarial is None else _hardened)(seed, steps, scenes)
    make_folder(out, "--out", force, plan.weights)
    try:
        with failing(OSError, ValueError):
            _train(console, out, plan)
    except KeyboardInterrupt:
        console.print("Stopped. The same command goes on from the latest checkpoint, if there is one yet.")
        raise typer.Exit(130) from None


@dataclass(frozen=True)
class _Plan:
    """What is trained from what, and where its operating point is looked for."""

    config: TrainingConfig
    weights: str
    command: str
    initial: dict[str, torch.Tensor] | None = None
    gains: tuple[float, ...] = GAINS
    harm: float = HARM


def _plain(seed: int, steps: int | None, scenes: int) -> _Plan:
    config = TrainingConfig(seed=seed, steps=steps or _DEFAULTS.steps, scenes=scenes)
    command = f"robosac train --out DIR --seed {seed} --steps {config.steps} --scenes {scenes}"
    return _Plan(config, SHIPPED_WEIGHTS.name, command)


def _hardened(seed: int, steps: int | None, scenes: int) -> _Plan:
    tensors, recipe = read_weights(SHIPPED_WEIGHTS)
    gain = float(recipe["feature_gain"])  # kept, so that an attack means the same to both detectors
    adversary = AdversaryConfig(epsilon=0.5 / gain, step_size=0.25 / gain)
    config = TrainingConfig(
        seed=seed,
        steps=steps or _ADVERSARIAL_STEPS,
        scenes=scenes,
        learning_rate=_ADVERSARIAL_RATE,
        adversary=adversary,
    )
    command = f"robosac train --adversarial pgd --out DIR --seed {seed} --steps {config.steps} --scenes {scenes}"
    return _Plan(config, ADVERSARIAL_WEIGHTS.name, command, tensors, (gain,), -1.0)


def _train(console: Console, out: Path, plan: _Plan) -> None:
    weights = out / plan.weights
    with progress(console, TextColumn("{task.fields[remark]}")) as bar:
        tasks: dict[str, TaskID] = {}

        def show(stage: str, done: int, total: int, remark: str) -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=total, remark="")
            bar.update(tasks[stage], completed=done, remark=remark)

        network = train_network(plan.config, weights.with_suffix(".checkpoint"), show, plan.initial)
        rounded = {name: tensor.float() for name, tensor in shipped_tensors(network).items()}
        network.load_state_dict(rounded)  # what is chosen is chosen for the weights that ship
        validating = bar.add_task("validate", total=len(plan.gains), remark="choosing the operating point")
        attacked = partial(validation_frames, network)
        point = choose_operating_point(attacked, lambda: bar.advance(validating), plan.gains, plan.harm)
        bar.update(validating, completed=len(plan.gains), remark="")
    recipe = export_weights(network, plan.config, point, plan.command, weights)
    tell(console, f"{weights}: {weights.stat().st_size / 1e6:.2f} MB")
    shown = ("feature_gain", "consensus_score", "validation", "tensors_sha256")
    console.print_json(data={key: recipe[key] for key in shown})
