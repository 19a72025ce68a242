"""The V2X-Sim layout: the published amount of work, the plain decoder, and the fast one in both precisions.

The weights are made up: time does not depend on them, but for how many anchors become boxes. Here hardly any do, as in
a real frame.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import torch
from speed.turns import Part, in_turns, rows
from torch.nn import functional

from robosac.detectors import Message
from robosac.detectors.v2xsim.anchors import anchor_boxes, decode, detections, detections_of_each, to_lidar
from robosac.detectors.v2xsim.detector import V2XSimDetector, write_weights
from robosac.detectors.v2xsim.fast import FastDecoder
from robosac.detectors.v2xsim.network import GRID, LAYERS, V2XSimNetwork, published_shapes, select_published

OCCUPIED = 0.02
THRESHOLD = 0.7
AGENTS = 6
CROWDED = 0.7
"""The background's bias at which fusions of six messages of noise have 2 to 9 boxes, and the ego alone has 40."""
PLAIN, PUBLISHED = "a hypothesis by the plain decoder", "a step of the published procedure"
TEXT = f"""One hypothesis of the V2X-Sim layout: the decoder and the boxes it finds. *{PUBLISHED.capitalize()}* is the
work that the published code does for one: it encodes the scans of six agents, warps the maps of the five others for
each of them, decodes six fused maps, and makes boxes of all 393,216 anchors of each before it drops those with low
scores."""


def part(turns: int) -> Part:
    """Measure it."""
    rng = np.random.default_rng(0)
    network = V2XSimNetwork(select_published(made_up(rng)))
    fast = {precision: FastDecoder(network, precision) for precision in ("float32", "bfloat16")}
    grids = torch.from_numpy((rng.random((AGENTS, LAYERS, GRID, GRID)) < OCCUPIED).astype(np.float32))
    everywhere = np.arange(GRID * GRID * 6)
    anchors = anchor_boxes(everywhere)
    turn = functional.affine_grid(torch.tensor([[[0.9, -0.4, 0.1], [0.4, 0.9, 0.2]]]), [1, 256, 32, 32], False)
    with torch.inference_mode():
        maps = network.levels(grids[:1])[-1]
        context = network.context(grids[:1], maps)
        contexts = {name: decoder.context(grids[:1], maps) for name, decoder in fast.items()}

        def published() -> None:
            encoded = [network.levels(grid[None])[-1] for grid in grids]
            for own, grid in zip(encoded, grids, strict=True):
                others = [
                    functional.grid_sample(each, turn, align_corners=False) for each in encoded if each is not own
                ]
                fused = sum(others, own) / AGENTS
                logits, codes = network.decode(fused, network.context(grid[None], own))
                to_lidar(decode(anchors, codes.numpy()))
                detections(logits[:, 1] - logits[:, 0], codes, THRESHOLD)

        def plain() -> None:
            logits, codes = network.decode(maps, context)
            detections(logits[:, 1] - logits[:, 0], codes, THRESHOLD)

        def quick(name: str) -> None:
            detections_of_each(*fast[name].decode(maps, contexts[name]), THRESHOLD)

        times = in_turns(
            {
                PLAIN: plain,
                "by the fast decoder, float32": lambda: quick("float32"),
                "by the fast decoder, bfloat16": lambda: quick("bfloat16"),
                "what is the ego's own, once a frame, plain": lambda: network.context(grids[:1], maps),
                "the same, fast, float32": lambda: fast["float32"].context(grids[:1], maps),
                "the same, fast, bfloat16": lambda: fast["bfloat16"].context(grids[:1], maps),
            },
            turns,
        )
        times |= in_turns({PUBLISHED: published}, max(2, turns // 5))
    return Part("A hypothesis of the V2X-Sim layout", TEXT, rows(times, PLAIN))


def made_up(rng: np.random.Generator, background: float = 20.0) -> dict[str, torch.Tensor]:
    """Random weights with activations of a usual size. Anchors score the lower, the larger the background's bias is."""
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
    bias[::2] = background
    return state


def frame(background: float = 20.0) -> tuple[V2XSimDetector, Message, dict[str, Message]]:
    """A detector with made-up weights, an ego's message, and those of five teammates."""
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "made-up.safetensors")
        write_weights(made_up(rng, background), "mean", path)
        detector = V2XSimDetector(path)
    specs = detector.info.tensors
    occupied = rng.random((LAYERS, GRID, GRID)) < OCCUPIED

    def message(role: str) -> Message:
        tensors = {
            name: np.packbits(occupied).reshape(spec.shape)
            if spec.dtype == "uint8"
            else np.abs(rng.normal(size=spec.shape)).astype(spec.dtype)
            for name, spec in specs[role].items()
        }
        return Message(np.eye(4), tensors)

    return detector, message("ego"), {f"car-{i}": message("teammate") for i in range(2, 7)}
