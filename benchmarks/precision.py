"""What a narrower precision changes: verdicts, boxes and average precision, and how long a fusion takes.

Every subset of teammates is decoded in float32 and in the other precision, in frames of validation scenes with one
attacker of five, and compared with the ego's own boxes in the same precision.
"""

import time
from itertools import chain, combinations
from typing import Annotated

import numpy as np
import torch
import typer
from rich.console import Console
from rich.progress import track
from rich.table import Table

from robosac.attacks import load_campaign
from robosac.consensus import at_least, compare
from robosac.detectors import DEFAULT_DETECTOR, load
from robosac.evaluation.average_precision import AveragePrecision
from robosac.evaluation.frames import evaluation_frames
from robosac.scenes import DEFAULT_DATA, SOURCES, Split

PRECISIONS = ("float32", "bfloat16")


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
    rivals = {precision: load(f"{detector}@{precision}") for precision in PRECISIONS}
    wide = rivals["float32"]
    score = wide.info.consensus_score
    chosen = SOURCES.make(data).scenes(split)[:scenes]
    played = evaluation_frames(wide, chosen, frames, load_campaign(attack), 1, np.random.default_rng(0))
    verdicts = flips = 0
    likeness: list[float] = []
    precision = {name: {"alone": AveragePrecision(), "honest": AveragePrecision()} for name in rivals}
    times: dict[str, list[float]] = {name: [] for name in rivals}
    total = len(chosen) * frames
    for frame in track(filter(None, played), "frames", total=total, console=console, transient=True):
        prepared = {name: rival.prepare(frame.ego, frame.teammates) for name, rival in rivals.items()}
        alone = {name: own.detect() for name, own in prepared.items()}
        subsets = chain.from_iterable(combinations(frame.team, n) for n in range(1, len(frame.team) + 1))
        for subset in subsets:
            found, sure = {}, {}
            for name, own in prepared.items():
                began = time.process_time()
                found[name] = own.detect(subset)
                times[name].append(time.process_time() - began)
                sure[name] = at_least(found[name], score)
            said = {compare(at_least(alone[name], score), sure[name]).verdict for name in rivals}
            verdicts += 1
            flips += len(said) > 1
            likeness.append(compare(*sure.values()).jaccard_index)
            if subset == frame.honest:
                for name in rivals:
                    precision[name]["honest"].add(found[name], frame.truth)
        for name in rivals:
            precision[name]["alone"].add(alone[name], frame.truth)
    table = Table("", *PRECISIONS, title=f"{wide.info.name}: {verdicts} fusions of {data}, {split}, {attack} x 1")
    for what, name in (("the ego alone", "alone"), ("all honest", "honest")):
        for iou in (0.5, 0.7):
            row = [f"{precision[p][name].at(iou):.4f}" for p in PRECISIONS]
            table.add_row(f"AP{iou * 100:.0f}, {what}", *row)
    medians = [float(np.median(times[p])) for p in PRECISIONS]
    table.add_row("CPU time of a fusion, of that in float32", *(f"{m / medians[0]:.2f}" for m in medians))
    table.add_row("verdicts that flip", "", f"{flips} of {verdicts}")
    table.add_row("Jaccard index of boxes: mean, least", "", f"{np.mean(likeness):.4f}, {min(likeness):.2f}")
    console.print(table)


if __name__ == "__main__":
    typer.run(main)
