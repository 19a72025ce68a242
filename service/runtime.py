"""Process settings that have to be made before torch is imported.

OpenMP threads that spin while they wait make a decoder pass several times slower on a machine with few, shared cores;
and glibc's allocator, by default, returns every body of some MiB to the system and faults it in again for the next one.
"""

from __future__ import annotations

import ctypes
import os
import sys

_M_TRIM_THRESHOLD = -1
_M_MMAP_THRESHOLD = -3
_KEEP_BYTES = 64 * 1024 * 1024


def tune_process() -> None:
    """Let idle OpenMP threads sleep, and keep freed memory; what the environment says already is left alone."""
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("KMP_BLOCKTIME", "0")
    if sys.platform == "linux" and not any(name.startswith("MALLOC_") for name in os.environ):
        mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # absent where the C library is not glibc
        if mallopt is not None:
            mallopt(_M_MMAP_THRESHOLD, _KEEP_BYTES)
            mallopt(_M_TRIM_THRESHOLD, _KEEP_BYTES)
