"""A hypothesis of the V2X-Sim layout: the plain decoder against the fast one in both precisions.

The weights are made up: time does not depend on them, but for how many anchors become boxes. Here hardly any do, as in
a real frame.
"""

import time
from collections.abc import Callable
from typing import Annotated

import numpy as np
import torch
import typer

from robosac.detectors.v2xsim.anchors import detections
from robosac.detectors.v2xsim.fast import FastDecoder
from robosac.detectors.v2xsim.network import GRID, LAYERS, V2XSimNetwork, published_shapes, select_published

OCCUPIED = 0.02
THRESHOLD = 0.7


def main(repeats: Annotated[int, typer.Option(min=3)] = 15) -> None:
    torch.set_num_threads(1)
    rng = np.random.default_rng(0)
    network = V2XSimNetwork(select_published(made_up(rng)))
    fast = {precision: FastDecoder(network, precision) for precision in ("float32", "bfloat16")}
    grid = torch.from_numpy((rng.random((1, LAYERS, GRID, GRID)) < OCCUPIED).astype(np.float32))
    with torch.inference_mode():
        maps = network.levels(grid)[-1]
        contexts = {name: decoder.context(grid, maps) for name, decoder in fast.items()}
        context = network.context(grid, maps)

        def plain() -> None:
            logits, codes = network.decode(maps, context)
            detections(logits[:, 1] - logits[:, 0], codes, THRESHOLD)

        def quick(name: str) -> Callable[[], object]:
            return lambda: detections(*fast[name].decode(maps, contexts[name]), THRESHOLD)

        work: dict[str, Callable[[], object]] = {
            "plain decoder": plain,
            "fast decoder, float32": quick("float32"),
            "fast decoder, bfloat16": quick("bfloat16"),
            "what is the ego's own, plain": lambda: network.context(grid, maps),
            "what is the ego's own, float32": lambda: fast["float32"].context(grid, maps),
            "what is the ego's own, bfloat16": lambda: fast["bfloat16"].context(grid, maps),
        }
        times: dict[str, list[float]] = {name: [] for name in work}
        for function in work.values():
            function()
        for _ in range(repeats):
            for name, function in work.items():
                began = time.process_time()
                function()
                times[name].append(time.process_time() - began)
    base = float(np.median(times["plain decoder"]))
    print(f"one hypothesis of the V2X-Sim layout, one thread; CPU time, medians of {repeats} turns (quartiles)")
    for name, measured in times.items():
        low, middle, high = np.quantile(measured, (0.25, 0.5, 0.75))
        print(f"  {name:34} {middle / base:.2f} of the plain decoder ({low / base:.2f} to {high / base:.2f})")


def made_up(rng: np.random.Generator) -> dict[str, torch.Tensor]:
    """Random weights with activations of a usual size; anchors score low."""
    state = {}
    for name, shape in published_shapes().items():
        if name.endswith("running_var") or (name.endswith("weight") and len(shape) == 1):
            values = np.ones(shape)
        elif len(shape) == 1:
            values = np.zeros(shape)
        else:
            values = rng.normal(0.0, np.sqrt(2.0 / np.prod(shape[1:])), shape)
        state[name] = torch.from_numpy(values).float()
    bias = state["classification.conv2.bias"]
    bias[::2] = 20.0
    return state


if __name__ == "__main__":
    typer.run(main)
