"""What narrower and compressed messages change: bytes, verdicts, boxes and average precision, and the time to pack and
read them.

In frames of validation scenes with one attacker of five, every subset of teammates is decoded from the messages as they
are made, and from the same ones in a narrower type; the ego's too. Compression loses nothing.
"""

import time
from dataclasses import replace
from itertools import chain, combinations
from typing import Annotated

import numpy as np
import torch
import typer
from rich.console import Console
from rich.progress import track
from rich.table import Table

from robosac import wire
from robosac.attacks import load_campaign
from robosac.consensus import at_least, compare
from robosac.detectors import DEFAULT_DETECTOR, Message, load, narrow
from robosac.evaluation.average_precision import AveragePrecision
from robosac.evaluation.frames import evaluation_frames
from robosac.scenes import DEFAULT_DATA, SOURCES, Split


def main(
    detector: str = DEFAULT_DETECTOR,
    data: str = DEFAULT_DATA,
    attack: str = "pgd",
    split: Split = "validation",
    scenes: Annotated[int, typer.Option(min=1)] = 20,
    frames: Annotated[int, typer.Option(min=1)] = 3,
) -> None:
    torch.set_num_threads(1)
    console = Console()
    own = load(detector)
    spec = max(own.info.tensors["teammate"].values(), key=lambda each: each.nbytes)
    types = {spec.dtype: wire.Packing()} | {dtype: wire.Packing(dtype) for dtype in spec.narrower}
    types |= {f"{name}, zstd": replace(packing, compress=True) for name, packing in types.items()}
    chosen = SOURCES.make(data).scenes(split)[:scenes]
    played = evaluation_frames(own, chosen, frames, load_campaign(attack), 1, np.random.default_rng(0))
    verdicts, flips = 0, dict.fromkeys(types, 0)
    likeness: dict[str, list[float]] = {name: [] for name in types}
    precision = {name: AveragePrecision() for name in types}
    sizes, packed, read = ({name: [] for name in types} for _ in range(3))
    for frame in track(filter(None, played), "frames", total=len(chosen) * frames, console=console, transient=True):
        prepared = {}
        for name, packing in types.items():
            ego, *team = (_sent(message, packing.dtype) for message in (frame.ego, *frame.teammates.values()))
            if not packing.compress:
                prepared[name] = own.prepare(ego, dict(zip(frame.teammates, team, strict=True)))
            made = next(iter(frame.teammates.values()))
            began = time.process_time()
            body = wire.pack_message(0, "car-1", _sent(made, packing.dtype), packing=packing)
            packed[name].append(time.process_time() - began)
            sizes[name].append(len(body))
            began = time.process_time()
            wire.check_message(wire.read_message(body).payload, own.info, "teammate")
            read[name].append(time.process_time() - began)
        score = own.info.consensus_score
        alone = {name: at_least(each.detect(), score) for name, each in prepared.items()}
        subsets = chain.from_iterable(combinations(frame.team, n) for n in range(1, len(frame.team) + 1))
        for subset in subsets:
            verdicts += 1
            found = {name: each.detect(subset) for name, each in prepared.items()}
            sure = {name: at_least(boxes, score) for name, boxes in found.items()}
            said = {name: compare(alone[name], boxes).verdict for name, boxes in sure.items()}
            for name in prepared:
                flips[name] += said[name] != said[spec.dtype]
                likeness[name].append(compare(sure[spec.dtype], sure[name]).jaccard_index)
                if subset == frame.honest:
                    precision[name].add(found[name], frame.truth)
    decoded = [name for name, packing in types.items() if not packing.compress]
    table = Table("", *types, title=f"{own.info.name}: {verdicts} fusions of {data}, {split}, {attack} x 1")
    table.add_row("bytes of a message", *(f"{np.median(sizes[name]):,.0f}" for name in types))
    for iou in (0.5, 0.7):
        table.add_row(f"AP{iou * 100:.0f}, all honest", *(f"{precision[name].at(iou):.4f}" for name in decoded))
    table.add_row("verdicts that flip", *(str(flips[name]) for name in decoded))
    alike = (f"{np.mean(likeness[name]):.4f}, {min(likeness[name]):.2f}" for name in decoded)
    table.add_row("Jaccard index of boxes: mean, least", *alike)
    for what, times in (("to pack", packed), ("to read", read)):
        base = float(np.median(times[spec.dtype]))
        table.add_row(f"CPU time {what} a message", *(f"{np.median(times[name]) / base:.2f}" for name in types))
    console.print(table)


def _sent(message: Message, dtype: str | None) -> Message:
    return message if dtype is None else narrow.rounded(message, dtype)


if __name__ == "__main__":
    typer.run(main)
