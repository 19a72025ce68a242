"""What frames cost beside time: processor time, bytes on the network, and bytes on disk."""

from __future__ import annotations

import math
import os
import sqlite3
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import httpx
from prometheus_client.parser import text_string_to_metric_families

from clients.client import LIMITS
from clients.errors import GatewayUnreachable

CPU, FRAMES = "process_cpu_seconds", "robosac_frames"
LINE_BYTES = len("HTTP/1.1 200 OK\r\n\r\n")
"""About what a request or an answer has beside its header fields and its body."""


class CountingTransport(httpx.AsyncHTTPTransport):
    """Counts the bytes of requests and answers, as HTTP/1.1 has them; what TCP and TLS add is not in it."""

    def __init__(self) -> None:
        super().__init__(limits=LIMITS, trust_env=False, verify=httpx.create_ssl_context())
        self.sent_bytes = self.received_bytes = 0

    async def handle_async_request(self, request: httpx.Request) -> httpx.Response:
        self.sent_bytes += _bytes_of(request.headers) + len(request.url.raw_path)
        response = await super().handle_async_request(request)
        self.received_bytes += _bytes_of(response.headers)
        return response


def _bytes_of(headers: httpx.Headers) -> int:
    fields = sum(len(name) + len(value) + 4 for name, value in headers.raw)
    return LINE_BYTES + fields + int(headers.get("content-length", 0))


@dataclass(frozen=True)
class Reading:
    """What was used until a moment."""

    gateway_cpu_s: float
    """Of all gateway processes; NaN where one does not tell."""
    client_cpu_s: float
    """Of this process."""
    machine_cpu_s: float
    """Of everything on this machine; NaN where the system does not tell."""
    disk_bytes: float
    """The database's size; NaN where it cannot be seen from here."""
    sent_bytes: int
    received_bytes: int

    def since(self, earlier: Reading, frames: int) -> dict[str, float | None]:
        """What a frame took since then; None where it is not known."""
        spent = {
            "gateway_cpu_ms": (self.gateway_cpu_s - earlier.gateway_cpu_s) * 1e3,
            "client_cpu_ms": (self.client_cpu_s - earlier.client_cpu_s) * 1e3,
            "machine_cpu_ms": (self.machine_cpu_s - earlier.machine_cpu_s) * 1e3,
            "disk_bytes": self.disk_bytes - earlier.disk_bytes,
            "sent_bytes": self.sent_bytes - earlier.sent_bytes,
            "received_bytes": self.received_bytes - earlier.received_bytes,
        }
        return {name: value / frames if frames and math.isfinite(value) else None for name, value in spent.items()}


@dataclass(frozen=True)
class Meter:
    """Reads what gateways and this client have used.

    Parameters
    ----------
    gateways : sequence of str
        URL of each process: behind a proxy an address answers for one of them only.
    database_url : str
        Where they keep their sessions; a SQLite file can be seen from here.
    transport : CountingTransport
    """

    gateways: Sequence[str]
    database_url: str
    transport: CountingTransport

    async def read(self) -> Reading:
        """What was used until now.

        Raises
        ------
        GatewayUnreachable
            If a gateway does not tell its metrics.
        """
        cpu_s = math.fsum([samples[0] if samples else math.nan for samples in await self._samples(CPU)])
        sent, received = self.transport.sent_bytes, self.transport.received_bytes
        return Reading(cpu_s, time.process_time(), _machine_cpu_s(), self._disk_bytes(), sent, received)

    async def frames(self) -> list[int]:
        """How many frames each gateway has answered.

        Raises
        ------
        GatewayUnreachable
            If a gateway does not tell its metrics.
        """
        return [int(sum(samples)) for samples in await self._samples(FRAMES)]

    async def _samples(self, name: str) -> list[list[float]]:
        """Of each gateway, the values of a metric."""
        async with httpx.AsyncClient(trust_env=False, verify=httpx.create_ssl_context()) as http:
            return [await _samples(http, url, name) for url in self.gateways]

    def _disk_bytes(self) -> float:
        """Pages of a SQLite file, those that are still in its write-ahead log included."""
        kind, _, path = self.database_url.partition(":///")
        if kind != "sqlite" or not path:
            return math.nan
        try:
            with closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as connection:
                (pages,), (size,) = (
                    connection.execute(f"PRAGMA {name}").fetchone() for name in ("page_count", "page_size")
                )
        except sqlite3.Error:
            return math.nan
        return float(pages * size)


def _machine_cpu_s() -> float:
    """Time that all cores together have worked, as Linux tells it (proc_stat(5)): user, nice, system, irq, softirq."""
    try:
        user, nice, system, _, _, irq, softirq = map(int, Path("/proc/stat").read_text().split(maxsplit=8)[1:8])
    except (OSError, ValueError):
        return math.nan
    return (user + nice + system + irq + softirq) / os.sysconf("SC_CLK_TCK")


async def _samples(http: httpx.AsyncClient, url: str, name: str) -> list[float]:
    try:
        text = (await http.get(f"{url}/metrics")).raise_for_status().text
    except httpx.HTTPError as error:
        raise GatewayUnreachable(f"GET {url}/metrics: {type(error).__name__} {error}") from error
    families = [family for family in text_string_to_metric_families(text) if family.name == name]
    return [sample.value for family in families for sample in family.samples if not sample.name.endswith("_created")]
