"""What the stages of a frame take beside the least they could: their multiply-adds, and the bytes they must move."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from speed import v2xsim
from speed.embedded import EGO, frame
from speed.turns import Part, Row, in_turns, row
from torch.utils.flop_counter import FlopCounterMode

from robosac.calibrated import witness_of
from robosac.scenes import IntersectionScene

SQUARE = 768
"""Of a matrix product that is as fast as this core multiplies."""
COPIED = 32 * 2**20
"""Bytes of a copy that is as fast as this core moves memory."""
TEXT = f"""Processor time of a stage by its floor: the time of its multiply-adds at the pace of a float32 product of
{SQUARE} x {SQUARE} matrices, or of the bytes that go in and come out at the pace of a copy, whichever is longer.
Convolutions are counted as they are written: faster algorithms may stay below."""


def part(turns: int) -> Part:
    """Measure it."""
    detector, ego, teammates = frame()
    view = IntersectionScene(seed=3).frame(0).views[EGO]
    prepared, team = detector.prepare(ego, teammates), sorted(teammates)
    maps = [prepared.own, *prepared.warped.values()]
    witness = witness_of(detector.info)
    size = sum(tensor.nbytes for message in (ego, *teammates.values()) for tensor in message.tensors.values())
    own = sum(tensor.nbytes for tensor in ego.tensors.values())
    published, published_ego, others = v2xsim.frame()
    wide = published.prepare(published_ego, others)
    stages: dict[str, tuple[Callable[[], object], float]] = {
        "embedded: a scan encoded": (lambda: detector.encode(view.points, view.pose), float(view.points.nbytes + own)),
        "embedded: five messages laid over the ego's": (lambda: detector.prepare(ego, teammates), 3.0 * size),
        "embedded: a hypothesis of five": (lambda: prepared.detect(team), float(sum(m.nbytes for m in maps))),
        "V2X-Sim layout: a hypothesis of five": (
            lambda: wide.detect(sorted(others)),
            float(sum(m.nbytes for m in (wide.own, *wide.warped.values()))),
        ),
    }
    if witness is not None:
        stages["embedded: one message read by the witness"] = (lambda: witness.read_message(ego), float(own))
    a, b = torch.ones(SQUARE, SQUARE), torch.ones(SQUARE, SQUARE)
    block = np.ones(COPIED // 8)
    product, copy = "product", "copy"
    work = {product: lambda: a @ b, copy: block.copy} | {name: stage for name, (stage, _) in stages.items()}
    times = in_turns(work, turns)
    of_one = float(np.median(times[product])) / SQUARE**3
    of_byte = float(np.median(times[copy])) / COPIED
    rows: list[Row] = []
    for name, (stage, moved) in stages.items():
        with FlopCounterMode(display=False) as counter:
            stage()
        adds = counter.get_total_flops() / 2
        by_adds = adds * of_one >= moved * of_byte
        floor = max(adds * of_one, moved * of_byte)
        why = f"{adds / 1e6:.0f} M multiply-adds" if by_adds else f"{moved / 1e6:.1f} MB moved"
        rows.append(row(name, times[name], floor, why))
    return Part("Stages against their floors", TEXT, rows)
