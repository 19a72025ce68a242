"""Whose processor cores are whose, so that what clients take is not taken from the gateway that is measured."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class Cores:
    """Cores of this machine: all but the last for a gateway, and the last for its clients.

    With one core, or where the system does not let one choose, everybody has all.
    """

    def __init__(self) -> None:
        ours = sorted(os.sched_getaffinity(0)) if sys.platform == "linux" else []
        self.gateways, self.clients = (ours[:-1], ours[-1:]) if len(ours) > 1 else ([], [])

    @contextmanager
    def of_gateways(self) -> Iterator[None]:
        """What this thread starts in the block runs on the gateway's; this process is left with the clients'."""
        self._move(0, self.gateways)
        try:
            yield
        finally:
            self.be_a_client()

    def be_a_client(self) -> None:
        """Let this process have the clients' cores only."""
        for thread in Path("/proc/self/task").iterdir() if self.clients else ():
            self._move(int(thread.name), self.clients)

    def _move(self, thread: int, cores: list[int]) -> None:
        if sys.platform == "linux" and cores:
            os.sched_setaffinity(thread, cores)
