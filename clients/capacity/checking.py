"""The model against what was measured: predicted from single egos, compared with all other loads."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from clients.capacity.costs import Costs, calibration, costs_of, others_at_work
from clients.capacity.queueing import closed_rate
from clients.capacity.report import MeasuredLoad, Report

WITHIN = 0.2
"""How far a prediction may be off, of what was measured."""
OVERLAP = 1.14
"""Cores that a busy process uses: the detector's arithmetic needs no interpreter while another thread has it. Measured
with four egos in closed loops: 1.11 to 1.18.
"""
MOST_BUSY = 0.94
"""Of its processor time a machine whose cores all have work spends so much; measured with eight egos on two processes.
"""
_ROUNDS = 30


@dataclass(frozen=True)
class Check:
    """One figure of one load."""

    load: MeasuredLoad
    figure: str
    predicted: float
    measured: float

    @property
    def off(self) -> float:
        """By how much the prediction is higher, of what was measured."""
        return self.predicted / self.measured - 1

    @property
    def holds(self) -> bool:
        """Whether it is near enough."""
        return abs(self.off) <= WITHIN


def checks(report: Report) -> list[Check]:
    """Every load that costs were not fitted to, with its frames a second and its bytes on disk and on record.

    Raises
    ------
    ValueError
        As `costs_of` and `predicted_fps`, or if costs were fitted to all loads.
    """
    costs, fitted = costs_of(report), calibration(report)
    others = [load for load in report.loads if load not in fitted]
    if not others:
        raise ValueError(
            "the report has no load to compare with: costs were fitted to all; measure with --egos 1 --egos 4"
        )
    return [check for load in others for check in _of_load(costs, report, load)]


def predicted_fps(costs: Costs, load: MeasuredLoad, processes: int, cores: int) -> float:
    r"""Frames a second of a load whose client runs on the gateway's machine.

    Of each process a closed network: the process is one server, since the interpreter's lock lets one of its threads
    work at a time, but for some arithmetic (`OVERLAP`); what a frame waits for besides (the disk, the client) is a
    delay. All together can not have more processor time than there is, that of gateways, client, proxy and all else on
    the machine: :math:`X \leq 0.94\,\mathrm{cores} / \mathrm{CPU}`.

    Times are those of single egos, at the machine's pace before this load, and longer the more of the other cores work
    meanwhile (`MeasuredLoad.slowness`). How many do depends on the rate, so that the rate is the one that agrees with
    itself. Egos are where they fell, or else spread evenly. In an open loop no more is answered than is asked. Frames
    that are refused are not in it: measure with a budget that refuses none.

    Raises
    ------
    ValueError
        If processor time was not measured.
    """
    at = (load.teammates, load.sampling_steps_mean)
    latency_ms = costs.latency_ms.at(*at)
    gateway_ms, machine = costs.known("gateway_cpu_ms").at(*at), costs.used["machine_cpu_ms"]
    machine_ms = gateway_ms + costs.known("client_cpu_ms").at(*at) if machine is None else machine.at(*at)
    delay_ms = max(0.0, latency_ms - gateway_ms / OVERLAP)
    even = [load.egos // processes + (number < load.egos % processes) for number in range(processes)]
    shares = load.placed or even

    def rate_at(slow: float) -> float:
        rate = sum(closed_rate(egos, [gateway_ms / OVERLAP * slow], delay_ms * slow) for egos in shares) * 1e3
        rate = min(rate, MOST_BUSY * cores * 1e3 / (machine_ms * slow))
        return rate if load.rate_hz is None else min(rate, load.egos * load.rate_hz)

    def others(rate: float, slow: float) -> float:
        return others_at_work(rate, gateway_ms * slow, machine_ms * slow, processes, cores)

    slow = load.slowness(costs.pace_ms, 0.0)
    for _ in range(_ROUNDS):
        slow = (slow + load.slowness(costs.pace_ms, others(rate_at(slow), slow))) / 2
    return rate_at(slow)


def _of_load(costs: Costs, report: Report, load: MeasuredLoad) -> Iterator[Check]:
    fps = predicted_fps(costs, load, report.processes, report.machine.cores)
    yield Check(load, "frames a second", fps, load.fps)
    for name in ("disk_bytes", "audit_bytes"):
        line, measured = costs.used[name], load.used_a_frame.get(name)
        if line is not None and measured:
            at = line.at(load.teammates, load.sampling_steps_mean)
            yield Check(load, name.replace("_", " ") + " a frame", at, measured)
