"""``robosac convert-checkpoint``: weights of the V2X-Sim detector from a published checkpoint."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from pickle import UnpicklingError
from typing import Annotated

import torch
import typer

from robosac.cli.blame import blaming, check_known
from robosac.cli.outputs import Force, check_file
from robosac.detectors.v2xsim.detector import FUSIONS, write_weights
from robosac.detectors.weights_file import WeightsError
from robosac.faults import unreadable


def run(
    checkpoint: Annotated[Path, typer.Argument(help="A published checkpoint (.pth).")],
    out: Annotated[Path, typer.Argument(help="The weights file to write (.safetensors).")],
    fusion: Annotated[str, typer.Option(help=f"One of {', '.join(FUSIONS)}.")] = "mean",
    force: Force = False,
) -> None:
    """Convert a published V2X-Sim checkpoint into a weights file. Nothing in the checkpoint is executed."""
    check_known([fusion], FUSIONS, "--fusion")
    check_file(out, "OUT", force, checkpoint)
    with blaming("CHECKPOINT", WeightsError), blaming("OUT", OSError):
        recipe = write_weights(read_state(checkpoint), fusion, out)
    typer.echo(f"{out}: {recipe['detector']}, {out.stat().st_size / 1e6:.1f} MB")


def read_state(path: Path) -> Mapping[str, object]:
    """The model's tensors in a checkpoint: its ``model_state_dict``, or the whole file where there is none.

    Raises
    ------
    WeightsError
        If the file is no checkpoint of tensors and plain values.
    """
    try:
        with warnings.catch_warnings():  # of pickled storages: true of every checkpoint that is old enough
            warnings.simplefilter("ignore")
            content = torch.load(path, map_location="cpu", weights_only=True)
    except OSError as error:
        raise WeightsError(f"{path} is not a checkpoint that can be read: {unreadable(error)}") from error
    except UnpicklingError as error:  # torch's words advise to let the file run code
        raise WeightsError(f"{path} is not a checkpoint of tensors and plain values") from error
    except Exception as error:  # torch raises many unrelated types
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise WeightsError(f"{path} is not a checkpoint of tensors and plain values: {reason}") from error
    state = content.get("model_state_dict", content) if isinstance(content, Mapping) else content
    if not isinstance(state, Mapping):
        raise WeightsError(f"{path} holds no model_state_dict")
    return state
