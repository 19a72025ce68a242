"""A gateway of one's own for the length of a block: started as a child process on a free loopback port."""

from __future__ import annotations

import asyncio
import contextlib
import math
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Iterator, Mapping
from pathlib import Path

from clients.client import GatewayClient
from clients.errors import GatewayUnreachable

START_TIMEOUT_S = 120.0
STOP_TIMEOUT_S = 20.0
ENDING_S = 1.0
"""How long a process may take to end after its connections have."""
KEY_SETTINGS = ("ROBOSAC_API_KEYS", "ROBOSAC_API_KEYS_FILE", "ROBOSAC_VIEWER_TOKENS")


class GatewayProcess:
    """A gateway in a child process, on a free loopback port.

    Parameters
    ----------
    log : Path
        What the gateway prints is added to it.
    database_url : str
    api_key : str, optional
        The one that it asks for; by default it asks for none, whatever the environment says, and serves loopback only.
    port : int, optional
        By default a free one.
    settings : mapping of variable to text
        More of its environment.
    """

    def __init__(
        self,
        log: Path,
        database_url: str,
        api_key: str | None = None,
        *,
        port: int | None = None,
        settings: Mapping[str, str] | None = None,
    ) -> None:
        port = free_port() if port is None else port
        self.port, self.url = port, f"http://127.0.0.1:{port}"
        self._log = log
        command = [sys.executable, "-m", "uvicorn", "service.app:app", "--host", "127.0.0.1", "--port", str(port)]
        command += ["--http", "service.arriving.connections:BoundedHTTP"]
        environment = {name: value for name, value in os.environ.items() if name not in KEY_SETTINGS}
        if api_key is not None:
            environment["ROBOSAC_API_KEYS"] = api_key
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("ab") as output:
            self._process = subprocess.Popen(
                [*command, "--log-level", "warning", "--timeout-graceful-shutdown", "5"],
                stdout=output,
                stderr=subprocess.STDOUT,
                env=environment | {"ROBOSAC_DATABASE_URL": database_url, **(settings or {})},
            )

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    async def ready(self) -> None:
        """Wait until the gateway serves.

        Raises
        ------
        GatewayUnreachable
            If it ends or is not ready in time; the message holds the end of its log.
        """
        end = time.monotonic() + START_TIMEOUT_S
        async with GatewayClient(self.url, timeout_s=2.0) as gateway:
            while not await gateway.ready():
                status = self._process.poll()
                if status is not None or time.monotonic() > end:
                    why = "was not ready in time" if status is None else f"ended with status {status}"
                    raise GatewayUnreachable(f"the gateway {why}; its log ends:\n{self._log.read_text()[-2000:]}")
                await asyncio.sleep(0.05)

    @contextlib.asynccontextmanager
    async def watched(self) -> AsyncIterator[None]:
        """Let what cannot reach the gateway in the block say that the gateway has ended, if it has."""
        try:
            yield
        except GatewayUnreachable as error:
            with contextlib.suppress(subprocess.TimeoutExpired):
                status = await asyncio.to_thread(self._process.wait, ENDING_S)
                raise GatewayUnreachable(
                    f"the gateway that this command started has ended with status {status}; its log, {self._log}, "
                    f"ends:\n{self._log.read_text()[-2000:]}"
                ) from error
            raise

    def peak_memory_mib(self) -> float:
        """The most physical memory that it held, MiB; NaN where the system does not tell."""
        try:
            status = Path(f"/proc/{self._process.pid}/status").read_text()
        except OSError:
            return math.nan
        (line,) = [line for line in status.splitlines() if line.startswith("VmHWM")]
        return int(line.split()[1]) / 1024

    def cpu_s(self) -> float:
        """Processor time that it has used, seconds; NaN where the system does not tell."""
        try:
            fields = Path(f"/proc/{self._process.pid}/stat").read_text().rpartition(")")[2].split()
        except OSError:
            return math.nan
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    async def stop(self) -> bool:
        """Terminate the gateway, and kill it if it does not end; whether it ended by itself."""
        self._process.terminate()
        try:
            await asyncio.to_thread(self._process.wait, STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            await self.kill()
            return False
        return True

    async def kill(self) -> None:
        """Let the gateway end at once."""
        self._process.kill()
        await asyncio.to_thread(self._process.wait)


def free_port() -> int:
    """A port of loopback that nobody has just now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


@contextlib.asynccontextmanager
async def local_gateway(
    log: Path, api_key: str | None = None, settings: Mapping[str, str] | None = None
) -> AsyncIterator[str]:
    """The URL of a gateway that runs for the length of a block, with log, key and settings as `GatewayProcess`.

    Unless the settings say otherwise, it keeps its sessions where ``ROBOSAC_DATABASE_URL`` says, else in a temporary
    folder that is removed afterwards.

    Raises
    ------
    GatewayUnreachable
        As `GatewayProcess.ready`, or out of the block, if the gateway ends in it.
    """
    with tempfile.TemporaryDirectory(prefix="robosac-") as folder:
        database_url = os.environ.get("ROBOSAC_DATABASE_URL", f"sqlite:///{folder}/robosac.db")
        process = GatewayProcess(log, database_url, api_key, settings=settings)
        try:
            with cancelled_by_sigterm():
                await process.ready()
                async with process.watched():
                    yield process.url
        finally:
            await process.stop()


@contextlib.contextmanager
def cancelled_by_sigterm() -> Iterator[None]:
    """Let a SIGTERM end the block as an exception would, so that no gateway outlives it, and no session. Whoever
    handles the signal already goes on to.
    """
    loop, task = asyncio.get_running_loop(), asyncio.current_task()
    if signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield
        return
    try:
        loop.add_signal_handler(signal.SIGTERM, task.cancel if task else loop.stop)
    except (NotImplementedError, RuntimeError, ValueError):  # not on this platform, or not in the main thread
        yield
        return
    try:
        yield
    finally:
        loop.remove_signal_handler(signal.SIGTERM)
