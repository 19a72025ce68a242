"""Faults of what a gateway stands on, each for a time: its database, its disk, its process."""

from __future__ import annotations

import os
import resource
import signal
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager

from clients.hostile.attacker import Target

KEPT_BYTES = 4096
"""What a file may still hold on a disk that is full: less than the database and its log have."""


@contextmanager
def locked_database(target: Target) -> Iterator[None]:
    """Another process holds the lock with which the gateway would write."""
    with closing(sqlite3.connect(target.database, isolation_level=None, timeout=10.0)) as connection:
        connection.execute("BEGIN IMMEDIATE")
        yield
        connection.execute("ROLLBACK")


@contextmanager
def stopped_process(target: Target) -> Iterator[None]:
    """The gateway's process stands still, as a machine that swaps or sleeps."""
    os.kill(target.pid, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(target.pid, signal.SIGCONT)


@contextmanager
def full_disk(target: Target) -> Iterator[None]:
    """No file of the gateway may grow: the system refuses what it writes, to its database and to its log alike."""
    before = resource.prlimit(target.pid, resource.RLIMIT_FSIZE)
    resource.prlimit(target.pid, resource.RLIMIT_FSIZE, (KEPT_BYTES, before[1]))
    try:
        yield
    finally:
        resource.prlimit(target.pid, resource.RLIMIT_FSIZE, before)
