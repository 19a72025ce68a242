"""What machine this is, and how fast it is now.

Machines change their pace: clocks, neighbours on the same host, and cores that share caches and power. Whoever compares
what was measured at two times has to know it.
"""

from __future__ import annotations

import os
import platform
import re
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

SECONDS = 0.2
"""How long each of the two measurements takes."""
_SHAPE = 32, 64
"""Channels, and height and width, of the map that is convolved: as in the shipped detector."""


def machine() -> dict[str, Any]:
    """What a report says of this machine."""
    return {
        "platform": platform.platform(),
        "processor": _processor(),
        "python": sys.version.split()[0],
        "cores": os.cpu_count(),
    }


def _processor() -> str:
    """Its name, as Linux has it, or else as Python knows it."""
    try:
        found = re.search(r"^model name\s*: (.*)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    except OSError:
        found = None
    return found[1] if found else platform.processor()


@dataclass(frozen=True)
class Pace:
    """Processor time of a computation that is always the same, milliseconds."""

    alone_ms: float
    """While one core works."""
    together_ms: float
    """While all cores do the same."""


def pace() -> Pace:
    """Measure it; takes two fifths of a second, in which all cores are busy."""
    return Pace(_measured(1), _measured(os.cpu_count() or 1))


def _measured(cores: int) -> float:
    found: list[float] = []
    threads = [threading.Thread(target=_work, args=(time.perf_counter() + SECONDS, found)) for _ in range(cores)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return float(np.median(found))


def _work(until: float, found: list[float]) -> None:
    channels, size = _SHAPE
    features, kernel = torch.ones(1, channels, size, size), torch.ones(channels, channels, 3, 3)
    with torch.inference_mode():
        while not found or time.perf_counter() < until:
            started = time.thread_time()
            torch.nn.functional.conv2d(features, kernel, padding=1)
            found.append((time.thread_time() - started) * 1e3)
