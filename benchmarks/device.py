"""What a frame takes on a device: seven hypotheses one by one and in one batch, batches of several sizes, and passes
that frames of several sessions share.

A frame of ROBOSAC's sampling is one in which nothing is in consensus, so that all seven hypotheses are tested. Its
messages begin and its boxes end on the processor. Times are wall-clock, taken turn by turn. The detector ``v2x-sim`` is
one of that layout with weights and messages that are made up; its fusions have 2 to 9 boxes, and the ego alone 40.
"""

import time
from collections.abc import Callable, Mapping
from functools import partial
from itertools import chain, combinations, cycle, islice
from typing import Annotated, Any

import numpy as np
import torch
import typer
from rich.console import Console
from rich.table import Table
from speed import v2xsim

from robosac import SampleConsensus, fuse
from robosac.ahead import Ahead
from robosac.consensus import compare
from robosac.detectors import DEFAULT_DETECTOR, Message, load
from robosac.detectors.base import split_precision
from robosac.detectors.device import as_device
from robosac.detectors.loading import warm_up
from robosac.scenes import IntersectionScene

SIZES = (1, 2, 4, 8, 16, 32)
DEFENSE = SampleConsensus(sampling_budget=7, collaborators=3, consensus_threshold=1.0)
AT_ONCE = 8
"""The ego alone, and seven hypotheses."""
MADE_UP = "v2x-sim"


def in_turns(
    work: Mapping[str, Callable[..., object]], turns: int, before: Mapping[str, Callable[[], object]] | None = None
) -> dict[str, float]:
    """Median milliseconds of each, after one turn that does not count. What is done ``before`` one is given to it."""
    times: dict[str, list[float]] = {name: [] for name in work}
    for _ in range(turns + 1):
        for name, function in work.items():
            given = [before[name]()] if before and name in before else []
            if torch.cuda.is_available():
                torch.cuda.synchronize()
            began = time.perf_counter()
            function(*given)
            times[name].append(1e3 * (time.perf_counter() - began))
    return {name: float(np.median(of[1:])) for name, of in times.items()}


def shown(detector: str) -> tuple[Any, Message, dict[str, Message]]:
    """A detector, the message of an ego, and those of its teammates."""
    plain, precision = split_precision(detector)
    if plain == MADE_UP:
        made_up, ego, messages = v2xsim.frame(v2xsim.CROWDED)
        return made_up.in_precision(precision), ego, messages
    loaded: Any = load(detector)
    if not hasattr(loaded, "encode") or not hasattr(loaded, "worth"):
        raise typer.BadParameter(f"{detector} makes no messages, or its frames decode one subset at a time")
    messages = {name: loaded.encode(v.points, v.pose) for name, v in IntersectionScene(3).frame(0).views.items()}
    return loaded, messages.pop("car-1"), messages


def main(
    device: Annotated[str, typer.Option(help="By torch's name: cpu, cuda, cuda:1.")] = "cpu",
    detector: str = DEFAULT_DETECTOR,
    turns: Annotated[int, typer.Option(min=1)] = 30,
    threads: Annotated[int, typer.Option(min=1, help="Of torch, on the processor.")] = 1,
) -> None:
    try:
        as_device(device)
        loaded, ego, messages = shown(detector)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from error
    torch.set_num_threads(threads)
    placed = {worth: loaded.on_device(device, worth) for worth in (1, AT_ONCE)}
    for each in placed.values():
        warm_up(each)

    def frame(worth: int, begun: Ahead | None = None) -> None:
        fuse(begun or placed[worth], DEFENSE, ego, messages, rng=np.random.default_rng(0))

    def begun() -> Ahead:
        """A frame of which all messages but one were there some time ago."""
        ahead = Ahead(placed[AT_ONCE], ego)
        ahead.see_alone()
        for name in list(messages)[:-1]:
            ahead.lay(name, messages[name])
        return ahead

    prepared = placed[AT_ONCE].prepare(ego, messages)
    every = list(chain.from_iterable(combinations(messages, size) for size in range(len(messages) + 1)))
    batches = {str(size): list(islice(cycle(every), size)) for size in SIZES}
    from_last = f"{AT_ONCE} at once, from its last message on"
    kinds: dict[str, Callable[..., object]] = {
        "one by one": lambda: frame(1),
        f"{AT_ONCE} at once": lambda: frame(AT_ONCE),
        from_last: partial(frame, AT_ONCE),
    }
    frames = in_turns(kinds, turns, {from_last: begun})
    decodes = in_turns({name: lambda s=subsets: prepared.detect_all(s) for name, subsets in batches.items()}, turns)
    frames_of = [placed[AT_ONCE].prepare(ego, messages) for _ in range(max(SIZES))]
    sessions = {
        str(size): partial(frames_of[0].detect_together, [(frame, every[-1:]) for frame in frames_of[:size]])
        for size in SIZES
    }
    shared = in_turns(sessions, turns)
    decodes |= in_turns({"1, not as a batch": lambda: prepared.detect(every[-1])}, turns)

    parts = {
        "prepared": lambda: placed[AT_ONCE].prepare(ego, messages),
        "decoded": lambda: prepared.detect_all(batches[str(AT_ONCE)]),
        "compared": lambda: [compare(boxes, boxes) for boxes in found[1:]],
    }
    found = prepared.detect_all(batches[str(AT_ONCE)])
    stages = in_turns(parts, turns)

    console, face = Console(), placed[1].info
    console.print(f"{face.name} on {face.device}, {len(messages)} teammates, torch threads: {threads}")
    table = Table("a frame with seven hypotheses", "ms", "frames a second")
    for name, ms in frames.items():
        table.add_row(name, f"{ms:.2f}", "" if name == from_last else f"{1e3 / ms:.1f}")
    console.print(table)
    table = Table(f"parts of it, {AT_ONCE} at once", "ms")
    for name, ms in stages.items():
        table.add_row(name, f"{ms:.2f}")
    console.print(table)
    table = Table("subsets decoded at once", "ms", "ms a subset")
    for name, ms in decodes.items():
        table.add_row(name, f"{ms:.2f}", f"{ms / int(name.partition(',')[0]):.2f}")
    console.print(table)
    table = Table("frames of several sessions, one subset each, at once", "ms", "ms a frame")
    for name, ms in shared.items():
        table.add_row(name, f"{ms:.2f}", f"{ms / int(name):.2f}")
    console.print(table)


if __name__ == "__main__":
    typer.run(main)
