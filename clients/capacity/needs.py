r"""What a fleet needs, and what breaks first.

With :math:`\lambda` frames a second (vehicles times rate, as each vehicle asks for answers of its own), and what a
frame costs by the load test:

1. *Cores*: :math:`\lambda \cdot \mathrm{CPU}`, of which a machine may use its share :math:`b`, as of its network.
2. *Sessions of a process*: sessions are pinned, and the interpreter's lock lets one thread of a process work at a
   time. So it is an M/G/1 queue with the processor time of a frame as its service, whose wait may exceed the frame's
   patience for a small share of the frames (`queueing.most_rate`). The patience is what admission grants: half of
   what the budget leaves beyond the frame's own time, as `service.deciding.admission` does.
3. *Processes*: vehicles through sessions of a process, where the sessions are spread evenly. Where a proxy hashes
   their ids, some processes get more than others; so many are needed that few have too many (`queueing.most_mean`).
   On average a process is no busier than :math:`b`. A *pool* that may decide any frame anywhere is M/G/c; what it
   costs to move sessions is not in it.
4. *Bandwidth*: :math:`\lambda` times the bytes of a request, of an answer, and what TCP/IP over Ethernet adds: 90 bytes
   for each 1448 (Ethernet's 38 with preamble and gap, IPv4's 20, TCP's 32 with timestamps), and an acknowledgement of
   90 bytes the other way for every second segment.
5. *Disk a day*: :math:`\lambda \cdot 86400` times the bytes that the database grew by, times the share of the day's
   mean in its peak. What is kept is that times the retention.
6. *Database writes*: each decision is a transaction of the one database that all gateways share.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

from clients.capacity import queueing
from clients.capacity.costs import Costs

SHARE = 0.5
"""Part of a frame's spare time that others' work may take; that of the gateway's admission."""
SEGMENT_BYTES, SEGMENT_HEAD_BYTES = 1448, 90
DAY_S = 86_400
GIGA = 1e9


@dataclass(frozen=True)
class Scenario:
    """A fleet, and what is asked of its gateways. Each vehicle has a session of its own."""

    vehicles: int
    rate_hz: float = 5.0
    """Frames a second of a vehicle."""
    teammates: int = 5
    attacked: float = 0.0
    """Share of the sessions that have an attacker."""
    budget_ms: float = 200.0
    late: float = 0.01
    """Share of the frames that may wait too long."""
    busy: float = 0.7
    """How busy a core and a thread may be."""
    mean_share: float = 1.0
    """What the day's mean is of its peak."""
    retention_days: float = 7.0
    message_bytes: int | None = None
    """Of one vehicle's message, where it is not the one that was measured."""

    @property
    def frames_s(self) -> float:
        """Frames a second, at the peak."""
        return self.vehicles * self.rate_hz


@dataclass(frozen=True)
class Machine:
    """What a machine of the gateways has."""

    cores: int = 16
    network_gbps: float = 10.0
    disk_gb: float = 1000.0
    writes_s: float | None = None
    """Transactions a second of the database, where that was measured."""


@dataclass(frozen=True)
class Need:
    """One resource: what the fleet needs of it, what one machine has, and how many vehicles that is enough for."""

    resource: str
    unit: str
    needed: float
    has: float | None
    vehicles: float | None


@dataclass(frozen=True)
class Needs:
    """What a fleet needs."""

    frames_s: float
    cpu_ms: float
    """Of a frame."""
    sessions_of_a_process: int
    processes: dict[str, int]
    """By how sessions are placed: ``even``, ``hashed``, ``pool``."""
    cores: int
    needs: tuple[Need, ...]

    @property
    def breaks_first(self) -> Need:
        """The resource of a machine that is enough for the fewest vehicles."""
        return min((need for need in self.needs if need.vehicles is not None), key=lambda need: need.vehicles or 0.0)

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {**asdict(self), "gpus": None, "breaks_first": self.breaks_first.resource}


class NoneInTime(ValueError):
    """No process could answer one vehicle's frames within the budget."""


def patience_ms(costs: Costs, scenario: Scenario) -> float:
    """How long a frame may wait for others before it is refused."""
    own = costs.mixed(costs.latency_ms, scenario.teammates, scenario.attacked)
    return max(0.0, SHARE * (scenario.budget_ms - own))


