"""What is left of a frame once its last message is there, when it was begun before, against one decode.

Sample consensus with one hypothesis of all teammates, in process. The V2X-Sim layout has made-up weights: time does not
depend on them.
"""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from v2xsim import GRID, LAYERS, OCCUPIED, made_up

import robosac
from robosac.ahead import Ahead
from robosac.defenses import EGO, SampleConsensus
from robosac.detectors import Detector, Message
from robosac.detectors.v2xsim.detector import V2XSimDetector, write_weights
from robosac.session import Session


def main(repeats: Annotated[int, typer.Option(min=3)] = 15) -> None:
    torch.set_num_threads(1)
    for name, (detector, ego, teammates) in {"embedded": embedded(), "V2X-Sim layout": v2xsim()}.items():
        measure(name, detector, ego, teammates, repeats)


def measure(name: str, detector: Detector, ego: Message, teammates: dict[str, Message], repeats: int) -> None:
    team = sorted(teammates)
    defense = SampleConsensus(sampling_budget=1, collaborators=len(team))
    prepared = detector.prepare(ego, teammates)

    def answer(ahead: Ahead | None) -> None:
        Session(detector, team, defense, screening=None).answer(0, ego, teammates, detector=ahead)

    work: dict[str, tuple[Callable[[], Ahead | None], Callable[[Ahead | None], object]]] = {
        "one decode": (lambda: None, lambda _: prepared.detect(team)),
        "a frame, from its first message": (lambda: None, answer),
        "a frame, from its last message": (lambda: begun(detector, ego, teammates), answer),
    }
    times: dict[str, list[float]] = {label: [] for label in work}
    for _ in range(repeats + 1):
        for label, (before, function) in work.items():
            ahead = before()
            began = time.process_time()
            function(ahead)
            times[label].append(time.process_time() - began)
    base = float(np.median(times["one decode"][1:]))
    print(f"{name}, one hypothesis of {len(team)}, one thread; CPU time, medians of {repeats} turns (quartiles)")
    for label, measured in times.items():
        low, middle, high = np.quantile(measured[1:], (0.25, 0.5, 0.75))
        print(f"  {label:34} {middle / base:.2f} of one decode ({low / base:.2f} to {high / base:.2f})")


def begun(detector: Detector, ego: Message, teammates: dict[str, Message]) -> Ahead:
    """A frame of which all messages were there some time ago."""
    ahead = Ahead(detector, ego)
    ahead.see_alone()
    ahead.read(EGO, ego)
    for name, message in teammates.items():
        ahead.lay(name, message)
        ahead.read(name, message)
    return ahead


def embedded() -> tuple[Detector, Message, dict[str, Message]]:
    detector = robosac.load_detector()
    views = robosac.IntersectionScene(seed=3).frame(0).views
    messages = {name: detector.encode(view.points, view.pose) for name, view in views.items()}
    return detector, messages.pop("car-1"), messages


def v2xsim() -> tuple[Detector, Message, dict[str, Message]]:
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "made-up.safetensors")
        write_weights(made_up(rng), "mean", path)
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


if __name__ == "__main__":
    typer.run(main)
