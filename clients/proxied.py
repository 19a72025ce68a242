"""Gateway processes on one database behind HAProxy, with the configuration that ships, for the length of a trial."""

from __future__ import annotations

import asyncio
import contextlib
import os
import re
import shutil
import signal
import ssl
import subprocess
from collections.abc import AsyncIterator
from pathlib import Path

from clients.client import GatewayClient
from clients.errors import GatewayUnreachable
from clients.local_gateway import STOP_TIMEOUT_S, GatewayProcess, free_port

_BIND = re.compile(r"bind :8443 ssl crt \S+")
_USER = re.compile(r"^    (?:user|group) .*\n", re.MULTILINE)
_SERVER = re.compile(r"^    server p1 127\.0\.0\.1:8001(.*)\n    server p2 .*\n", re.MULTILINE)


def program() -> str | None:
    """Where HAProxy is; Debian has it where only its administrator looks. None if it is not installed."""
    return shutil.which("haproxy") or shutil.which("haproxy", path="/usr/sbin:/usr/local/sbin")


def configured(text: str, ports: list[int], port: int, certificate: Path | None) -> str:
    """The shipped configuration for these processes, on this port, with TLS where there is a certificate.

    Whoever is not root cannot become another user, and keeps its own.

    Raises
    ------
    ValueError
        If it is not the shipped one.
    """
    bind = f"bind 127.0.0.1:{port}" + ("" if certificate is None else f" ssl crt {certificate}")
    alpn = " alpn h2,http/1.1"
    text = text if os.geteuid() == 0 else _USER.sub("", text)
    text, binds = _BIND.subn(bind, text if certificate else text.replace(alpn, ""))

    def servers(found: re.Match[str]) -> str:
        lines = [f"    server p{n} 127.0.0.1:{own}{found[1]}\n" for n, own in enumerate(ports, 1)]
        return "".join(line.replace("sessions/p1", f"sessions/p{n}") for n, line in enumerate(lines, 1))

    text, lists = _SERVER.subn(servers, text)
    if (binds, lists) != (1, 2):
        raise ValueError("not the proxy's configuration that ships")
    return text


class Proxied:
    """Some gateway processes and the proxy in front of them.

    Parameters
    ----------
    config : Path
        ``deploy/haproxy.cfg``.
    folder : Path
        For logs and the configuration in use.
    database_url : str
    api_key : str
        Needed, as whoever comes by a proxy is a stranger.
    processes : int
    certificate : Path, optional
        Certificate and key, PEM; by default there is no TLS.
    """

    def __init__(
        self,
        config: Path,
        folder: Path,
        database_url: str,
        api_key: str,
        processes: int,
        certificate: Path | None = None,
    ) -> None:
        self._folder, self._database_url, self._api_key = folder, database_url, api_key
        self._ports = [free_port() for _ in range(processes)]
        port = free_port()
        scheme = "http" if certificate is None else "https"
        self.url = f"{scheme}://localhost:{port}" if certificate else f"{scheme}://127.0.0.1:{port}"
        self._tls = None if certificate is None else ssl.create_default_context(cafile=str(certificate))
        self._config = folder / "haproxy.cfg"
        self._config.write_text(configured(config.read_text(), self._ports, port, certificate))
        self._proxy: subprocess.Popen[bytes] | None = None
        self.processes: list[GatewayProcess] = []

    def client(self) -> GatewayClient:
        """A client of the proxy."""
        return GatewayClient(self.url, self._api_key, tls=self._tls)

    async def start(self) -> None:
        """Start all, and wait until the proxy has found every process ready."""
        self.processes = [self._process(number) for number in range(len(self._ports))]
        await asyncio.gather(*(process.ready() for process in self.processes))
        haproxy = program()
        if haproxy is None:
            raise FileNotFoundError("haproxy")
        with (self._folder / "haproxy.log").open("ab") as log:
            self._proxy = subprocess.Popen([haproxy, "-db", "-f", str(self._config)], stdout=log, stderr=log)
        async with self.client() as client:
            while not await client.ready():
                if self._proxy.poll() is not None:
                    said = (self._folder / "haproxy.log").read_text()[-2000:]
                    raise GatewayUnreachable(f"haproxy ended; its log ends:\n{said}")
                await asyncio.sleep(0.05)

    async def restart(self, number: int, *, gently: bool) -> None:
        """End one process, by SIGTERM or by SIGKILL, and start another on its port."""
        await self.end(number, gently=gently)
        await self.begin(number)

    async def end(self, number: int, *, gently: bool) -> None:
        """As the first half of `restart`."""
        process = self.processes[number]
        await (process.stop() if gently else process.kill())

    async def begin(self, number: int) -> None:
        """As the second half of `restart`."""
        self.processes[number] = self._process(number)
        await self.processes[number].ready()

    async def stop(self) -> None:
        """End all."""
        if self._proxy is not None and self._proxy.poll() is None:
            self._proxy.send_signal(signal.SIGTERM)
            await asyncio.to_thread(self._proxy.wait, STOP_TIMEOUT_S)
        await asyncio.gather(*(process.stop() for process in self.processes))

    def cpu_s(self) -> float:
        """Processor time that the processes have used, seconds."""
        return sum(process.cpu_s() for process in self.processes)

    def _process(self, number: int) -> GatewayProcess:
        log, port = self._folder / f"gateway-{number}.log", self._ports[number]
        return GatewayProcess(log, self._database_url, self._api_key, port=port)


@contextlib.asynccontextmanager
async def proxied(
    config: Path, folder: Path, database_url: str, api_key: str, processes: int, certificate: Path | None = None
) -> AsyncIterator[Proxied]:
    """Gateways behind a proxy for the length of a block, as `Proxied`."""
    gateways = Proxied(config, folder, database_url, api_key, processes, certificate)
    try:
        await gateways.start()
        yield gateways
    finally:
        await gateways.stop()
