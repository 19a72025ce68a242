"""``robosac witness``: train what judges single objects for a detector."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import torch
import typer
from rich.console import Console
from rich.table import Table

from robosac.calibration.witness import WitnessRecipe, lessons, train, training_scenes, usual_size
from robosac.calibration.witness_check import check
from robosac.cli.blame import blaming, failing
from robosac.cli.options import DetectorName, Seed, command, load_data, load_detector, progress
from robosac.cli.outputs import Force, check_file, tell
from robosac.detectors import DEFAULT_DETECTOR, Encoder
from robosac.detectors.witness_network import Layout
from robosac.plugins import lacks
from robosac.scenes import DATA_HELP, SceneError

_DEFAULTS = WitnessRecipe()


def run(  # the options of a command line
    context: typer.Context,
    out: Annotated[
        Path,
        typer.Option(
            metavar="FILE", help="The file to write; NAME.witness.safetensors beside NAME.safetensors is found."
        ),
    ],
    detector: DetectorName = DEFAULT_DETECTOR,
    data: Annotated[
        list[str] | None, typer.Option(help=f"{DATA_HELP} May be repeated; by default {_DEFAULTS.data[0]}.")
    ] = None,
    scenes: Annotated[int, typer.Option(min=1, help="Scenes of each source to train on.")] = _DEFAULTS.scenes,
    check_scenes: Annotated[int, typer.Option(min=1, help="Further ones to check on.")] = _DEFAULTS.check_scenes,
    frames: Annotated[int, typer.Option(min=1, help="Frames of each, 1 s apart.")] = _DEFAULTS.frames_per_scene,
    epochs: Annotated[int, typer.Option(min=1, help="Times that each message is read.")] = _DEFAULTS.epochs,
    seed: Seed = _DEFAULTS.seed,
    force: Force = False,
) -> None:
    """Train a small network that reads one message alone and says for every place what is there.

    With it, group testing judges single objects. Scenes are those that a source keeps for training, else its last
    validation scenes.
    """
    torch.set_num_threads(1)
    console = Console()
    check_file(out, "--out", force)
    chosen = load_detector(detector)
    recipe = WitnessRecipe(tuple(data or _DEFAULTS.data), scenes, frames, check_scenes, epochs, seed=seed)
    sources = [load_data(name) for name in recipe.data]
    if missing := lacks(chosen, Encoder):
        why = f"a witness needs a detector that encodes scans: {chosen.info.name} {missing}"
        raise typer.BadParameter(why, param_hint="--detector")
    with blaming("--data", SceneError):
        found = [training_scenes(source, scenes + check_scenes) for source in sources]
    with failing(OSError, ValueError), blaming("--data", SceneError):
        layout = Layout.of(chosen.info, usual_size(chosen, found[0][0]))
        with progress(console) as bar:
            task = bar.add_task("frames", total=recipe.frames)
            parts = (
                [scene for each in found for scene in each[:scenes]],
                [scene for each in found for scene in each[scenes:]],
            )
            learned, held_out = (lessons(chosen, layout, part, recipe, lambda: bar.advance(task)) for part in parts)
            steps = bar.add_task("training", total=None)
            witness = train(
                layout, learned, recipe, lambda step, total, _: bar.update(steps, completed=step, total=total)
            )
        figures = check(witness, held_out)
        witness.write(out, chosen.info, {"command": command(context), **asdict(recipe), "check": asdict(figures)})
    table = Table(title=f"{figures.places} places of scenes held out", title_justify="left", show_header=False)
    for name, value in list(asdict(figures).items())[1:]:
        table.add_row(name.replace("_m", ", metres").replace("_", " "), f"{value:.4f}")
    console.print(table)
    tell(console, f"{out}: {chosen.info.name}, weights {chosen.info.weights_digest:.12}...")