def on_the_wire(there: float, back: float) -> float:
    """Bytes that a network carries one way for so many bytes of HTTP that way, and so many the other way."""
    return there * (1 + SEGMENT_HEAD_BYTES / SEGMENT_BYTES) + back / (2 * SEGMENT_BYTES) * SEGMENT_HEAD_BYTES


def needs_of(costs: Costs, scenario: Scenario, machine: Machine, sessions: int | None = None) -> Needs:
    """What a fleet needs, where a process may have so many sessions; by default as many as M/G/1 lets it have.

    Raises
    ------
    ValueError
        If the load test tells nothing of such teams or of processor time.
    NoneInTime
        If no frame could be answered in time.
    """
    costs.check_team(scenario.teammates)
    cpu_ms, sent, received = (
        costs.mixed(costs.known(name), scenario.teammates, scenario.attacked)
        for name in ("gateway_cpu_ms", "sent_bytes", "received_bytes")
    )
    service = costs.service(scenario.teammates, scenario.attacked)
    patience = patience_ms(costs, scenario)
    most_hz = queueing.most_rate(service, patience, scenario.late, scenario.busy) * 1e3 if patience else 0.0
    sessions = math.floor(most_hz / scenario.rate_hz) if sessions is None else sessions
    if sessions < 1:
        own = costs.mixed(costs.latency_ms, scenario.teammates, scenario.attacked)
        wanted = f"{scenario.rate_hz:g} frames a second within {scenario.budget_ms:g} ms: one takes {own:.3g} ms"
        late = f", and if they came at random, more than {scenario.late:.2g} of them would wait too long for others"
        raise NoneInTime(f"no process answers {wanted} by itself{late if patience and sessions == 0 else ''}")
    if scenario.message_bytes is not None:
        sent = scenario.message_bytes * (1 + scenario.teammates)
    inward, outward = (
        rate * scenario.frames_s * 8 / GIGA for rate in (on_the_wire(sent, received), on_the_wire(received, sent))
    )
    needs = [
        _need("cores", "", scenario.frames_s * cpu_ms / 1e3, machine.cores * scenario.busy, scenario),
        _need("network in", "Gbit/s", inward, machine.network_gbps * scenario.busy, scenario),
        _need("network out", "Gbit/s", outward, machine.network_gbps * scenario.busy, scenario),
        *_disk(costs, scenario, machine),
        _need("database writes", "1/s", scenario.frames_s, machine.writes_s, scenario),
    ]
    on_average = scenario.busy / service.mean * 1e3 / scenario.rate_hz
    even = math.ceil(scenario.vehicles / min(sessions, on_average))
    processes = {
        "even": even,
        "hashed": math.ceil(scenario.vehicles / min(on_average, queueing.most_mean(sessions, scenario.late))),
        "pool": _pool(scenario, service, patience, even),
    }
    cores = math.ceil(scenario.frames_s * cpu_ms / 1e3 / scenario.busy)
    return Needs(scenario.frames_s, cpu_ms, sessions, processes, cores, tuple(needs))


def _need(resource: str, unit: str, needed: float, has: float | None, scenario: Scenario) -> Need:
    vehicles = None if has is None or not needed else scenario.vehicles * has / needed
    return Need(resource, unit, needed, has, vehicles)


def _disk(costs: Costs, scenario: Scenario, machine: Machine) -> list[Need]:
    """By what the database grew, or where that could not be seen, by the log's lines."""
    bytes_a_frame = costs.a_frame("disk_bytes", scenario.teammates, scenario.attacked)
    if bytes_a_frame is None:
        bytes_a_frame = costs.a_frame("audit_bytes", scenario.teammates, scenario.attacked)
    if bytes_a_frame is None:
        return []
    a_day = scenario.frames_s * DAY_S * scenario.mean_share * bytes_a_frame / GIGA
    return [
        Need("disk a day", "GB", a_day, None, None),
        _need("disk kept", "GB", a_day * scenario.retention_days, machine.disk_gb, scenario),
    ]


def _pool(scenario: Scenario, service: queueing.Service, patience: float, enough: int) -> int:
    """The least number of servers at which a pool is no busier, and no later, than it may be."""
    rate = scenario.frames_s / 1e3
    least = max(1, math.ceil(rate * service.mean / scenario.busy))
    if least >= enough:
        return least
    in_time: Callable[[int], bool] = lambda servers: (  # noqa: E731
        queueing.pool_late(rate, service, servers, patience) <= scenario.late
    )
    return least + bisect_left(range(least, enough), True, key=in_time)
