"""What a narrower precision, or another device, changes: verdicts, boxes, average precision, testimony, and their time.

Every subset of teammates is decoded in float32 on the processor and in the narrower precision, in frames of validation
scenes with one attacker of five, and compared with the ego's own boxes in the same precision.
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
from robosac.boxes import FloatArray
from robosac.calibrated import witness_of
from robosac.consensus import at_least, compare
from robosac.defenses import EGO
from robosac.detectors import DEFAULT_DETECTOR, Detector, load
from robosac.detectors.base import Precision
from robosac.evaluation.average_precision import AveragePrecision
from robosac.evaluation.frames import EvaluationFrame, evaluation_frames
from robosac.scenes import DEFAULT_DATA, SOURCES, Split
from robosac.testimony import LIKELIHOOD


def main(
    detector: str = DEFAULT_DETECTOR,
    data: str = DEFAULT_DATA,
    attack: str = "pgd",
    split: Split = "validation",
    scenes: Annotated[int, typer.Option(min=1)] = 20,
    frames: Annotated[int, typer.Option(min=1)] = 3,
    narrow: Precision = "bfloat16",
    device: Annotated[str, typer.Option(help="Of the narrower precision, by torch's name: cpu, cuda, cuda:1.")] = "cpu",
) -> None:
    torch.set_num_threads(1)
    console = Console()
    wide = load(f"{detector}@float32")
    rivals = {"float32, cpu": wide, f"{narrow}, {device}": load(f"{detector}@{narrow}", device)}
    precisions = tuple(rivals)
    if len(precisions) < 2:
        raise typer.BadParameter("nothing to compare: choose another --narrow, or another --device")
    score = wide.info.consensus_score
    chosen = SOURCES.make(data).scenes(split)[:scenes]
    played = evaluation_frames(wide, chosen, frames, load_campaign(attack), 1, np.random.default_rng(0))
    verdicts = flips = 0
    likeness: list[float] = []
    precision = {name: {"alone": AveragePrecision(), "honest": AveragePrecision()} for name in rivals}
    times: dict[str, list[float]] = {name: [] for name in rivals}
    reading: dict[str, list[float]] = {name: [] for name in rivals}
    differs: list[float] = []
    total = len(chosen) * frames
    for frame in track(filter(None, played), "frames", total=total, console=console, transient=True):
        prepared = {name: rival.prepare(frame.ego, frame.teammates) for name, rival in rivals.items()}
        alone = {name: own.detect() for name, own in prepared.items()}
        said_by = {name: testimony(rival, frame, reading[name]) for name, rival in rivals.items()}
        if all(said is not None for said in said_by.values()):
            differs.append(float(np.abs(np.subtract(*said_by.values())).mean()))
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
    table = Table("", *precisions, title=f"{wide.info.name}: {verdicts} fusions of {data}, {split}, {attack} x 1")
    for what, name in (("the ego alone", "alone"), ("all honest", "honest")):
        for iou in (0.5, 0.7):
            row = [f"{precision[p][name].at(iou):.4f}" for p in precisions]
            table.add_row(f"AP{iou * 100:.0f}, {what}", *row)
    medians = [float(np.median(times[p])) for p in precisions]
    table.add_row("CPU time of a fusion, of that in float32", *(f"{m / medians[0]:.2f}" for m in medians))
    if differs:
        medians = [float(np.median(reading[p])) for p in precisions]
        table.add_row("CPU time of testimony, of that in float32", *(f"{m / medians[0]:.2f}" for m in medians))
        table.add_row("L of testimony: mean difference", "", f"{np.mean(differs):.3f}")
    table.add_row("verdicts that flip", "", f"{flips} of {verdicts}")
    table.add_row("Jaccard index of boxes: mean, least", "", f"{np.mean(likeness):.4f}, {min(likeness):.2f}")
    console.print(table)


def testimony(detector: Detector, frame: EvaluationFrame, times: list[float]) -> FloatArray | None:
    """L (agents, H, W) of what the messages of a frame say; None without a witness. Its time is added to the others."""
    witness = witness_of(detector.info)
    if witness is None:
        return None
    began = time.process_time()
    said = witness.testify(EGO, {EGO: frame.ego, **frame.teammates})
    times.append(time.process_time() - began)
    return said.maps[:, LIKELIHOOD]


if __name__ == "__main__":
    typer.run(main)
