"""Settings of the process; most have to be made before torch is imported.

OpenMP threads that spin while they wait make a decoder pass several times slower on a machine with few, shared cores;
and glibc's allocator, by default, returns every body of some MiB to the system and faults it in again for the next one.
The number of open files is often bound to 1024, which as many idle connections would use up. Python looks through all
objects now and then for garbage, and those of torch alone take longer than a frame has.
"""

from __future__ import annotations

import ctypes
import gc
import os
import sys
from contextlib import suppress
from functools import cache

_M_TRIM_THRESHOLD = -1
_M_MMAP_THRESHOLD = -3
_KEEP_BYTES = 64 * 1024 * 1024
_OPEN_FILES = 65_536


def tune_process() -> None:
    """Let idle OpenMP threads sleep, keep freed memory, and allow as many open files as the system grants.

    What the environment says already is left alone.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("KMP_BLOCKTIME", "0")
    if sys.platform == "linux" and not any(name.startswith("MALLOC_") for name in os.environ):
        mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # absent where the C library is not glibc
        if mallopt is not None:
            mallopt(_M_MMAP_THRESHOLD, _KEEP_BYTES)
            mallopt(_M_TRIM_THRESHOLD, _KEEP_BYTES)
    if sys.platform != "win32":
        import resource  # noqa: PLC0415 (not there on Windows)

        granted, most = resource.getrlimit(resource.RLIMIT_NOFILE)
        wanted = _OPEN_FILES if most == resource.RLIM_INFINITY else min(_OPEN_FILES, most)
        if granted != resource.RLIM_INFINITY and granted < wanted:
            with suppress(OSError, ValueError):  # some systems grant less than they say
                resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, most))


@cache
def keep_what_is_loaded() -> None:
    """Look for no garbage any more among what there is by now; once a process, when all is loaded."""
    gc.collect()
    gc.freeze()
